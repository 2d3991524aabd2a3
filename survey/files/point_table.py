"""Tables of points: easting, northing, height, under whatever names the trade has for them, in any order of columns.

One reader for check points, control and points of the water surface: columns are taken by their names, and by their
place only where a file has numbers alone. A unit in the name of a column counts.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from geo.errors import GeoError
from geo.values import is_no_data_value, rounded_coordinates
from survey.errors import SurveyError
from survey.files.column_units import Units, common_unit_m, meaning
from survey.files.csv_table import Row, column_names, first_cells, number_of, read_table, shortened

PLACE = ("easting", "northing", "height")
STDS = ("std_east", "std_north", "std_height")
# What programs and surveyors call the columns.
SYNONYMS = {
    **dict.fromkeys(
        ("label", "point", "gcp", "id", "point name", "point_name", "#label", "p", "no", "nr", "pt"), "name"
    ),
    **dict.fromkeys(("e", "east", "x", "x/easting", "x/east", "x/longitude", "longitude", "lon"), "easting"),
    **dict.fromkeys(("n", "north", "y", "y/northing", "y/north", "y/latitude", "latitude", "lat"), "northing"),
    **dict.fromkeys(
        (
            "h",
            "z",
            "z/altitude",
            "z/height",
            "altitude",
            "alt",
            "elevation",
            "elev",
            "up",
            "hgt",
            "bed_elevation",
            "bottom_elevation",
        ),
        "height",
    ),
    **dict.fromkeys(("accuracy", "sigma", "accuracy_x/y/z_(m)", "accuracy_(m)", "std_m", "stddev", "sd"), "std"),
    **dict.fromkeys(("accuracy_x/y_(m)", "accuracy_x/y/_(m)"), "std_horizontal"),
    **dict.fromkeys(("std_e", "accuracy_x_(m)", "accuracy_x/easting_(m)", "accuracy_x"), "std_east"),
    **dict.fromkeys(("std_n", "accuracy_y_(m)", "accuracy_y/northing_(m)", "accuracy_y"), "std_north"),
    **dict.fromkeys(
        ("std_h", "std_up", "accuracy_z_(m)", "accuracy_z/altitude_(m)", "accuracy_z", "std_z"), "std_height"
    ),
    **dict.fromkeys(("depths", "true_depth", "water_depth", "sounding"), "depth"),
    # Of the water over each point, where depths count from.
    **dict.fromkeys(("wse", "ws_elev", "water_level", "water_surface", "water_surface_elevation"), "level"),
    **dict.fromkeys(("class", "classification", "scalar_classification"), "classification"),
    **dict.fromkeys(("type", "use"), "role"),
    **dict.fromkeys(("enabled",), "enable"),
}
_STDS = ("std", "std_horizontal", *STDS)
_WORDS = SYNONYMS | {name: name for name in (*PLACE, *_STDS, "depth", "level")}
# Other words for a height, of which a table has one alone, or says which counts.
_HEIGHTS = ("ellipsoidal", "orthometric", "geoid height", "ellipsoidal_height", "orthometric_height")
_DEGREES = ("lon", "lat")
# Levels of one survey [in units of height]: a river falls by less over it.
_MOST_APART = 50.0
# A standard deviation in the fourth place is no more than this [m]; a northing is.
_MOST_STD_M = 10.0
# Of one point measured again the heights differ by less [m]; of a place with more points than so many a few are named.
_SAME_HEIGHT_M, _MOST_NAMED = 0.1, 3


def read_points(
    path: Path,
    *,
    optional: Sequence[str] = ("name",),
    by_place: bool = False,
    level: float | None = None,
    give_level: str = "",
    units: Units | None = None,
    error: type[SurveyError],
) -> list[Row]:
    """Rows of a table of points with the columns of `PLACE`, and the ``optional`` ones.

    Depths become heights where the level of the water is known, from a column of the table, with a level on each row,
    or else as given; standard deviations are in metres. Beside a height a level counts for nothing.

    Parameters
    ----------
    optional : names
    by_place : bool
        Whether a file of numbers alone is taken as easting, northing, height and, in a fourth column, std.
    level : float, optional
        Of the water that depths count from, in the heights of crs.
    give_level : str
        How it is given, for a message, e.g. "give --water-level".
    units : Units, optional
        Of the CRS of the points, which heights and depths get where the table has them in others. Without it heights
        stay as they are: `stated_units`.
    error : type
        What is raised.

    Raises
    ------
    SurveyError
        Where columns are missing, two have the same meaning, or eastings are in another unit; as
        `survey.files.csv_table.read_table`.
    """
    synonyms, stated = _synonyms_for(path, error), stated_units(path, error)
    if by_place and _is_of_numbers(path, error):
        return _refuse_no_data(read_table(path, PLACE, optional=("std",), header=False, error=error), "height", error)
    names = column_names(path, synonyms)
    found = shortened(", ".join(names)) or "nothing"
    _require_one_column(path, synonyms, error)
    stated = stated if units is None else stated.meant(units)
    fault = None if units is None else stated.plan_fault(units)
    if fault is not None:
        raise error(f"{path}: {fault}; convert them")
    factor = 1.0 if units is None else stated.height_factor(units)
    if has_depths(path):
        has_levels = "level" in names
        if level is None and not has_levels:
            remedy = f"{give_level}, or subtract" if give_level else "subtract"
            raise error(
                f"{path} has depths, expected heights in crs: {remedy} them from the level of the water they count "
                "from, and call the column height"
            )
        heights = ("depth", "level") if has_levels else ("depth",)
        rows = read_table(path, (*PLACE[:2], *heights), optional=optional, synonyms=synonyms, error=error)
        for name in heights:
            rows = _scaled(_refuse_no_data(rows, name, error), name, factor)
        _require_near(rows, level, path, error)
        return _in_metres(_above(rows, level, path, error), path, error)
    missing = [name for name in PLACE if name not in names]
    if missing:
        raise error(
            f"{path}: the first line has no column {', '.join(missing)}; expected easting, northing, height (or E, N, "
            f"Z; X, Y, Z; longitude, latitude, altitude), in any order, found {found}"
        )
    rows = _refuse_no_data(read_table(path, PLACE, optional=optional, synonyms=synonyms, error=error), "height", error)
    return _in_metres(_scaled(rows, "height", factor), path, error)


def stated_units(path: Path, error: type[SurveyError]) -> Units:
    """Units that the names of the columns of a table give its coordinates, depths among them.

    Raises
    ------
    SurveyError
        Where easting and northing have two units, or one of them has none.
    """
    synonyms = _synonyms_for(path, error)
    words = [(cell, known) for cell in first_cells(path, error) if (known := meaning(cell, _WORDS)) is not None]
    # Not those of degrees beside grid coordinates.
    found = {name: unit for cell, (name, unit) in words if synonyms.get(cell, cell) == name}
    plan = common_unit_m(found, (PLACE[0], PLACE[1]), path, error)
    if has_depths(path) and "level" in found:
        common_unit_m(found, ("depth", "level"), path, error)
    return Units(plan, found.get("height" if "height" in found else "depth"))


def _in_metres(rows: Sequence[Row], path: Path, error: type[SurveyError]) -> list[Row]:
    """Rows with standard deviations in metres, whose columns may name another unit."""
    units = {known[0]: known[1] for cell in first_cells(path, error) if (known := meaning(cell, _WORDS)) is not None}
    done = list(rows)
    for name in _STDS:
        done = _scaled(done, name, units.get(name) or 1.0)
        for row in done:
            if row.cells.get(name) and row.number(name) > _MOST_STD_M:
                raise error(
                    f"{row.where}: {name} is {row.number(name):g} m, expected at most {_MOST_STD_M:g} m; name its unit "
                    f"in the first line, e.g. {name}_mm, or correct it"
                )
    return done


def require_exact(rows: Sequence[Row], path: Path, error: type[SurveyError]) -> None:
    """Raise where places went through single precision or too few digits, which leaves steps of metres."""
    places = np.array([[row.number(name) for name in PLACE] for row in rows]).reshape(-1, 3)
    try:
        rounded_coordinates(places, None, path)
    except GeoError as found:
        raise error(str(found)) from found


def several_heights(names: Sequence[str], places: np.ndarray, height_unit_m: float = 1.0) -> list[str]:
    """Points at one place in plan whose heights differ, of places (N, 3), e.g. "a (5.00) and b (5.30)"."""
    _, place, count = np.unique(places[:, :2], axis=0, return_inverse=True, return_counts=True)
    several = []
    for of_place in np.flatnonzero(count > 1):
        rows = np.flatnonzero(place.ravel() == of_place)
        if np.ptp(places[rows, 2]) * height_unit_m > _SAME_HEIGHT_M:
            several.append(" and ".join(f"{names[i]} ({places[i, 2]:.2f})" for i in rows[:_MOST_NAMED]))
    return several


def _scaled(rows: Sequence[Row], name: str, factor: float) -> list[Row]:
    """Rows with the numbers of a column times a factor; empty cells stay."""
    if factor == 1.0:
        return list(rows)
    return [
        replace(row, cells=row.cells | {name: repr(row.number(name) * factor)}) if row.cells.get(name) else row
        for row in rows
    ]


def _refuse_no_data(rows: Sequence[Row], name: str, error: type[SurveyError]) -> list[Row]:
    """Rows as they are; raises where a height, or a depth, is what programs write that have none."""
    for row in rows:
        places = [row.number(each) for each in (*PLACE[:2], name)]
        if is_no_data_value(places[2]):
            raise error(f"{row.where}: the {name} is {row.cells[name]}, a no-data value; remove the line")
    return list(rows)


def _synonyms_for(path: Path, error: type[SurveyError]) -> dict[str, str]:
    """The names that count in a table: of one with grid coordinates and degrees, those of the grid."""
    synonyms = _with_units(first_cells(path, error))
    plan_columns = {cell for cell in first_cells(path, error) if synonyms.get(cell, cell) in PLACE[:2]}
    degrees = {cell for cell in plan_columns if cell.startswith(_DEGREES)}
    if {synonyms.get(cell, cell) for cell in plan_columns - degrees} >= set(PLACE[:2]):
        # Their own names again, which no column is asked for by.
        return {**synonyms, **{cell: cell for cell in degrees}}
    return synonyms


def has_depths(path: Path) -> bool:
    """Whether a table has depths and no heights."""
    try:
        names = column_names(path, _with_units(first_cells(path, SurveyError)))
    except SurveyError:
        return False
    return "depth" in names and "height" not in names


def _above(rows: Sequence[Row], level: float | None, path: Path, error: type[SurveyError]) -> list[Row]:
    """Rows with heights in place of depths below their own levels, or else below one for all."""
    depths = [row.number("depth") for row in rows]
    if rows and statistics.median(depths) < 0.0:
        raise error(
            f"{path} has a column depth whose numbers are negative ({depths[0]:g}), expected depths that count down "
            "from the water; change their sign, or call the column height if they are heights in crs"
        )
    levels = [row.number("level", default=None if "level" in row.cells else level) for row in rows]
    return [
        replace(row, cells=row.cells | {"height": repr(own - depth)})
        for row, own, depth in zip(rows, levels, depths, strict=True)
    ]


def _require_near(rows: Sequence[Row], level: float | None, path: Path, error: type[SurveyError]) -> None:
    """Raise where the levels of a table are far from that of the water: readings of a gauge, of another datum."""
    if level is None or not rows or "level" not in rows[0].cells:
        return
    own = statistics.median(row.number("level") for row in rows)
    if abs(own - level) > _MOST_APART:
        raise error(
            f"{path} has levels of the water about {own:g} beside its depths, and the water stands at {level:g}; give "
            "levels in the heights of crs, or remove the column so that all depths count from that level"
        )


def _with_units(cells: Sequence[str]) -> dict[str, str]:
    """The words that columns are known by, with these names of columns that have a unit behind them."""
    return SYNONYMS | {cell: known[0] for cell in cells if (known := meaning(cell, _WORDS)) is not None}


def _require_one_column(path: Path, synonyms: dict[str, str], error: type[SurveyError]) -> None:
    """Raise where two columns have one meaning: of heights also where one is a height and another a depth."""
    cells = first_cells(path, error)
    for name in (*PLACE[:2], "depth", *(("level",) if has_depths(path) else ())):
        twice = [cell for cell in cells if synonyms.get(cell, cell) == name]
        if len(twice) > 1:
            raise error(
                f"{path} has {len(twice)} columns that may be the {name}, {' and '.join(twice)}; keep the one that "
                f"counts in crs, and call it {name}"
            )
    height_columns = [cell for cell in cells if synonyms.get(cell, cell) in ("height", "depth") or cell in _HEIGHTS]
    if len(height_columns) > 1:
        raise error(
            f"{path} has {len(height_columns)} columns of heights, {' and '.join(height_columns)}; keep the "
            "one that counts in the heights of crs, and call it height"
        )


def _is_of_numbers(path: Path, error: type[SurveyError]) -> bool:
    """Whether the first line is not a line of words; raises where such a table cannot be taken by place."""
    cells = first_cells(path, error)
    numbers = [number_of(cell, ",") for cell in cells]
    if not any(math.isfinite(number) for number in numbers):
        return False
    is_plain = len(cells) in (3, 4) and all(math.isfinite(number) for number in numbers)
    if not is_plain or (len(cells) == 4 and not 0.0 <= numbers[3] <= _MOST_STD_M):
        raise error(
            f"{path} has {len(cells)} columns without names ({shortened(', '.join(cells))}), expected easting, "
            "northing, height and perhaps a standard deviation in metres; name the columns in a first line"
        )
    return True
