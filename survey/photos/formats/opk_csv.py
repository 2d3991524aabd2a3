"""cameras.csv: positions in crs, and omega, phi, kappa in degrees about the grid axes at the camera."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from survey.errors import PosesError
from survey.files.csv_table import Row, column_names, read_table
from survey.photos.cameras import CAM_FROM_OPK_CAM, grid_from_opk
from survey.photos.formats.format import Format
from survey.photos.poses import Pose, PoseFile, PoseFrame

COLUMNS = ("image", "easting", "northing", "height", "omega", "phi", "kappa")


def is_opk_csv(path: Path) -> bool:
    """Whether the first line of a file has the columns of cameras.csv."""
    return set(COLUMNS) <= set(column_names(path))


def read_opk_csv(path: Path) -> PoseFile:
    """Poses in crs from a table with the columns of `COLUMNS`, in any order; further columns are not read.

    Raises
    ------
    PosesError
        Where a column is missing, a number is missing or not finite, or an image has two lines.
    """
    poses: dict[str, Pose] = {}
    for row in read_table(path, COLUMNS, error=PosesError):
        pose = _pose(row)
        if pose.name in poses:
            raise PosesError(f"{row.where}: image {pose.name} has a second pose; keep one of the two lines")
        poses[pose.name] = pose
    return PoseFile(tuple(poses.values()), PoseFrame.GRID)


def _pose(row: Row) -> Pose:
    e, n, h, *degrees = (row.number(name) for name in COLUMNS[1:])
    grid_from_cam = grid_from_opk(*(math.radians(angle) for angle in degrees)) @ CAM_FROM_OPK_CAM
    return Pose(row.text("image"), np.array([e, n, h]), grid_from_cam.T)


FORMAT = Format(
    name="a table image,easting,northing,height,omega,phi,kappa (.csv)",
    find=lambda folder: sorted(path for path in folder.glob("*.csv") if is_opk_csv(path)),
    recognises=lambda path: path.is_file() and (path.suffix.lower() == ".csv" or is_opk_csv(path)),
    read=read_opk_csv,
)
