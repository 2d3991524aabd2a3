"""Verified matches of a drawn block in a database of pycolmap, in place of those of photographs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from geo import LocalFrame, parse_crs
from refract.lens import Lens
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints
from survey.sfm import block as sfm_block
from survey.sfm.absolute_orientation import place_by_gps
from survey.sfm.features import MODEL, SEED, CameraBody
from survey.sfm.gps import GpsPositions
from survey.sfm.pairs import Place, image_pairs
from survey.sfm.solve import FreeBlocks, without_shared_images
from tests.block_survey import CRS, ORIGIN, survey_of
from tests.changed_survey import changed
from tests.drawn_block import DrawnBlock

# Of a pair: wrong matches for each right one.
_FALSE = 0.1


def names_of(block: DrawnBlock) -> list[str]:
    """Names of the photographs."""
    return [f"{number:06d}.jpg" for number in range(len(block.cameras))]


def write_matches(block: DrawnBlock, database: Path) -> int:
    """Write the matches of the pairs that positions choose, verified; the number of pairs."""
    names = names_of(block)
    pairs = image_pairs(names, {name: Place(at) for name, at in zip(names, block.positions, strict=True)})
    with pycolmap.Database.open(database) as opened:
        _write(opened, block, pairs)
    listed = database.with_suffix(".txt")
    listed.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    pycolmap.verify_matches(database, listed, options)
    return len(pairs)


def survey_of_mapped(block: DrawnBlock, blocks: list[pycolmap.Reconstruction]) -> tuple[Survey, Lens]:
    """The survey of a block as structure from motion hands it on, placed by positions; and its lens."""
    names, frame = names_of(block), LocalFrame(parse_crs(CRS), ORIGIN)
    gps = GpsPositions(frame, dict(zip(names, block.positions, strict=True)), ())
    sensors = [CameraBody(tuple(names), (block.lens.width, block.lens.height), block.stated_lens.focal[0])]
    placed = place_by_gps(FreeBlocks(without_shared_images(blocks), ()), gps, sensors)
    up = np.array(placed.frame.origin) - ORIGIN
    found = {name: pose for part in placed.blocks for name, pose in sfm_block.poses_of(part).items()}
    posed = [name for name in names if name in found]
    lens = sfm_block.lens_of(placed.blocks[0], next(iter(sfm_block.poses_of(placed.blocks[0]))))
    survey = survey_of(block)
    views = tuple(
        replace(view, camera=lens.camera(found[name][0] + up, found[name][1]), lens=lens)
        for name, view in zip(names, survey.views, strict=True)
        if name in found
    )
    ties = TiePoints.together([sfm_block.tracks_of(part, posed) for part in placed.blocks])
    ties = replace(ties, start=ties.start + up)
    return changed(survey, views=views, ties=ties, points=ties.start), lens


def _write(database: pycolmap.Database, block: DrawnBlock, pairs: list[tuple[str, str]]) -> None:
    rng, lens = np.random.default_rng([block.seed, 39]), block.stated_lens
    params = [lens.focal[0], 0.5 * lens.width, 0.5 * lens.height, 0.0, 0.0]
    body = pycolmap.Camera(model=MODEL, width=lens.width, height=lens.height, params=params)
    body.has_prior_focal_length = True
    camera = database.write_camera(body)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera))
    rig = database.write_rig(rig)
    number, seen = {}, {}
    for view, name in enumerate(names_of(block)):
        rows = np.flatnonzero(block.view == view)
        number[name] = database.write_image(pycolmap.Image(name=name, camera_id=camera))
        frame = pycolmap.Frame()
        frame.rig_id = rig
        frame.add_data_id(database.read_image(number[name]).data_id)
        database.write_frame(frame)
        database.write_keypoints(number[name], block.pixel[rows].astype(np.float32))
        seen[name] = block.point[rows]
    for first, second in pairs:
        _, one, other = np.intersect1d(seen[first], seen[second], return_indices=True)
        false = rng.integers(0, [len(seen[first]), len(seen[second])], (int(_FALSE * len(one)), 2))
        matches = np.concatenate([np.column_stack([one, other]), false]).astype(np.uint32)
        database.write_matches(number[first], number[second], matches)
