"""Structure from motion: poses in the local frame for a survey that comes without them.

Photographs -> blocks of poses and points by pycolmap (`survey.sfm.block`, `survey.sfm.solve`), one where all overlap ->
each georeferenced by GPS positions in EXIF or by control points (`survey.sfm.absolute_orientation`). Here: the entry
point, the result, and the solved blocks, which are stored, in their own frames, to be used again.
"""

import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pyproj import CRS

from geo.crs import height_unit_m
from geo.files import reporting_disk_errors
from geo.frames import LocalFrame
from survey.errors import SurveyError
from survey.files.json_values import read_json_object, write_json
from survey.files.paths import locked
from survey.photos.cameras import View
from survey.photos.exif import Exif, read_exif
from survey.photos.poses import TiePoints
from survey.settings.config import CamerasConfig
from survey.sfm import block as sfm_block
from survey.sfm.absolute_orientation import PlacedBlocks, place_by_control, place_by_gps
from survey.sfm.control_fit import BlockControl
from survey.sfm.features import solver
from survey.sfm.gps import gps_positions, positions_in_crs
from survey.sfm.gps_fit import attitudes_of
from survey.sfm.pairs import image_pairs
from survey.sfm.solve import FreeBlocks, Photographs, sensors_of, solve
from survey.stage_key import code_hash, stage_key

_RECORD, _MODEL, _WORK = "solved.json", "model", ".work.part"
# Features and matches of an image take about 0.4 MB in the database.
_BYTES_PER_IMAGE, _BYTES_AT_LEAST = 2_000_000, 50_000_000


@dataclass(frozen=True)
class SfmResult:
    """Poses and points of all blocks that could be placed, in one local frame."""

    # Origin: median GPS position or control point, at the height of the middle point of the block, rounded
    frame: LocalFrame
    views: tuple[View, ...]  # In order of names; images that could not be placed are left out
    notes: tuple[str, ...]  # sentences: what was assumed, found and left out
    # (len(views), 3) float64 [m], local: camera centre minus GPS position; NaN for images without one
    gps_residual_m: np.ndarray
    ties: TiePoints  # Those of the points that three images or more see; its views are numbered as in `views`


def solve_poses(
    images: Mapping[str, Path],
    headers: Mapping[str, Exif],
    cameras: CamerasConfig,
    crs: CRS,
    workspace: Path,
    *,
    level_m: float | None = None,
    control: BlockControl | None = None,
    spare_control: BlockControl | None = None,
    report: Callable[[str], None] | None = None,
) -> SfmResult:
    """Poses, lenses and points of photographs with GPS positions, or with control points.

    The same images on the same kind of computer give the same poses: seeds and threads are fixed. A focal length that
    ``cameras`` has is kept; without it, the one in EXIF is where the search starts. The workspace keeps the solved
    block, which is used again while images and settings are the same. ``level_m`` of the water or the ground, about,
    tells footprints. ``control`` places blocks instead of GPS positions, ``spare_control`` those that these cannot.
    """
    note = report or (lambda _text: None)
    images = dict(sorted(images.items()))
    headers = {name: headers[name] for name in images}
    focal_px, attitudes = cameras.square_focal_px, attitudes_of(headers)
    place: Callable[..., PlacedBlocks]
    if control is None:
        gps = gps_positions(headers, crs, cameras.gps_height)
        frame, place = gps.frame, partial(place_by_gps, gps=gps, spare=spare_control, attitudes=attitudes)
    else:
        frame, place = control.frame, partial(place_by_control, control=control, attitudes=attitudes)
    positions, _ = positions_in_crs(headers, crs, cameras.gps_height)
    local = {name: frame.local_from_crs(position) for name, position in positions.items()}
    ground = None if level_m is None else _ground(frame, level_m)
    free = _solved(Photographs(images, headers, local, focal_px, ground), workspace, note)
    by = "their GPS positions" if control is None else f"{len(control.points)} control points"
    note(f"structure from motion: {free.num_images} images are placed by {by}")
    placed = place(free, sensors=sensors_of(headers, focal_px))
    return _result(placed, positions, images)


def _ground(frame: LocalFrame, level_m: float) -> float:
    """A height in crs in a local frame, at its origin."""
    east, north, _ = frame.origin
    return float(frame.local_from_crs(np.array([east, north, level_m / height_unit_m(frame.crs)]))[2])


class FreeViews(NamedTuple):
    """Photographs that structure from motion placed, in a frame of their own."""

    # dict of name to (centre (3,), rotation (3, 3) from that frame to cam): in order of names
    poses: dict[str, tuple[np.ndarray, np.ndarray]]
    ties: TiePoints  # Views are numbered as in `poses`


def blocks_of(
    images: Mapping[str, Path],
    positions: Mapping[str, np.ndarray],
    focal_px: float | None,
    workspace: Path,
    report: Callable[[str], None],
) -> list[FreeViews]:
    """Poses and points of photographs, not placed anywhere, of each block that they make; the largest first.

    Images are in order of names. Positions (3,) [m] of the cameras, about, in any one frame, select the pairs to match.
    """
    headers = {name: read_exif(path) for name, path in images.items()}
    free = _solved(Photographs(images, headers, positions, focal_px), workspace, report)
    poses = [sfm_block.poses_of(block) for block in free.blocks]
    ties = [sfm_block.tracks_of(block, list(own)) for block, own in zip(free.blocks, poses, strict=True)]
    return [FreeViews(*of_block) for of_block in zip(poses, ties, strict=True)]


def _solved(photographs: Photographs, workspace: Path, report: Callable[[str], None]) -> FreeBlocks:
    """The blocks of photographs in their own frames: those in the workspace, or solved now and stored there."""
    # Positions in the images themselves are those of the files.
    images, places = photographs.images, photographs.places
    # Of positions, of levels and of heights only the pairs that they choose count.
    settings = (photographs.focal_px, sorted(places), image_pairs(list(images), places))
    key = stage_key("sfm", code_hash(), *settings, list(images), list(images.values()))
    busy = f"another process (number {{pid}}) looks for poses in {workspace}; wait until it ends, or stop it"
    with reporting_disk_errors(workspace), locked(_make_folder(workspace), busy=busy):
        free = _stored(workspace, key)
        if free is not None:
            report(f"structure from motion: poses of {free.num_images} images from {workspace}")
        else:
            if (workspace / _RECORD).is_file():
                report(f"structure from motion: {workspace} has poses of other photographs, settings or code")
            with _work_folder(workspace, len(images)) as work:
                start = time.monotonic()
                free = solve(photographs, work, report)
                _store(workspace, key, work, free, time.monotonic() - start)
    return free


def _make_folder(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@contextmanager
def _work_folder(workspace: Path, num_images: int) -> Iterator[Path]:
    """A temporary folder in the workspace; remains of a killed run are removed first."""
    needed, free = _BYTES_AT_LEAST + num_images * _BYTES_PER_IMAGE, shutil.disk_usage(workspace).free
    if free < needed:
        raise SurveyError(
            f"structure from motion needs {needed / 1e6:.0f} MB in {workspace}, and {free / 1e6:.0f} MB are free; free "
            "some, or name a run folder elsewhere with -o"
        )
    work = workspace / _WORK
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)


def seconds_of_solve(workspace: Path) -> float | None:
    """Time [s] that the poses in a workspace took to solve; None if there are none or it was not recorded."""
    return read_json_object(workspace / _RECORD).get("seconds")


def _stored(workspace: Path, key: str) -> FreeBlocks | None:
    """Result that `_store` kept with this key; None if there is nothing, or something else."""
    record = read_json_object(workspace / _RECORD)
    if record.get("key") != key or not (workspace / _MODEL).is_dir():
        return None
    folders = [workspace / _MODEL / str(number) for number in range(record["blocks"])]
    return FreeBlocks(tuple(solver().Reconstruction(folder) for folder in folders), tuple(record["notes"]))


def _store(workspace: Path, key: str, work: Path, free: FreeBlocks, seconds: float) -> None:
    """Store blocks; the record is written last and marks it as complete."""
    (workspace / _RECORD).unlink(missing_ok=True)
    shutil.rmtree(workspace / _MODEL, ignore_errors=True)
    for number, block in enumerate(free.blocks):
        model = work / _MODEL / str(number)
        model.mkdir(parents=True)
        block.write_binary(model)
    (work / _MODEL).rename(workspace / _MODEL)
    record = {"key": key, "blocks": len(free.blocks), "notes": free.notes, "seconds": round(seconds, 3)}
    write_json(workspace / _RECORD, record)


def _result(placed: PlacedBlocks, positions: Mapping[str, np.ndarray], images: Mapping[str, Path]) -> SfmResult:
    frame, views = placed.frame, []
    for block in placed.blocks:
        for name, pose in sfm_block.poses_of(block).items():
            lens = sfm_block.lens_of(block, name)
            views.append(View(name, images[name], lens.camera(*pose), lens))
    views.sort(key=lambda view: view.name)
    lost = np.full(3, np.nan)
    residuals = [
        view.camera.centre - (frame.local_from_crs(positions[view.name]) if view.name in positions else lost)
        for view in views
    ]
    names = [view.name for view in views]
    ties = TiePoints.together([sfm_block.tracks_of(block, names) for block in placed.blocks])
    return SfmResult(frame, tuple(views), placed.notes, np.array(residuals), ties)
