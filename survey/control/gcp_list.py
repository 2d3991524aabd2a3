"""gcp_list.txt of OpenDroneMap: a line with the CRS, then ``x y z px py image [name] [role]``.

The centre of its first pixel is 0, 0. Lines without a name belong to the same point if they have the same coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from survey.control.points import Content, ControlFormat, GivenMark, GivenPoint, is_check_role
from survey.errors import ControlError
from survey.files.crs_lines import is_odm_crs, odm_lines
from survey.files.csv_table import number_of, text_lines
from survey.photos.exif import SUFFIXES
from survey.words import GCP_LIST

_FORM = "x y z px py image name"
_NUMBERS = ("x", "y", "z", "px", "py")
# Offset from its pixels, whose first centre is at 0, 0, to ours.
_HALF_A_PIXEL = 0.5


def read_gcp_list(path: Path) -> Content:
    """Points and marks."""
    crs, lines = odm_lines(path, GCP_LIST, _FORM, ControlError)
    name_of: dict[tuple[float, ...], str] = {}
    points, marks = [], []
    for where, line in lines:
        values, image, words = _parts(line, where)
        _require_whole_name(image, words, where)
        place = (values[0], values[1], values[2])
        name = words[0] if words else name_of.setdefault(place, f"{path.stem} {len(name_of) + 1}")
        is_check = len(words) > 1 and _is_check(words[1])
        points.append(GivenPoint(name, where, place, crs, is_check=is_check))
        marks.append(GivenMark(name, image, where, (values[3] + _HALF_A_PIXEL, values[4] + _HALF_A_PIXEL)))
    return Content(tuple(points), tuple(marks))


def is_of_content(line: str) -> bool:
    """Whether a line is neither empty nor a comment."""
    return bool(line.strip()) and not line.lstrip().startswith("#")


def line_cells(line: str) -> list[str]:
    """The values of a line; a name with a space is whole only between tabs."""
    if line.strip().count("\t") >= 5:
        return [cell.strip() for cell in line.split("\t") if cell.strip()]
    return line.split()


def mark_line(place: Sequence[str], pixel: tuple[float, float], image: str, words: Sequence[str]) -> str:
    """A line of a mark at x, y, z, with as many of name and role as there are, which `read_gcp_list` reads."""
    at = [f"{value - _HALF_A_PIXEL:.3f}" for value in pixel]
    cells = [*place, *at, image, *words]
    return ("\t" if any(" " in cell for cell in cells) else " ").join(cells)


def _parts(line: str, where: str) -> tuple[list[float], str, list[str]]:
    """The five numbers of a line, the name of the image, and the words after it."""
    cells = line_cells(line)
    if len(cells) < 6 and "," in line:
        raise ControlError(f"{where}: values are separated by commas, expected spaces or tabs: {_FORM}; replace them")
    if len(cells) < 6:
        raise ControlError(f"{where}: {len(cells)} values were found, expected {_FORM}; complete the line")
    values = [number_of(cell) for cell in cells[:5]]
    for name, cell, value in zip(_NUMBERS, cells, values, strict=False):
        if not math.isfinite(value):
            raise ControlError(f"{where}: {name} is {cell}, expected a finite number in {_FORM}; correct it")
    return values, cells[5], cells[6:]


def _require_whole_name(image: str, words: list[str], where: str) -> None:
    """Raise ControlError where a space has cut the name of a photograph: its suffix is in a later word."""
    if PurePosixPath(image).suffix.lower() in SUFFIXES:
        return
    end = next((i for i, word in enumerate(words, 1) if PurePosixPath(word).suffix.lower() in SUFFIXES), None)
    if end is not None:
        raise ControlError(
            f'{where}: the image name "{" ".join([image, *words[:end]])}" has a space, and values are '
            "separated by spaces here; separate all values of the file by tabs, or rename the photographs"
        )


def _is_check(word: str) -> bool:
    # Words after the name have no fixed meaning; only roles are recognised.
    try:
        return is_check_role(word, "")
    except ControlError:
        return False


def _is_gcp_list(path: Path) -> bool:
    try:
        lines = (line.strip() for _, line in text_lines(path, ControlError))
        first = next((line for line in lines if line and not line.startswith("#")), "")
    except ControlError:
        return False
    is_of_points = len(first.split()) >= 6 and all(math.isfinite(number_of(cell)) for cell in first.split()[:5])
    return is_of_points or is_odm_crs(first)


FORMAT = ControlFormat(
    name="OpenDroneMap's gcp_list.txt",
    recognises=lambda path: path.name.casefold() == GCP_LIST or _is_gcp_list(path),
    read=read_gcp_list,
)
