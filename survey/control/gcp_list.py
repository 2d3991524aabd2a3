"""gcp_list.txt of OpenDroneMap: a line with the CRS, then ``x y z px py image [name] [role]``.

The centre of its first pixel is 0, 0. Lines without a name are of one point where they have the same coordinates.
"""

from __future__ import annotations

import math
import re
from pathlib import Path, PurePosixPath

from pyproj import CRS
from pyproj.exceptions import CRSError

from survey.control.content import Content, ControlFormat, GivenMark, GivenPoint, is_check_role
from survey.errors import ControlError
from survey.files.csv_table import shortened, text_lines
from survey.photos.exif import SUFFIXES

_UTM = re.compile(r"WGS\s*84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)
# OpenSfM's word for longitude and latitude.
_WGS84 = re.compile(r"WGS\s*84", re.IGNORECASE)
_EPSG = re.compile(r"EPSG:\s*(\d{1,9}(?:\+\d{1,9})?)", re.IGNORECASE)
_FORM = "x y z px py image name"
_NUMBERS = ("x", "y", "z", "px", "py")
# From its pixels, the first of which has its centre at 0, 0, to ours.
_HALF_A_PIXEL = 0.5


def read_gcp_list(path: Path) -> Content:
    """Points and marks.

    Raises
    ------
    ControlError
        If the line with the CRS is missing, or a line is not of the form above.
    """
    lines = [
        (n, line) for n, line in text_lines(path, ControlError) if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise ControlError(f"{path} is empty, expected a line with its CRS, then lines {_FORM}; write it again")
    number, header = lines[0]
    crs = _crs_of(header.strip(), f"{path}, line {number}")
    name_of: dict[tuple[float, ...], str] = {}
    points, marks = [], []
    for number, line in lines[1:]:
        where = f"{path}, line {number}"
        values, image, words = _parts(line, where)
        _require_whole_name(image, words, where)
        place = (values[0], values[1], values[2])
        name = words[0] if words else name_of.setdefault(place, f"{path.stem} {len(name_of) + 1}")
        is_check = len(words) > 1 and _is_check(words[1])
        points.append(GivenPoint(name, where, place, crs, is_check=is_check))
        marks.append(GivenMark(name, image, where, (values[3] + _HALF_A_PIXEL, values[4] + _HALF_A_PIXEL)))
    return Content(tuple(points), tuple(marks))


def _parts(line: str, where: str) -> tuple[list[float], str, list[str]]:
    """The five numbers of a line, the name of the image, and the words after it."""
    # A name with a space is whole only between tabs.
    cells = (
        [cell.strip() for cell in line.split("\t") if cell.strip()] if line.strip().count("\t") >= 5 else line.split()
    )
    if len(cells) < 6 and "," in line:
        raise ControlError(f"{where}: values are separated by commas, expected spaces or tabs: {_FORM}; replace them")
    if len(cells) < 6:
        raise ControlError(f"{where}: {len(cells)} values were found, expected {_FORM}; complete the line")
    values = [_number(cell) for cell in cells[:5]]
    for name, cell, value in zip(_NUMBERS, cells, values, strict=False):
        if not math.isfinite(value):
            raise ControlError(
                f"{where}: {name} is {shortened(cell)}, expected a finite number; expected {_FORM}, correct the line"
            )
    return values, cells[5], cells[6:]


def _require_whole_name(image: str, words: list[str], where: str) -> None:
    """Raise ControlError where a space has cut the name of a photograph: its suffix is in a later word."""
    if PurePosixPath(image).suffix.lower() in SUFFIXES:
        return
    end = next((i for i, word in enumerate(words, 1) if PurePosixPath(word).suffix.lower() in SUFFIXES), None)
    if end is not None:
        raise ControlError(
            f'{where}: the image name "{shortened(" ".join([image, *words[:end]]))}" has a space, and values are '
            "separated by spaces here; separate all values of the file by tabs, or rename the photographs"
        )


def _is_check(word: str) -> bool:
    # What follows the name has no fixed meaning: only a word for a role counts.
    try:
        return is_check_role(word, "")
    except ControlError:
        return False


def _crs_of(header: str, where: str) -> CRS:
    if _WGS84.fullmatch(header):
        return CRS.from_epsg(4326)
    utm, epsg = _UTM.fullmatch(header), _EPSG.fullmatch(header)
    said = f'{where}: "{shortened(header)}"'
    form = 'e.g. "EPSG:25832", "WGS84 UTM 32N" or "+proj=utm +zone=32 +datum=WGS84"'
    if utm is not None:
        zone = int(utm[1])
        if not 1 <= zone <= 60:
            raise ControlError(f"{said} is no UTM zone, expected 1 to 60; correct it")
        return CRS.from_epsg((32600 if utm[2].upper() == "N" else 32700) + zone)
    if epsg is None and "+proj" not in header:
        if len(header.split()) >= 6:
            raise ControlError(f"{said} is a line of a point, expected the CRS before it, {form}; add it")
        raise ControlError(f"{said} is no CRS that gcp_list.txt may begin with, expected {form}; correct it")
    try:
        return CRS.from_user_input(f"EPSG:{epsg[1]}" if epsg is not None else header.strip("'\""))
    except CRSError as error:
        raise ControlError(f"{said} is not a known CRS, expected {form}; correct it") from error


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _is_gcp_list(path: Path) -> bool:
    try:
        lines = (line.strip() for _, line in text_lines(path, ControlError))
        first = next((line for line in lines if line and not line.startswith("#")), "")
    except ControlError:
        return False
    is_of_points = len(first.split()) >= 6 and all(math.isfinite(_number(cell)) for cell in first.split()[:5])
    return is_of_points or "+proj" in first or any(known.fullmatch(first) for known in (_UTM, _EPSG, _WGS84))


FORMAT = ControlFormat(
    name="OpenDroneMap's gcp_list.txt",
    recognises=lambda path: path.name.casefold() == "gcp_list.txt" or _is_gcp_list(path),
    read=read_gcp_list,
)
