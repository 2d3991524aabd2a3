"""Tables of points: easting, northing, height, under whatever names the trade has for them, in any order of columns.

One reader for check points, control and points of the water surface: columns are taken by their names, and by their
place only where a file has numbers alone. A unit in the name of a column counts.
"""

from __future__ import annotations

import math
import re
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.crs import US_SURVEY_FOOT_M, has_height, height_unit_m, horizontal_unit, is_geographic
from geo.errors import GeoError
from geo.reading import is_no_data_value, rounded_coordinates
from survey.errors import SurveyError
from survey.files.csv_table import Column, Row, Table, UnspecifiedFoot, number_of, same_unit, words_of

PLACE = ("easting", "northing", "height")
STDS = ("std_east", "std_north", "std_height")
_ALL_STDS = ("std", "std_horizontal", *STDS)
# What programs and surveyors call the columns. RMS and SD of receivers are standard deviations of one coordinate.
WORDS = words_of({
    "name": ("label", "point", "gcp", "id", "point name", "point_name", "#label", "p", "no", "nr", "pt"),
    "easting": ("e", "east", "x", "x/easting", "x/east", "x/longitude", "longitude", "lon"),
    "northing": ("n", "north", "y", "y/northing", "y/north", "y/latitude", "latitude", "lat"),
    "height": ("h", "z", "z/altitude", "z/height", "altitude", "alt", "elevation", "elev", "up", "hgt",
               "bed_elevation", "bottom_elevation"),
    "std": ("accuracy", "sigma", "accuracy_x/y/z_(m)", "accuracy_(m)", "std_m", "stddev", "sd", "rms"),
    "std_horizontal": ("accuracy_x/y_(m)", "accuracy_x/y/_(m)", "hrms", "horizontal rms", "lateral rms"),
    "std_east": ("std_e", "accuracy_x_(m)", "accuracy_x/easting_(m)", "accuracy_x", "easting rms", "rms_e", "sde",
                 "longitude rms", "east rms"),
    "std_north": ("std_n", "accuracy_y_(m)", "accuracy_y/northing_(m)", "accuracy_y", "northing rms", "rms_n", "sdn",
                  "latitude rms", "north rms"),
    "std_height": ("std_h", "std_up", "accuracy_z_(m)", "accuracy_z/altitude_(m)", "accuracy_z", "std_z", "vrms",
                   "elevation rms", "height rms", "ellipsoidal height rms", "vertical rms", "rms_h", "rms_u", "sdu"),
    "depth": ("depths", "true_depth", "water_depth", "sounding"),
    # Of the water over each point, where depths count from.
    "level": ("wse", "ws_elev", "water_level", "water_surface", "water_surface_elevation"),
    "classification": ("class", "scalar_classification"),
    "role": ("type", "use"), "enable": ("enabled",),
    "solution": ("solution status", "solution_status", "solution type", "fix", "fix type", "fix_type", "fix status"),
    "layer": ("code", "feature", "feature code", "description", "desc", "point code"),
})  # fmt: skip
# Other words for a height, of which a table has one alone, or says which counts.
_HEIGHTS = ("ellipsoidal", "orthometric", "geoid height", "ellipsoidal_height", "orthometric_height")
_ACCURACY = re.compile(r"rms|sigma|std|accura|precis|uncert|\bcq\b|\bcep\b|\bsd[enuh]?\b|quality")
# Solutions of a receiver that are as good as its carrier phase: what else there is has decimetres or metres.
_FIXED = ("fix", "fixed", "rtk fixed", "rtk fix", "rtk_fixed", "integer", "4", "1", "yes", "true", "ppk fixed")
# Levels of one survey [in units of height]: a river falls by less over it.
_MOST_APART = 50.0
# A standard deviation in the fourth place is no more than this [m]; a northing is.
_MOST_STD_M = 10.0
# Of one point measured again the heights differ by less [m]; of a place with more points than so many a few are named.
_SAME_HEIGHT_M, _MOST_NAMED = 0.1, 3
_FEET = (0.3048, US_SURVEY_FOOT_M)
# Of soundings that `bathynerf export` wrote: the height counts, and the depth below the water is its own.
_OF_SOUNDINGS = ["height", "depth_m"]


@dataclass(frozen=True)
class Units:
    # plan_m, height_m [m] or None: None where nothing says them, and of degrees
    plan_m: float | None = None
    height_m: float | None = None

    @staticmethod
    def of(crs: CRS | None, heights: CRS | None = None) -> Units:
        """Units of a CRS, with those of another one's heights where it has none; metres by default."""
        heights = crs if heights is None or (crs is not None and has_height(crs)) else heights
        height = height_unit_m(heights) if heights is not None and has_height(heights) else 1.0
        if crs is None:
            return Units(1.0, height)
        return Units(None if is_geographic(crs) else horizontal_unit(crs), height)

    def meant(self, target: Units) -> Units:
        """These units, with a foot of unknown kind taken as that of the target, where the target has feet."""

        def one(stated: float | None, own: float | None) -> float | None:
            is_foot = own is not None and any(same_unit(own, foot) for foot in _FEET)
            return own if isinstance(stated, UnspecifiedFoot) and is_foot else stated

        return Units(one(self.plan_m, target.plan_m), one(self.height_m, target.height_m))

    def height_factor(self, target: Units) -> float:
        """Factor that converts heights in these units to those of the target; 1 where either is not known."""
        return 1.0 if self.height_m is None or target.height_m is None else self.height_m / target.height_m

    def plan_fault(self, target: Units) -> str | None:
        """Fault of the unit of eastings and northings, whose CRS has those of the target; None for none.

        Examples
        --------
        >>> Units(plan_m=0.3048).plan_fault(Units(1.0, 1.0))
        'eastings and northings are in units of 0.3048 m by the names of their columns, expected 1 m as in the CRS'
        """
        if self.plan_m is None or (target.plan_m is not None and same_unit(self.plan_m, target.plan_m)):
            return None
        message = "degrees" if target.plan_m is None else f"{target.plan_m:.10g} m"
        return (
            f"eastings and northings are in units of {self.plan_m:.10g} m by the names of their columns, expected "
            f"{message} as in the CRS"
        )


def point_table(path: Path, error: type[SurveyError]) -> Table:
    """The head of a table of points; of one with grid coordinates and degrees, the grid counts."""
    table = Table.read(path, WORDS, error)
    degrees = {c for c in table.columns if c.cell.startswith(("lon", "lat")) and c.name in PLACE[:2]}
    if set(PLACE[:2]) <= {c.name for c in table.columns if c not in degrees}:
        # Their own names again, which no column is asked for by.
        columns = (replace(c, name=c.cell, unit_m=None) if c in degrees else c for c in table.columns)
        return replace(table, columns=tuple(columns))
    return table


def read_points(
    table: Table,
    *,
    optional: Sequence[str] = ("name",),
    by_place: bool = False,
    level: float | None = None,
    give_level: str = "",
    units: Units | None = None,
) -> list[Row]:
    """Rows of a table of points with the columns of `PLACE`, and the ``optional`` ones.

    Depths become heights where the level of the water is known, from a column of the table, with a level on each row,
    or else as given (`give_level` says how, for a message); standard deviations are in metres. Beside a height a level
    counts for nothing. ``by_place`` takes a file of numbers alone as easting, northing, height and std. Heights get the
    ``units`` of the CRS; without it they stay as they are: `stated_units`. Raises where columns are missing, two
    have one meaning, eastings are in another unit, or a height stands for no data.
    """
    path, error = table.path, table.error
    heights: tuple[str, ...] = ("height",)
    if by_place and not table.columns and table.first:
        factors, rows = dict[str, float](), _by_place(table).rows(PLACE, ("std",))
    else:
        names, stated = table.names, stated_units(table)
        _require_one_column(table)
        stated = stated if units is None else stated.meant(units)
        if units is not None and (fault := stated.plan_fault(units)) is not None:
            raise error(f"{path}: {fault}; convert them")
        if has_depths(table):
            heights = ("depth", *(["level"] if "level" in names else []))
        if heights == ("depth",) and level is None:
            remedy = f"{give_level}, or subtract" if give_level else "subtract"
            raise error(
                f"{path} has depths, expected heights in crs: {remedy} them from the level of the water they count "
                "from, and call the column height"
            )
        if missing := [name for name in (*PLACE[:2], *heights) if name not in names]:
            raise error(
                f"{path}: the first line has no column {', '.join(missing)}; expected easting, northing, height (or E, "
                f"N, Z; X, Y, Z; longitude, latitude, altitude), in any order, found "
                f"{', '.join(names or table.first) or 'nothing'}"
            )
        rows = table.rows((*PLACE[:2], *heights), optional)
        factors = dict.fromkeys(heights, 1.0 if units is None else stated.height_factor(units))
        factors |= {name: unit for name, unit in table.units.items() if name in _ALL_STDS}
    for row in rows:
        for name in (*PLACE[:2], *heights):
            if is_no_data_value(row.number(name)) and name in heights:
                raise error(f"{row.where}: the {name} is {row.cells[name]}, a no-data value; remove the line")
    rows = [row.multiplied(factors) for row in rows]
    for row in rows:
        for name in _ALL_STDS:
            if factors and row.cells.get(name) and row.number(name) > _MOST_STD_M:
                raise error(
                    f"{row.where}: {name} is {row.number(name):g} m, expected at most {_MOST_STD_M:g} m; name its unit "
                    f"in the first line, e.g. {name}_mm, or correct it"
                )
    return rows if heights == ("height",) else _above(rows, level, table)


def stated_units(table: Table) -> Units:
    """Units that the names of the columns of a table give its coordinates, depths among them."""
    if has_depths(table) and "level" in table.units:
        table.common_unit_m("depth", "level")
    height = "height" if "height" in table.names else "depth"
    return Units(table.common_unit_m(*PLACE[:2]), table.units.get(height))


def has_depths(table: Table) -> bool:
    """Whether a table has depths and no heights."""
    return "depth" in table.names and "height" not in table.names


def accuracy_warnings(table: Table) -> tuple[str, ...]:
    """Warnings where a table of points states an accuracy in columns that are not read, or no fixed solution."""
    unread = [c.cell for c in table.columns if c.name == c.cell not in WORDS and _ACCURACY.search(c.cell)]
    warnings = []
    if unread and not set(_ALL_STDS) & set(table.names):
        warnings.append(
            f"{table.path.name} has the column{'s' if len(unread) > 1 else ''} {', '.join(unread[:6])}, which may "
            "state an accuracy and is not read; call standard deviations std_east, std_north and std_height, or std "
            "for all"
        )
    if "solution" in table.names:
        words = Counter(row.cells["solution"] for row in table.rows(("solution",)))
        others = {word: num for word, num in words.items() if word and word.casefold() not in _FIXED}
        if others:
            listed = ", ".join(f"{num} of {sum(words.values())} points are {word}" for word, num in others.items())
            warnings.append(
                f"{table.path.name}: {listed} by their solution, not fixed and so known to decimetres or worse; "
                "measure them again, or leave them out where the block does not need them"
            )
    return tuple(warnings)


def height_std(row: Row, default: float) -> float:
    """The standard deviation [m] of the height of a row; that of all three directions, or the default, without one."""
    return row.number("std_height", default=row.number("std", default=default))


def require_exact(rows: Sequence[Row], table: Table) -> None:
    """Raise where places went through single precision or too few digits, which leaves steps of metres."""
    places = np.array([[row.number(name) for name in PLACE] for row in rows]).reshape(-1, 3)
    try:
        rounded_coordinates(places, None, table.path)
    except GeoError as found:
        raise table.error(str(found)) from found


def several_heights(names: Sequence[str], places: np.ndarray, height_unit_m: float = 1.0) -> list[str]:
    """Points at one place in plan whose heights differ, of places (N, 3), e.g. "a (5.00) and b (5.30)"."""
    _, place, count = np.unique(places[:, :2], axis=0, return_inverse=True, return_counts=True)
    several = []
    for of_place in np.flatnonzero(count > 1):
        rows = np.flatnonzero(place.ravel() == of_place)
        if np.ptp(places[rows, 2]) * height_unit_m > _SAME_HEIGHT_M:
            several.append(" and ".join(f"{names[i]} ({places[i, 2]:.2f})" for i in rows[:_MOST_NAMED]))
    return several


def _by_place(table: Table) -> Table:
    """A table of numbers alone, its columns taken by their place; raises where it has others than of points."""
    numbers = [number_of(cell, ",") for cell in table.first]
    is_plain = len(numbers) in (3, 4) and all(math.isfinite(number) for number in numbers)
    if not is_plain or (len(numbers) == 4 and not 0.0 <= numbers[3] <= _MOST_STD_M):
        raise table.error(
            f"{table.path} has {len(numbers)} columns without names ({', '.join(table.first)}), expected "
            "easting, northing, height and perhaps a standard deviation in metres; name the columns in a first line"
        )
    columns = (Column(name, name, None) for name in (*PLACE, "std")[: len(numbers)])
    return replace(table, columns=tuple(columns))


def _above(rows: Sequence[Row], level: float | None, table: Table) -> list[Row]:
    """Rows with heights in place of depths below their own levels, or else below one for all."""
    path, error = table.path, table.error
    if not rows:
        return []
    depths = [row.number("depth") for row in rows]
    if statistics.median(depths) < 0.0:
        raise error(
            f"{path} has a column depth whose numbers are negative ({depths[0]:g}), expected depths that count down "
            "from the water; change their sign, or call the column height if they are heights in crs"
        )
    levels = [row.number("level", default=None if "level" in row.cells else level) for row in rows]
    own = statistics.median(levels)
    # Readings of a gauge, of another datum.
    if level is not None and abs(own - level) > _MOST_APART:
        raise error(
            f"{path} has levels of the water about {own:g} beside its depths, and the water stands at {level:g}; give "
            "levels in the heights of crs, or remove the column so that all depths count from that level"
        )
    return [
        replace(row, cells=row.cells | {"height": repr(own - depth)})
        for row, own, depth in zip(rows, levels, depths, strict=True)
    ]


def _require_one_column(table: Table) -> None:
    """Raise where two columns have one meaning: of heights also where one is a height and another a depth."""
    for name in (*PLACE[:2], "depth", *(("level",) if has_depths(table) else ())):
        twice = [column.cell for column in table.columns if column.name == name]
        if len(twice) > 1:
            raise table.error(f"{table.path}: {' and '.join(twice)} may be the {name}; call the one in crs {name}")
    heights = [c.cell for c in table.columns if c.name in ("height", "depth") or c.cell in _HEIGHTS]
    if len(heights) > 1 and heights != _OF_SOUNDINGS:
        raise table.error(
            f"{table.path} has {len(heights)} columns of heights, {' and '.join(heights)}; keep the one that counts in "
            "the heights of crs, and call it height"
        )
