"""Series of levels in files: one's own CSV of time and level, and forms of NOAA CO-OPS, PEGELONLINE and USGS.

Time zone and unit are those that the file states, in a column or in the name of one (``Time (GMT)``, ``tz_cd``,
``value_cm``), or, of the RDB of USGS, beside it; they are never assumed. A column ``level`` without a unit has
the unit of crs. Cells without a number, as services write them, are left out and named.
What is at fault raises ConfigError.
"""

import re
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from itertools import groupby, pairwise
from pathlib import Path

from geo.crs import unit_named
from survey.display.quantities import named
from survey.errors import ConfigError, Findings
from survey.files.csv_table import Row, Table, number_of, text_lines, words_of
from survey.water.level_observation import std_of

_WORDS = words_of({
    "time": ("date time", "date_time", "datetime", "timestamp", "date/time", "t", "zeit", "zeitpunkt", "uhrzeit"),
    "date": ("day", "datum"), "zone": ("tz_cd", "tz", "timezone", "time zone", "time_zone", "zeitzone"),
    "level": (), "verified": (), "preliminary": (), "predicted": ("prediction", "predictions", "pred"),
    "reading": ("water level", "water_level", "waterlevel", "value", "v", "gage height", "gage_height", "gauge height",
                "gauge_height", "stage", "wasserstand", "pegel", "pegelstand", "w", "height", "messwert", "wl"),
    "std": (), "unit": ("units", "unit_of_measure", "unitcode", "einheit"), "kind": ("type", "high/low", "h/l"),
    "parameter": ("parameter_code", "variablename", "parameter"), "no_data": ("nodatavalue", "missing_value"),
})  # fmt: skip
# In this order: what was observed and checked, observed, and computed before.
_LEVELS = ("level", "verified", "reading", "preliminary", "predicted")
_ZONES = {"z": 0, "utc": 0, "gmt": 0, "ut": 0, "wet": 0, "bst": 1, "cet": 1, "mez": 1, "west": 1, "cest": 2, "mesz": 2,
          "eet": 2, "eest": 3, "ast": -4, "adt": -3, "est": -5, "edt": -4, "cst": -6, "cdt": -5, "mst": -7, "mdt": -6,
          "pst": -8, "pdt": -7, "akst": -9, "akdt": -8, "hst": -10, "jst": 9, "aest": 10, "aedt": 11, "nzst": 12,
          "nzdt": 13}  # fmt: skip
_OFFSET = re.compile(r"(?:utc|gmt)?\s*([+-])(\d{1,2})(?::?(\d{2}))?", re.IGNORECASE)
_ZONE_BEHIND = re.compile(r"(.*?)[\s_]*[(\[_ ]\s*([a-z]{1,4}|(?:utc|gmt)?[+-][\d:]{1,5})\s*[)\]]?")
_GERMAN = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})(.*)")
# Column of a parameter in the RDB of USGS, its description in the comments, and the widths under the names.
_RDB_COLUMN = re.compile(r"(\d+)_(\d{5})(?:_\d{5})?")
_RDB_COMMENT = re.compile(r"\s(\d{5})\s+(?:\d{5}\s+)?(\D.+)")
_RDB_WIDTH = re.compile(r"\d+[sdn]")
# Words for no number; those of three letters are of USGS (ice, equipment, backwater, maintenance and others).
_NO_DATA_WORDS = ("", "-", "--", "---", "***", "nan", "null", "none", "na", "n/a", "m", "missing", "ice", "eqp", "bkw",
                  "mnt", "ssn", "dis", "fld", "dry", "rat", "zfl", "pr", "tst", "zkn", "unk")  # fmt: skip
# Numbers that services write for no number, of either sign; 0 may be one, too.
_NO_DATA_NUMBERS = (0.0, 99.9, 99.99, 99.999, 999.0, 999.9, 999.99, 9999.0, 9999.9, 9999.99, 99999.0, 999999.0, 32767.0,
                    32768.0, 65535.0, 1e6, 99.0)  # fmt: skip


@dataclass(frozen=True)
class Reading:
    """A level at a moment."""

    where: str  # File and line, for messages
    time: datetime  # In UTC
    level_m: float
    std_m: float
    text: str  # As the file has it
    is_marker: bool = False  # Whether it is a number that services write where there is none, or the file says so

    @property
    def line(self) -> str:
        """Its line in the file, for messages."""
        return self.where.rpartition(", ")[2]


@dataclass(frozen=True)
class Series:
    """Readings of a file, in rising order of time."""

    path: Path
    readings: tuple[Reading, ...]
    is_of_extremes: bool  # Whether a column says that they are high and low waters
    findings: Findings


def read_series(path: Path, unit_m: float = 1.0, zero_m: float | None = None) -> Series:
    """The readings of a file, over the zero of a gauge at this height [m]; a level without a unit has that of crs."""
    if path.suffix.lower() in (".json", ".geojson"):
        raise ConfigError(f"{path} is JSON, expected a table; fetch the same series as CSV, or from USGS as RDB")
    table, rows, zone_of_column = _table_of(path)
    cell_of = {column.name: column.cell for column in reversed(table.columns)}
    names = [name for name in _LEVELS if any(name in row.cells for row in rows)]
    if not names:
        raise ConfigError(f"{path} has no readings, expected time,level, or a form of NOAA, PEGELONLINE or USGS")
    names, readings, empty = names[:1] if names == ["predicted"] else [n for n in names if n != "predicted"], [], []
    for row in rows:
        where, cells = row.where, row.cells
        if _RDB_WIDTH.fullmatch(cells.get("time", "")):
            continue
        texts = {name: cells.get(name, "") for name in names}
        name = next((n for n, text in texts.items() if text.casefold() not in _NO_DATA_WORDS), None)
        if name is None:
            empty.append(where.rpartition(", ")[2])
            continue
        number = row.number(name)
        unit = unit_named(cells["unit"]) if cells.get("unit") else table.units.get(name)
        if unit is None and name != "level":
            cell = cell_of[name]
            raise ConfigError(
                f'{path} states no unit for "{cell}"; give a CSV that has it in the first line, as {cell} (m), '
                f"{cell} (cm) or {cell} (ft)"
            )
        zone = zone_of(cells["zone"]) if cells.get("zone") else zone_of_column
        moment = utc_of(" ".join(cells[part] for part in ("date", "time") if cells.get(part)), where, zone)
        is_marker = is_no_data_number(number) or number == number_of(cells.get("no_data", ""))
        level_m = number * (unit_m if unit is None else float(unit)) + (zero_m or 0.0)
        std_m = std_of(row.multiplied({"std": table.units.get("std", 1.0)}), "gauge")
        readings.append(Reading(where, moment, level_m, std_m, texts[name], is_marker))
    # Downloads that overlap repeat readings.
    readings = [next(same) for _, same in groupby(readings, key=lambda reading: (reading.time, reading.level_m))]
    if len(readings) > 1 and all(later.time < earlier.time for earlier, later in pairwise(readings)):
        readings.reverse()
    if len(readings) < 2:
        raise ConfigError(f"{path} has {len(readings)} readings, expected two or more at times around the flight")
    for earlier, later in pairwise(readings):
        if later.time <= earlier.time:
            mend = "keep one of them" if later.time == earlier.time else "sort the lines by time"
            raise ConfigError(
                f"{later.where}: {later.time:%Y-%m-%d %H:%M:%S} UTC is not later than the reading before it "
                f"({earlier.line}), expected rising times; {mend}"
            )
    warnings = named(empty, "reading", f"of {path.name} without a level, left out")
    if "predicted" in names:
        warnings.append(
            f"{path.name} has predictions and no observations: wind and pressure move the water by decimetres; give "
            "what a gauge observed, or level_std_m"
        )
    if "level" not in names and zero_m is None:
        warnings.append(
            f"the readings of {path.name} ({cell_of[names[0]]}) are taken as heights in crs: services count from "
            "the zero of the gauge or a chart datum; give [water] gauge_zero_m, its height in crs, 0 if it is that"
        )
    kinds = {row.cells.get("kind", "").casefold()[:1] for row in rows}
    return Series(path, tuple(readings), kinds == {"h", "l"}, Findings(warnings=tuple(warnings)))


def _table_of(path: Path) -> tuple[Table, list[Row], tzinfo | None]:
    """Head and rows of a CSV, or of the RDB of USGS, and the zone that the name of its column of times states."""
    table, zone = Table.read(path, _WORDS, ConfigError), None
    described, columns = dict[str, str](), []
    if any(_RDB_COLUMN.fullmatch(column.cell) for column in table.columns):
        comments = (line for _, line in text_lines(path, ConfigError) if line.startswith("#"))
        described = {match[1]: match[2].strip() for line in comments for match in _RDB_COMMENT.finditer(line)}
    for column in table.columns:
        behind = _ZONE_BEHIND.fullmatch(column.cell)
        if column.name == column.cell and behind is not None and _WORDS.get(behind[1]) == "time":
            column, zone = replace(column, name="time"), zone_of(behind[2])
        if (parameter := _RDB_COLUMN.fullmatch(column.cell)) is not None:
            # "Gage height, feet", which a statistic may follow.
            unit = unit_named(re.sub(r"\(.*", "", described.get(parameter[2], "")).rpartition(",")[2])
            column = column if unit is None else replace(column, name="reading", unit_m=unit)
        columns.append(column)
    table = replace(table, columns=tuple(columns))
    for name in ("time", *_LEVELS[:-1]):
        twice = [column.cell for column in table.columns if column.name == name]
        if len(twice) > 1:
            raise ConfigError(f"{path} has {len(twice)} columns of {name}, {' and '.join(twice)}; keep one")
    levels = [name for name in _LEVELS if name in table.names] or ["level"]
    when = [name for name in ("date", "time") if name in table.names] or ["time"]
    others = ("std", "unit", "zone", "kind", "parameter", "no_data")
    rows = table.rows(when + levels[:1], (*levels[1:], *others))
    # Of several parameters the one that has a unit of length.
    rows = [row for row in rows if not row.cells.get("unit") or unit_named(row.cells["unit"]) is not None]
    parameters = {row.cells.get("parameter", "") for row in rows}
    if len(parameters) > 1:
        series = ", ".join(sorted(parameters)[:6])
        raise ConfigError(f"{path} has several series, {series}; keep the one of the water level")
    return table, rows, zone


def is_no_data_number(number: float) -> bool:
    """Whether a number is one that services write where there is none; some of them are levels elsewhere."""
    return abs(number) in _NO_DATA_NUMBERS


def utc_of(text: str, where: str, zone: tzinfo | None = None) -> datetime:
    """A time in UTC from a text at a place of a file, in a zone that stands elsewhere; ConfigError where it is none."""
    bare, behind = text.strip(), re.fullmatch(r"(.*\d)\s*([A-Za-z]{2,4})", text.strip())
    if behind is not None and (named_zone := zone_of(behind[2])) is not None:
        bare, zone = behind[1], named_zone
    if (german := _GERMAN.fullmatch(bare)) is not None:
        bare = f"{german[3]}-{int(german[2]):02d}-{int(german[1]):02d}{german[4]}"
    if re.match(r"\d{4}/\d{1,2}/\d{1,2}", bare):
        bare = bare.replace("/", "-")
    # The end of a day, as the beginning of the next.
    is_end = re.search(r"[T ]24:00(:00(\.0+)?)?", bare)
    try:
        moment = datetime.fromisoformat(bare.replace("24:00", "00:00") if is_end else bare)
        moment = moment + timedelta(days=1) if is_end else moment
        moment = moment.replace(tzinfo=zone) if moment.tzinfo is None else moment
        if moment.tzinfo is not None:
            return moment.astimezone(UTC)
    except (ValueError, OverflowError) as error:
        raise ConfigError(f"{where}: {text!r} is not a time, expected e.g. 2024-06-01T10:30:00Z") from error
    raise ConfigError(f"{where}: {text} has no time zone; write Z or +02:00 after it, or time (UTC) in the first line")


def zone_of(text: str) -> tzinfo | None:
    """A time zone by its name or offset, e.g. "CET" or "UTC+1"; None where it is none that is known."""
    text = text.strip().casefold()
    if text in _ZONES:
        return timezone(timedelta(hours=_ZONES[text]))
    if (offset := _OFFSET.fullmatch(text)) is None or int(offset[2]) > 14:
        return None
    minutes = 60 * int(offset[2]) + int(offset[3] or 0)
    return timezone(timedelta(minutes=-minutes if offset[1] == "-" else minutes))
