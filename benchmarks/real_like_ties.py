"""Blocks as they come from the field, adjusted with exact matches and noise instead of those of photographs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

# Before the system's zlib; see survey/sfm/block.py.
import pycolmap
from real_like_blocks import LENS, Flight, RealLikeBlock, is_inside, name_of
from scipy.spatial.transform import Rotation

from geo.similarity import Similarity
from refract.lens import distorted
from survey.adjust.refine import adjust_survey
from survey.errors import PosesError
from survey.folder.survey import Survey, load_survey
from survey.photos.poses import TiePoints, connected_parts, least_track
from survey.sfm import block as sfm_block
from survey.sfm.solve import FreeBlocks, Photographs, aliases
from survey.simulate.ground.shapes import BedGrid

# Points to the square metre, the share of them that each photograph has, and of false ones among these.
_DENSITY, _FOUND, _FALSE = 3.0, 0.75, 0.01
_STD_PX, _FALSE_PX, _START_M = 0.3, 12.0, 0.1


def adjusted_by_ties(block: RealLikeBlock, folder: Path, bed: BedGrid) -> tuple[np.ndarray, float]:
    """Tie points (N, 3) in crs of an adjusted block, and the share of coordinates of cameras that their std covers.

    Raises
    ------
    SurveyError, GeoError
        As reading and adjusting a survey do.
    """
    flight = Flight.of(block.ground)
    taken = block.taken(np.random.default_rng([block.seed, 34]))
    ties = _ties(flight, taken, bed, np.random.default_rng([block.seed, 36]))

    def solve(photographs: Photographs, *_others: object) -> FreeBlocks:
        return _free(ties, taken, flight, aliases(photographs.images), np.random.default_rng([block.seed, 37]))

    again = _ties(flight, taken, bed, np.random.default_rng([block.seed, 38]))

    def windows(survey: Survey, **_others: object) -> TiePoints:
        return _in_survey(again, taken, flight, survey)

    with patch("survey.sfm.poses.solve", solve), patch("survey.adjust.refine.measure_windows", windows):
        found = adjust_survey(survey := load_survey(folder), device="cpu")
    points = survey.frame.crs_from_local(found.points[: len(found.points) - len(found.control)])
    true = {name_of(k): flight.frame.crs_from_local(flight.cameras[k].centre[None])[0] for k in taken}
    off = found.poses.centres - survey.frame.local_from_crs(np.array([true[name] for name in found.poses.names]))
    return points, float(np.mean(np.abs(off) <= 1.96 * found.poses.position_std))


def _ties(flight: Flight, taken: list[int], bed: BedGrid, rng: np.random.Generator) -> TiePoints:
    """Points of the bed that three photographs find, or two of two, in the flight's frame; views as in ``taken``."""
    centres = np.array([flight.cameras[k].centre for k in taken])
    low, high = centres[:, :2].min(axis=0) - 5.0, centres[:, :2].max(axis=0) + 5.0
    places = rng.uniform(low, high, (int(_DENSITY * np.prod(high - low)), 2))
    points = np.column_stack([places, bed.height(*places.T)])
    point, view, pixel = [], [], []
    for number, k in enumerate(taken):
        straight = flight.cameras[k].project(points, flight.water)
        # Distortion is a polynomial: far outside the photograph it would fold points back into it.
        near = (np.abs(straight - (LENS["cx"], LENS["cy"])) < LENS.width).all(axis=1)
        at = np.full_like(straight, np.nan)
        at[near] = distorted(LENS, straight[near])
        seen = np.flatnonzero(is_inside(at) & (rng.random(len(points)) < _FOUND))
        noise = _STD_PX * rng.standard_normal((len(seen), 2))
        noise += (rng.random(len(seen)) < _FALSE)[:, None] * rng.uniform(-_FALSE_PX, _FALSE_PX, (len(seen), 2))
        point.append(seen)
        view.append(np.full(len(seen), number))
        pixel.append(at[seen] + noise)
    columns = [np.concatenate(column) for column in (point, view, pixel)]
    order = np.argsort(columns[0], kind="stable")
    of_all = TiePoints(points, *(column[order] for column in columns))
    return _of_views(of_all, least_track(len(taken)))


def _of_views(ties: TiePoints, least: int) -> TiePoints:
    """The points that so many views have at least."""
    enough = np.bincount(ties.point, minlength=len(ties)) >= least
    keep, number = enough[ties.point], np.cumsum(enough) - 1
    return TiePoints(ties.start[enough], number[ties.point[keep]], ties.view[keep], ties.pixel[keep], least)


def _apparent(points: np.ndarray, flight: Flight) -> np.ndarray:
    """Where straight rays have points (N, 3) of the bed, about."""
    if flight.water is None:
        return points
    apparent = points.copy()
    apparent[:, 2] = np.where(points[:, 2] < 0.0, points[:, 2] / flight.water.n_water, points[:, 2])
    return apparent


def _in_survey(ties: TiePoints, taken: list[int], flight: Flight, survey: Survey) -> TiePoints:
    """The points in the frame of a survey, of its views."""
    number = {view.name: k for k, view in enumerate(survey.views)}
    of_view = np.array([number.get(name_of(k), -1) for k in taken])
    posed = of_view[ties.view] >= 0
    seen = replace(ties, point=ties.point[posed], view=of_view[ties.view[posed]], pixel=ties.pixel[posed])
    kept = _of_views(seen, least_track(len(survey.views)))
    return replace(kept, start=survey.frame.local_from_crs(flight.frame.crs_from_local(kept.start)))


def _free(
    ties: TiePoints, taken: list[int], flight: Flight, alias_of: Mapping[str, str], rng: np.random.Generator
) -> FreeBlocks:
    """The blocks that structure from motion would find, each in a frame of its own."""
    part, least = connected_parts(len(taken), ties.point, ties.view), least_track(len(taken))
    blocks, names = [], list(alias_of.values())
    start = _apparent(ties.start, flight) + _START_M * rng.standard_normal(ties.start.shape)
    for number in range(int(part.max(initial=-1)) + 1):
        mine = np.flatnonzero(part == number)
        if len(mine) >= least:
            blocks.append(_reconstruction(replace(ties, start=start), taken, mine, flight, names))
            turn = Similarity(rng.uniform(0.05, 2.0), Rotation.random(rng=rng).as_matrix(), rng.normal(0.0, 5.0, 3))
            sfm_block.transform(blocks[-1], turn)
    if not blocks:
        raise PosesError(f"structure from motion placed 0 of {len(taken)} images, expected at least {least}")
    return FreeBlocks(tuple(blocks), ())


def _reconstruction(
    ties: TiePoints, taken: list[int], mine: np.ndarray, flight: Flight, names: list[str]
) -> pycolmap.Reconstruction:
    """The photographs ``mine`` of ``taken`` with their points; named as ``names`` has them."""
    block = pycolmap.Reconstruction()
    params = [LENS.focal[0], LENS["cx"], LENS["cy"], LENS["k1"], LENS["k2"]]
    block.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model=sfm_block.MODEL, width=LENS.width, height=LENS.height, params=params)
    )
    tracks: dict[int, list[pycolmap.TrackElement]] = {}
    for number in mine.tolist():
        camera, rows = flight.cameras[taken[number]], np.flatnonzero(ties.view == number)
        rotation = camera.cam_from_local
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ camera.centre)
        image = pycolmap.Image(name=names[number], keypoints=ties.pixel[rows], camera_id=1, image_id=number + 1)
        block.add_image_with_trivial_frame(image, pose)
        for place, row in enumerate(rows):
            tracks.setdefault(int(ties.point[row]), []).append(pycolmap.TrackElement(number + 1, place))
    for point, elements in sorted(tracks.items()):
        block.add_point3D(ties.start[point], pycolmap.Track(elements))
    block.update_point_3d_errors()
    return block
