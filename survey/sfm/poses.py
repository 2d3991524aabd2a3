"""Structure from motion: poses in the local frame for a survey that comes without them.

Photographs with GPS positions in EXIF (`survey.sfm.gps`) -> a block of poses and points by pycolmap
(`survey.sfm.block`) -> georeferenced by the positions (`survey.sfm.gps_fit`, `survey.sfm.solve`). Here: the entry
point, the result, and the solved block, which is stored to be used again.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pyproj import CRS

from geo.crs import height_unit_m
from geo.files import disk_refusals
from geo.frames import LocalFrame
from refract.lens import Lens
from survey.code_hash import code_hash
from survey.errors import ImageError, SurveyError
from survey.files.json_values import read_json_object, write_json
from survey.files.lock import locked
from survey.photos.exif import read_exif
from survey.photos.tie_points import TiePoints
from survey.sfm import block as sfm_block
from survey.sfm.gps import GpsPositions, gps_positions
from survey.sfm.settings import one_focal, require_size
from survey.sfm.solve import Solved, aliases, solve
from survey.stage_key import stage_key

__all__ = ["SfmResult", "SfmView", "seconds_of_solve", "solve_poses"]

_RECORD, _MODEL, _WORK = "solved.json", "model", ".work.part"
# Features and matches of an image take about 2 MB in the database.
_BYTES_PER_IMAGE, _BYTES_AT_LEAST = 4_000_000, 50_000_000


class SfmView(NamedTuple):
    """A photograph with its solved pose.

    Attributes
    ----------
    name : str
        Path of the image below the folder that all images have in common, with forward slashes.
    lens : Lens
    centre : (3,) float64 [m], local
    cam_from_local : (3, 3) float64
    """

    name: str
    lens: Lens
    centre: np.ndarray
    cam_from_local: np.ndarray


@dataclass(frozen=True)
class SfmResult:
    """Poses and points of a block in its local frame.

    Attributes
    ----------
    frame : LocalFrame
        Origin: median GPS position, at the height of the middle point of the block, rounded.
    views : tuple of SfmView
        In order of names; images that could not be placed are left out.
    notes : list of sentences
        What was assumed, found and left out.
    points : (N, 3) float64 [m], local
        Matched points, on straight rays.
    num_views : (N,) int64
    error_px : (N,) float64
        Mean reprojection error of a point.
    gps_residual_m : (len(views), 3) float64 [m], local
        Camera centre minus GPS position; NaN for images without one.
    ties : TiePoints
        Those of the points that three images or more see; its views are numbered as in `views`.
    """

    frame: LocalFrame
    views: tuple[SfmView, ...]
    notes: list[str]
    points: np.ndarray
    num_views: np.ndarray
    error_px: np.ndarray
    gps_residual_m: np.ndarray
    ties: TiePoints


def solve_poses(
    image_paths: Sequence[Path],
    crs: CRS | None,
    workspace: Path,
    *,
    gps_height: str = "crs",
    size_px: tuple[int, int] | None = None,
    focal_px: float | tuple[float, float] | None = None,
    report: Callable[[str], None] | None = None,
) -> SfmResult:
    """Poses, lenses and points of photographs with GPS positions.

    Parameters
    ----------
    image_paths : sequence of Path
    crs : pyproj.CRS or None
        With a vertical part; None: UTM with heights above EGM96, said in the notes.
    workspace : Path
        Keeps the solved block, which is used again while images and settings are the same.
    gps_height : "crs" or "ellipsoidal"
        What the heights in EXIF count from.
    size_px : (width, height), optional
        That all images must have.
    focal_px : float, optional
        Of a calibration; it is kept. Without it, the one in EXIF is where the search starts.
    report : callable, optional
        Called with a sentence on the progress.

    Raises
    ------
    SurveyError
        Where positions, overlap or room on the disk do not suffice; the message says what to give instead.
    UnwritableFile
        Where the workspace cannot be written to.

    Notes
    -----
    The same images on the same kind of computer give the same poses: seeds and threads are fixed.
    """
    say = report or (lambda _text: None)
    images = _named(image_paths)
    heads = {name: read_exif(path) for name, path in images.items()}
    require_size(images, heads, size_px)
    focal_px = one_focal(focal_px)
    gps = gps_positions(heads, crs, gps_height)
    code = code_hash("survey.sfm.solve")
    key = stage_key("sfm", code, gps.frame, gps_height, focal_px, list(images), list(images.values()))
    busy = f"another process (number {{pid}}) looks for poses in {workspace}; wait until it ends, or stop it"
    with disk_refusals(workspace), locked(_made(workspace), busy=busy):
        solved = _stored(workspace, key)
        if solved is not None:
            say(f"structure from motion: poses of {solved.block.num_reg_images()} images from {workspace}")
        else:
            if (workspace / _RECORD).is_file():
                say(f"structure from motion: {workspace} has poses of other photographs or settings, or by other code")
            with _work_folder(workspace, len(images)) as work:
                start = time.monotonic()
                solved = solve(images, heads, gps, focal_px, work, say)
                _store(workspace, key, work, solved, time.monotonic() - start)
    return _result(solved, gps, images)


def _named(paths: Sequence[Path]) -> dict[str, Path]:
    """Images by their path below the folder that they have in common, in order of names."""
    if not paths:
        raise ImageError("structure from motion got no images, expected at least three")
    paths = [Path(path).absolute() for path in paths]
    folder = Path(os.path.commonpath([path.parent for path in paths]))
    return dict(sorted((path.relative_to(folder).as_posix(), path) for path in paths))


def _made(folder: Path) -> Path:
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


def _stored(workspace: Path, key: str) -> Solved | None:
    """What `_store` left with this key; None if there is nothing, or something else."""
    record = read_json_object(workspace / _RECORD)
    if record.get("key") != key or not (workspace / _MODEL).is_dir():
        return None
    frame = LocalFrame(CRS(record["crs"]), tuple(record["origin"]))
    return Solved(sfm_block.read_block(workspace / _MODEL), frame, tuple(record["notes"]))


def _store(workspace: Path, key: str, work: Path, solved: Solved, seconds: float) -> None:
    """Store a block; the record is written last and marks it as complete."""
    (workspace / _RECORD).unlink(missing_ok=True)
    shutil.rmtree(workspace / _MODEL, ignore_errors=True)
    model = work / _MODEL
    model.mkdir()
    sfm_block.write_block(solved.block, model)
    model.rename(workspace / _MODEL)
    frame = solved.frame
    record = {"key": key, "crs": frame.crs.to_wkt(), "origin": frame.origin, "notes": solved.notes}
    write_json(workspace / _RECORD, record | {"seconds": round(seconds, 3)})


def _result(solved: Solved, gps: GpsPositions, images: Mapping[str, Path]) -> SfmResult:
    poses, frame = sfm_block.poses_of(solved.block), solved.frame
    placed = {name: alias for name, alias in aliases(images).items() if alias in poses}
    views = tuple(
        SfmView(name, sfm_block.lens_of(solved.block, alias), *poses[alias]) for name, alias in placed.items()
    )
    # The positions are in a frame that lies higher: at the cameras, not at the ground.
    fall = np.array([0.0, 0.0, (frame.origin[2] - gps.frame.origin[2]) * height_unit_m(frame.crs)])
    measured = np.array([gps.local.get(name, np.full(3, np.nan)) - fall for name in placed])
    points, num_views, error_px = sfm_block.points_of(solved.block)
    residuals = np.array([view.centre for view in views]) - measured
    ties = sfm_block.tracks_of(solved.block, list(placed.values()))
    return SfmResult(frame, views, list(solved.notes), points, num_views, error_px, residuals, ties)
