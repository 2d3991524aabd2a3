"""Tables of control: coordinates of points, marks in photographs, check points; also as Metashape writes them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pyproj import CRS

from geo.crs import horizontal_crs
from survey.control.points import Content, ControlFormat, GivenMark, GivenPoint, is_check_role, require_std
from survey.errors import ControlError
from survey.files.crs_lines import crs_of_comment
from survey.files.csv_table import Row, Table, column_names, words_of
from survey.files.point_table import (
    PLACE,
    STDS,
    WORDS,
    Units,
    accuracy_warnings,
    has_depths,
    point_table,
    read_points,
    require_exact,
    stated_units,
)

# Names of the columns in other programs.
_MARK_WORDS = words_of({
    "image": ("photo", "photograph", "file", "filename", "camera", "image_name"),
    "name": ("label", "point", "gcp", "marker", "point name", "point_name"),
    "x": ("px", "u", "x_px", "pixel_x", "col"),
    "y": ("py", "v", "y_px", "pixel_y", "row"),
})  # fmt: skip
_MARK_COLUMNS = ("image", "name", "x", "y")


def read_coordinates(path: Path) -> Content:
    """The points of a table ``name,easting,northing,height``, with their accuracy and role if it has these."""
    columns, optional = ("name", *PLACE), ("std", "std_horizontal", *STDS, "role", "enable")
    table = point_table(path, ControlError)
    rows = read_points(table, optional=("name", *optional))
    require_exact(rows, table)
    if rows and "name" not in table.names:
        raise ControlError(f"{path}: the first line has no column name, expected {','.join(columns)}; add it")
    crs, units = crs_of_comment(path, ControlError), stated_units(table)
    points = tuple(replace(_point(row, crs), units=units) for row in rows)
    return Content(points, warnings=accuracy_warnings(table))


def read_marks(path: Path) -> Content:
    """The marks of a table ``image,name,x,y``; the centre of the first pixel is 0.5, 0.5."""
    rows = Table.read(path, _MARK_WORDS, ControlError).rows(_MARK_COLUMNS)
    marks = (
        GivenMark(row.text("name"), row.text("image"), row.where, (row.number("x"), row.number("y"))) for row in rows
    )
    return Content(marks=tuple(marks))


def read_checkpoints(path: Path, level: float | None = None, survey_crs: CRS | None = None) -> tuple[GivenPoint, ...]:
    """The points of a table ``easting,northing,height``, numbered where it has no names.

    Depths count from the ``level`` of the water in the crs of the survey, where it has one.
    """
    table, crs, units = point_table(path, ControlError), crs_of_comment(path, ControlError), None
    if survey_crs is not None and has_depths(table):
        # Depths become heights of the survey; heights have the unit that the file states.
        crs = None if crs is None else horizontal_crs(crs)
        units = Units(Units.of(crs or survey_crs).plan_m, Units.of(survey_crs).height_m)
    rows = read_points(table, level=level, give_level="give [water] level_m", units=units)
    require_exact(rows, table)
    stated = stated_units(table) if units is None else Units(height_m=units.height_m)
    if not rows:
        raise ControlError(f"{path} has no check points, expected lines name,easting,northing,height; add them")
    points: dict[str, GivenPoint] = {}
    for i, row in enumerate(rows, start=1):
        point = GivenPoint(row.cells.get("name") or str(i), row.where, _place(row), crs, is_check=True, units=stated)
        first = points.setdefault(point.name, point)
        if first is not point:
            raise ControlError(f"{row.where}: check point {point.name} is in {first.where} too; remove or rename one")
    return tuple(points.values())


def _point(row: Row, crs: CRS | None) -> GivenPoint:
    # Metashape adjusts to enabled points, and uses the others as check points.
    is_ticked = row.cells.get("enable", "").casefold() not in ("0", "false")
    is_check = is_check_role(row.cells.get("role", ""), row.where) or not is_ticked
    return GivenPoint(row.text("name"), row.where, _place(row), crs, std_m=_std(row), is_check=is_check)


def _place(row: Row) -> tuple[float, float, float]:
    easting, northing, height = (row.number(name) for name in PLACE)
    return easting, northing, height


def _std(row: Row) -> tuple[float, float, float] | None:
    for names in (STDS, ("std_horizontal", "std_horizontal", "std_height")):
        if all(row.cells.get(name) for name in names):
            east, north, up = (row.number(name) for name in names)
            return require_std((east, north, up), row.where)
    if row.cells.get("std"):
        std = row.number("std")
        return require_std((std, std, std), row.where)
    return None


def _has(path: Path, columns: tuple[str, ...], words: dict[str, str]) -> bool:
    return set(columns) <= set(column_names(path, words))


MARKS = ControlFormat(
    name="a table image,name,x,y of marks",
    recognises=lambda path: _has(path, _MARK_COLUMNS, _MARK_WORDS),
    read=read_marks,
)
COORDINATES = ControlFormat(
    name="a table name,easting,northing,height",
    recognises=lambda path: path.suffix.casefold() == ".csv" or _has(path, ("name", *PLACE), WORDS),
    read=read_coordinates,
)
