"""Tables of points: easting, northing, height, under whatever names the trade has for them, in any order of columns.

One reader for check points, control and points of the water surface: columns are taken by their names, and by their
place only where a file has numbers alone.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from survey.errors import SurveyError
from survey.files.csv_table import Row, column_names, first_cells, read_table, shortened

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
        ("h", "z", "z/altitude", "z/height", "altitude", "alt", "elevation", "elev", "up", "hgt"), "height"
    ),
    **dict.fromkeys(("accuracy", "sigma", "accuracy_x/y/z_(m)", "accuracy_(m)", "std_m", "stddev", "sd"), "std"),
    **dict.fromkeys(("accuracy_x/y_(m)", "accuracy_x/y/_(m)"), "std_horizontal"),
    **dict.fromkeys(("std_e", "accuracy_x_(m)", "accuracy_x/easting_(m)", "accuracy_x"), "std_east"),
    **dict.fromkeys(("std_n", "accuracy_y_(m)", "accuracy_y/northing_(m)", "accuracy_y"), "std_north"),
    **dict.fromkeys(
        ("std_h", "std_up", "accuracy_z_(m)", "accuracy_z/altitude_(m)", "accuracy_z", "std_z"), "std_height"
    ),
    **dict.fromkeys(("depths", "true_depth", "water_depth", "sounding"), "depth"),
    **dict.fromkeys(("type", "use"), "role"),
    **dict.fromkeys(("enabled",), "enable"),
}
_UNITS = ("_m", " (m)", " [m]", "(m)", "[m]")
# Other words for a height, of which a table has one alone, or says which counts.
_HEIGHTS = ("ellipsoidal", "orthometric", "geoid height", "ellipsoidal_height", "orthometric_height", "depth")
_DEGREES = ("lon", "lat")
# A standard deviation in the fourth place is no more than this [m]; a northing is.
_MOST_STD_M = 10.0


def read_points(
    path: Path,
    *,
    optional: Sequence[str] = ("name",),
    by_place: bool = False,
    level: float | None = None,
    give_level: str = "",
    error: type[SurveyError],
) -> list[Row]:
    """Rows of a table of points with the columns of `PLACE`, and the ``optional`` ones.

    Depths become heights where the level of the water is known.

    Parameters
    ----------
    path : Path
    optional : names
    by_place : bool
        Whether a file of numbers alone is taken as easting, northing, height and, in a fourth column, std.
    level : float, optional
        Of the water that depths count from, in the heights of crs.
    give_level : str
        How it is given, for a message, e.g. "give --water-level".
    error : type
        What is raised.

    Raises
    ------
    SurveyError
        Where columns are missing, or two have the same meaning; as `survey.files.csv_table.read_table`.
    """
    synonyms = _synonyms_for(path, error)
    if by_place and _is_of_numbers(path, error):
        return read_table(path, PLACE, optional=("std",), header=False, error=error)
    names = column_names(path, synonyms)
    found = shortened(", ".join(names)) or "nothing"
    _require_one_height(path, synonyms, error)
    if has_depths(path):
        if level is None:
            mend = f"{give_level}, or subtract" if give_level else "subtract"
            raise error(
                f"{path} has depths, expected heights in crs: {mend} them from the level of the water they count from, "
                "and call the column height"
            )
        columns = (*PLACE[:2], "depth")
        rows = read_table(path, columns, optional=optional, synonyms=synonyms, error=error)
        return _above(rows, level, path, error)
    missing = [name for name in PLACE if name not in names]
    if missing:
        raise error(
            f"{path}: the first line has no column {', '.join(missing)}; expected easting, northing, height (or E, N, "
            f"Z; X, Y, Z; longitude, latitude, altitude), in any order, found {found}"
        )
    return read_table(path, PLACE, optional=optional, synonyms=synonyms, error=error)


def _synonyms_for(path: Path, error: type[SurveyError]) -> dict[str, str]:
    """The names that count in a table: of one with grid coordinates and degrees, those of the grid."""
    synonyms = _with_units()
    called = {cell for cell in first_cells(path, error) if synonyms.get(cell, cell) in PLACE[:2]}
    degrees = {cell for cell in called if cell.startswith(_DEGREES)}
    if {synonyms.get(cell, cell) for cell in called - degrees} >= set(PLACE[:2]):
        # Their own names again, which no column is asked for by.
        return {**synonyms, **{cell: cell for cell in degrees}}
    return synonyms


def has_depths(path: Path) -> bool:
    """Whether a table has depths and no heights."""
    names = column_names(path, _with_units())
    return "depth" in names and "height" not in names


def _above(rows: Sequence[Row], level: float, path: Path, error: type[SurveyError]) -> list[Row]:
    """Rows with heights in place of depths below a level."""
    depths = [row.number("depth") for row in rows]
    if rows and statistics.median(depths) < 0.0:
        raise error(
            f"{path} has a column depth whose numbers are negative ({depths[0]:g}), expected depths that count down "
            "from the water; change their sign, or call the column height if they are heights in crs"
        )
    return [
        replace(row, cells=row.cells | {"height": repr(level - depth)}) for row, depth in zip(rows, depths, strict=True)
    ]


def _with_units() -> dict[str, str]:
    words = {**SYNONYMS, **{name: name for name in (*PLACE, "std", "depth")}}
    return SYNONYMS | {f"{word}{unit}": name for word, name in words.items() for unit in _UNITS}


def _require_one_height(path: Path, synonyms: dict[str, str], error: type[SurveyError]) -> None:
    """Raise where two columns are heights, or one is and another a depth."""
    called = [cell for cell in first_cells(path, error) if synonyms.get(cell, cell) == "height" or cell in _HEIGHTS]
    if len(called) > 1:
        raise error(
            f"{path} has {len(called)} columns of heights, {' and '.join(called)}; keep the one that counts in the "
            "heights of crs, and call it height"
        )


def _is_of_numbers(path: Path, error: type[SurveyError]) -> bool:
    """Whether the first line is no line of words; raises where such a table cannot be taken by place."""
    cells = first_cells(path, error)
    numbers = [_number(cell) for cell in cells]
    if not any(math.isfinite(number) for number in numbers):
        return False
    is_plain = len(cells) in (3, 4) and all(math.isfinite(number) for number in numbers)
    if not is_plain or (len(cells) == 4 and not 0.0 <= numbers[3] <= _MOST_STD_M):
        raise error(
            f"{path} has {len(cells)} columns without names ({shortened(', '.join(cells))}), expected easting, "
            "northing, height and perhaps a standard deviation in metres; name the columns in a first line"
        )
    return True


def _number(text: str) -> float:
    try:
        return float(text.replace(",", ".", 1))
    except ValueError:
        return math.nan
