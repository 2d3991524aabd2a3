"""gcp_list.txt and clicks.csv edited mark by mark; every other line, column and comment is kept.

Lines of gcp_list.txt without a name get the one that their point has here when the mark of such a line is removed.
"""

import csv
import io
import warnings
from collections.abc import Iterable
from contextlib import suppress
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pyproj import CRS

from geo.crs import crs_code, horizontal_crs, is_geographic
from geo.errors import UnknownUnit
from geo.transformation import height_scale, transformed
from survey.control.formats import is_of_content, line_cells, mark_line, read_gcp_list
from survey.control.points import Content, GivenPoint
from survey.errors import ConfigError, ControlError
from survey.files.csv_table import column_names, read_table, text_lines
from survey.files.foreign_text import odm_crs
from survey.photos.poses import ImageNames

# Decimals of coordinates in metres and in degrees: to a tenth of a millimetre.
_DECIMALS_M, _DECIMALS_DEG = 4, 9
# Before the last line of a point whose mark was removed: no other line has its coordinates.
_UNMARKED = "# without a mark: "
_COLUMNS = ("image", "x", "y", "name")


class ControlMark(NamedTuple):
    """A mark with its point: the values of a line of gcp_list.txt."""

    point: str
    place: tuple[float, float, float]  # Easting, northing, height in the crs of the survey
    is_check: bool
    image: str
    pixel: tuple[float, float] | None  # The centre of the first pixel is 0.5, 0.5; None: the mark is to be removed


def with_marks(path: Path, marks: Iterable[ControlMark], crs: CRS, images: Iterable[str]) -> str:
    """The text of a gcp_list.txt with some marks set, moved or removed; of a new one, where there is no file."""
    if path.is_file():
        lines = [line for _, line in text_lines(path, ControlError)]
        content = read_gcp_list(path)
    else:
        lines, content = [header_of(crs)], Content()
    head = next(i for i, line in enumerate(lines) if is_of_content(line))
    file_crs = odm_crs(lines[head].strip(), str(path), path.name, ControlError)
    at = [i for i in range(head + 1, len(lines)) if is_of_content(lines[i])]
    names = ImageNames(images)
    image_names = [names.find(mark.view, mark.where) for mark in content.marks]
    marked = list(zip(at, (point.name for point in content.points), image_names, strict=True))
    marks = list(marks)
    removed = {(mark.point, mark.image) for mark in marks if mark.pixel is None}
    # Points without names are numbered in the order of their lines, which a removal may change.
    if any((point, image) in removed and _is_nameless(lines[i]) for i, point, image in marked):
        for i, point, _ in marked:
            lines[i] = "\t".join([*line_cells(lines[i]), point]) if _is_nameless(lines[i]) else lines[i]
    unmarked = {cells[6]: i for i, line in enumerate(lines) if len(cells := _cells_without_mark(line)) > 6}
    kept: dict[int, str | None] = dict(enumerate(lines))
    new = []
    for mark in marks:
        of_point = [line for line, point, _ in marked if point == mark.point]
        of_mark = [line for line, point, image in marked if (point, image) == (mark.point, mark.image)]
        if mark.pixel is not None:
            if of_point:
                cells = line_cells(lines[of_point[0]])
            elif mark.point in unmarked:
                cells = _cells_without_mark(lines[unmarked[mark.point]])
                kept[unmarked[mark.point]] = None
            else:
                cells = [*_coordinates(mark.place, crs, file_crs), *[""] * 3, mark.point, *["check"] * mark.is_check]
            line = mark_line(cells[:3], mark.pixel, mark.image, cells[6:])
            if of_mark:
                kept |= dict.fromkeys(of_mark) | {of_mark[0]: line}
            else:
                new.append(line)
        elif of_mark:
            is_last = of_mark == of_point
            kept |= dict.fromkeys(of_mark) | ({of_mark[0]: _UNMARKED + lines[of_mark[0]]} if is_last else {})
    return "\n".join([*(line for line in kept.values() if line is not None), *new, ""])


def points_without_mark(path: Path) -> list[GivenPoint]:
    """Points of a gcp_list.txt whose last mark was removed."""
    lines = list(text_lines(path, ControlError))
    head = next((line for _, line in lines if is_of_content(line)), "")
    file_crs = odm_crs(head.strip(), str(path), path.name, ControlError)
    points = []
    for number, line in lines:
        cells = _cells_without_mark(line)
        with suppress(ValueError):
            if len(cells) > 6:
                place, where = (float(cells[0]), float(cells[1]), float(cells[2])), f"{path}, line {number}"
                points.append(GivenPoint(cells[6], where, place, file_crs, is_check="check" in cells[7:]))
    return points


def _cells_without_mark(line: str) -> list[str]:
    return line_cells(line.removeprefix(_UNMARKED)) if line.startswith(_UNMARKED) else []


def _is_nameless(line: str) -> bool:
    return len(line_cells(line)) == 6


def header_of(crs: CRS) -> str:
    """The first line of a gcp_list.txt in the CRS of a survey: its horizontal part, as OpenDroneMap reads it.

    Where plan and heights have different units, the whole CRS is written, which alone states that of the heights.
    """
    plan = horizontal_crs(crs)
    try:
        height_scale(plan, crs, "heights")
    except UnknownUnit:
        plan = crs
    code = crs_code(plan) or ""
    if code.startswith("EPSG:"):
        return code
    with warnings.catch_warnings():
        # That a PROJ string has no name of the datum, which is that of the survey.
        warnings.simplefilter("ignore", UserWarning)
        return plan.to_proj4()


def _coordinates(place: tuple[float, float, float], crs: CRS, file_crs: CRS) -> list[str]:
    """Coordinates in the crs of a survey as texts in that of a file: the inverse of its reader."""
    at = np.array([place])
    if not horizontal_crs(file_crs).equals(horizontal_crs(crs), ignore_axis_order=True):
        at = transformed(crs, file_crs, at, "points of the survey in the CRS of gcp_list.txt", "or give both the same")
    at[:, 2] /= height_scale(file_crs, crs, "the heights of gcp_list.txt")
    decimals = _DECIMALS_DEG if is_geographic(file_crs) else _DECIMALS_M
    east, north, height = at[0].tolist()
    return [f"{east:.{decimals}f}", f"{north:.{decimals}f}", f"{height:.{_DECIMALS_M}f}"]


class ClickRow(NamedTuple):
    """A row of clicks.csv: photograph of the survey (None: not in it), pixel, name of the point, all cells."""

    image: str | None
    pixel: tuple[float, float]
    name: str
    cells: dict[str, str]


def read_clicks(path: Path, images: Iterable[str]) -> list[ClickRow]:
    """The rows of a table of clicks; none where there is no file."""
    if not path.is_file():
        return []
    others = tuple(name for name in column_names(path) if name not in _COLUMNS)
    names, clicks = ImageNames(images), []
    for row in read_table(path, _COLUMNS, optional=others, error=ConfigError):
        # The decimal comma goes with the separators of the file.
        cells = row.cells | {"x": f"{row.number('x'):.10g}", "y": f"{row.number('y'):.10g}"}
        if cells.get("std"):
            cells["std"] = f"{row.number('std'):.10g}"
        pixel = (row.number("x"), row.number("y"))
        clicks.append(ClickRow(names.find(row.text("image"), row.where), pixel, row.text("name"), cells))
    return clicks


def with_click(path: Path, name: str, image: str, pixel: tuple[float, float] | None, images: Iterable[str]) -> str:
    """The text of a table of clicks with the click on a point in a photograph set, or removed (pixel None)."""
    rows = read_clicks(path, images)
    is_it = [(row.name, row.image) == (name, image) for row in rows]
    at = is_it.index(True) if any(is_it) else len(rows)
    before = rows[at].cells if any(is_it) else {"image": image, "name": name}
    # A place has one click in a photograph.
    cells = [row.cells for row, is_one in zip(rows, is_it, strict=True) if not is_one]
    if pixel is not None:
        cells.insert(at, before | {"x": f"{pixel[0]:.3f}", "y": f"{pixel[1]:.3f}"})
    lines = [line for _, line in text_lines(path, ConfigError)] if path.is_file() else []
    comments = takewhile(lambda line: not line.strip() or line.lstrip().startswith("#"), lines)
    written = io.StringIO()
    table = csv.DictWriter(written, (lines and column_names(path)) or _COLUMNS, restval="", lineterminator="\n")
    table.writeheader()
    table.writerows(cells)
    return "".join(f"{line}\n" for line in comments) + written.getvalue()
