"""cameras.csv: positions in crs, and omega, phi, kappa in degrees about the grid axes at the camera."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from survey.errors import PosesError
from survey.photos.cameras import CAM_FROM_OPK_CAM, Pose, grid_from_opk
from survey.photos.formats.format import Format

COLUMNS = ("image", "easting", "northing", "height", "omega", "phi", "kappa")


def is_opk_csv(path: Path) -> bool:
    """Whether the first line of a file has the columns of cameras.csv."""
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        return set(COLUMNS) <= set(_cells(file.readline(4096)))


def _cells(line: str) -> list[str]:
    return [cell.strip().lower() for cell in next(csv.reader([line]), [])]


def read_opk_csv(path: Path) -> list[Pose]:
    """Poses in crs from a table with the columns of `COLUMNS`, in any order; further columns are not read.

    Raises
    ------
    PosesError
        Where a column is missing, a number is missing or not finite, or an image has two lines.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise PosesError(f"{path}: byte {error.start} is not UTF-8; save the table as UTF-8") from error
    header = _cells(lines[0]) if lines else []
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise PosesError(
            f"{path}: the first line has no column {', '.join(missing)}; expected {','.join(COLUMNS)}, by commas"
        )
    column = {name: header.index(name) for name in COLUMNS}
    poses: dict[str, Pose] = {}
    for number, row in enumerate(csv.reader(lines[1:]), start=2):
        if not row or not "".join(row).strip() or row[0].startswith("#"):
            continue
        pose = _pose(row, column, where=f"{path}, line {number}")
        if pose.name in poses:
            raise PosesError(f"{path}, line {number}: image {pose.name} has a second pose; keep one of the two lines")
        poses[pose.name] = pose
    return list(poses.values())


def _pose(row: list[str], column: dict[str, int], *, where: str) -> Pose:
    if len(row) <= max(column.values()):
        raise PosesError(
            f"{where}: {len(row)} values were found, expected {max(column.values()) + 1}; complete the line"
        )
    name = row[column["image"]].strip()
    if not name:
        raise PosesError(f"{where}: the name of the image is missing; give it or remove the line")
    e, n, h, *degrees = (_number(row[column[key]], key, name, where) for key in COLUMNS[1:])
    grid_from_cam = grid_from_opk(*(math.radians(angle) for angle in degrees)) @ CAM_FROM_OPK_CAM
    return Pose(name, np.array([e, n, h]), grid_from_cam.T, in_crs=True, lens=None)


def _number(text: str, key: str, name: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise PosesError(
            f"{where}: {key} of {name} is {text.strip() or 'empty'}, expected a finite number; correct it or remove "
            "the line"
        )
    return value


FORMAT = Format(
    name="a table image,easting,northing,height,omega,phi,kappa (.csv)",
    find=lambda folder: sorted(path for path in folder.glob("*.csv") if is_opk_csv(path)),
    recognises=lambda path: path.is_file() and (path.suffix.lower() == ".csv" or is_opk_csv(path)),
    read=read_opk_csv,
)
