"""Lines of text with a name, a position and omega, phi, kappa: Metashape's export, BINGO's and others like them.

Positions are in crs, angles in degrees about the grid axes, unless a heading says gon. Metashape adds the nine numbers
of the rotation from the grid into photo axes, which have to agree with the angles.
"""

from __future__ import annotations

import math
import re
from contextlib import suppress
from pathlib import Path

import numpy as np

from survey.errors import PosesError
from survey.files.csv_table import number_of, text_lines
from survey.photos.poses import Pose, PoseFile, PoseFrame
from survey.photos.rotations import CAM_FROM_OPK_CAM, grid_from_opk
from survey.pose_files.format import Format
from survey.words import GEO_TXT

_SUFFIXES = (".txt", ".dat", ".opk", ".eo")
_NUMBERS, _WITH_MATRIX = 6, 15
_ORDER = re.compile(r"\bx\b.*\by\b.*\bz\b.*\bomega\b.*\bphi\b.*\bkappa\b")
# Angles and matrix are written with six digits at least.
_AGREE = 1e-3
_EXPECTED = "expected name, x, y, z, omega, phi, kappa"


def read_exterior_text(path: Path) -> PoseFile:
    """Poses in crs from the lines of a file that are neither empty nor headings."""
    poses: list[Pose] = []
    heading, unit, tool = "", 1.0, None
    for number, line in text_lines(path, PosesError):
        where = f"{path}, line {number}"
        if _is_heading(line) and not poses:
            heading += line.casefold() + " "
            unit = 0.9 if "gon" in heading.split() or "[gon]" in heading or "(gon)" in heading else 1.0
            tool = "Metashape" if "photoid" in heading else None
        elif line.strip() and not line.lstrip().startswith("#"):
            poses.append(_pose(*_split(line, where), unit, where))
    if heading.lstrip("# ").startswith(("epsg:", "+proj", "wgs84")):
        raise PosesError(
            f"{path} begins with a CRS, as OpenDroneMap's geo.txt does, whose angles are not poses: under the name "
            f"{GEO_TXT} its positions are used without being named; {_EXPECTED}"
        )
    return PoseFile(tuple(poses), PoseFrame.GRID, tool=tool)


def _pose(name: str, values: list[float], unit: float, where: str) -> Pose:
    omega, phi, kappa = (unit * angle for angle in values[3:6])
    if max(abs(omega), abs(phi), abs(kappa)) > 360.0:
        raise PosesError(
            f"{where}: the angles are {values[3]:g}, {values[4]:g}, {values[5]:g}, expected degrees within 360; write "
            "gon into the heading if that is their unit"
        )
    grid_from_photo = grid_from_opk(*(math.radians(angle) for angle in (omega, phi, kappa)))
    if len(values) == _WITH_MATRIX:
        matrix = np.array(values[6:]).reshape(3, 3)
        if not np.abs(matrix - grid_from_photo.T).max() < _AGREE:
            raise PosesError(
                f"{where}: the nine numbers of its rotation are not those of omega, phi and kappa, expected the "
                "rotation from the grid into photo axes (x right, y up); export the cameras again as omega, phi, kappa"
            )
    return Pose(name, np.array(values[:3]), (grid_from_photo @ CAM_FROM_OPK_CAM).T, where=where)


def _split(line: str, where: str) -> tuple[str, list[float]]:
    """The name and the numbers of a line; names may hold spaces, and a number may stand before them."""
    cells = [cell.strip() for cell in line.rstrip().split("\t" if "\t" in line else None)]
    for count in (_WITH_MATRIX, _NUMBERS):
        values = [_number(cell) for cell in cells[-count:]]
        if len(cells) > count and None not in values:
            words = cells[:-count]
            if len(words) > 1 and words[0].isdecimal() and _number(words[1]) is None:
                words = words[1:]
            return " ".join(words), [value for value in values if value is not None]
    raise PosesError(f'{where}: "{line.strip()}" was found, {_EXPECTED}; correct or remove the line')


def _is_heading(line: str) -> bool:
    """Whether a line has no number but those in a heading."""
    cells = line.split()
    return not cells or line.lstrip().startswith("#") or sum(_number(cell) is not None for cell in cells) < 3


def _number(text: str) -> float | None:
    value = number_of(text)
    return value if math.isfinite(value) else None


def is_exterior_text(path: Path) -> bool:
    """Whether the first line with numbers in a file of text has a name, a position and three angles.

    A heading that names them in another order makes it a table.
    """
    heading = _heading_of(path)
    return heading is not None and (_ORDER.search(heading) is not None or "omega" not in heading)


def _heading_of(path: Path) -> str | None:
    """The lines before the first pose, in lower case; None where a file has no pose."""
    heading = ""
    if path.is_file() and path.suffix.casefold() in _SUFFIXES:
        with suppress(PosesError):
            for _, line in text_lines(path, PosesError):
                if not _is_heading(line):
                    _split(line, "")
                    return heading
                heading += line.casefold() + "\n"
    return None


FORMAT = Format(
    name="lines of name, x, y, z, omega, phi, kappa (.txt, .dat, .opk, .eo)",
    find=lambda folder: sorted(
        path
        for path in folder.iterdir()
        # Other lists of positions have as many numbers, and no heading that names the angles.
        if is_exterior_text(path)
        and "omega" in (_heading_of(path) or "")
        and "calibrated_" not in path.name
        and path.name != GEO_TXT
    ),
    recognises=is_exterior_text,
    read=read_exterior_text,
)
