"""CRS in comments and units in names of columns, as text files state them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from pyproj import CRS
from pyproj.exceptions import CRSError

from geo.crs import crs_of, has_height, height_unit_m, horizontal_unit, is_geographic
from geo.stated import US_SURVEY_FOOT_M, unit_named
from survey.errors import SurveyError
from survey.files.csv_table import number_of, shortened, text_lines

_IN_BRACKETS = re.compile(r"(.*?)[\s_]*[(\[]\s*([^()\[\]]+?)\s*[)\]]")
_DEGREES = ("deg", "degree", "degrees", "°", "dd", "decimal degrees")
# Of two feet, which differ by 2e-6.
_SAME_UNIT = 1e-9
_UNSPECIFIED_FOOT = ("ft", "foot", "feet")
_FEET = (0.3048, US_SURVEY_FOOT_M)
_COMMENT = re.compile(r"#\s*CoordinateSystem:\s*(.+)", re.IGNORECASE)
# A comment that is nothing but a code, under one of the names that people have for it.
_CODE = re.compile(
    r"(?:#|//)\s*(?:(?:crs|srs|srid|projection|coordinates?(?: reference)?(?: system)?)(?: in| is)?\s*[:=]?\s*)?"
    r"(EPSG\s*[:=]\s*\d+(?:\+\d+)?)",
    re.IGNORECASE,
)
_SRID = re.compile(r"(?:#|//)\s*SRID\s*[:=]\s*(\d+)", re.IGNORECASE)
_UTM = re.compile(r"WGS\s*84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)
# OpenSfM's word for longitude and latitude.
_WGS84 = re.compile(r"WGS\s*84", re.IGNORECASE)
_EPSG = re.compile(r"EPSG:\s*(\d{1,9}(?:\+\d{1,9})?)", re.IGNORECASE)
_FORM = 'e.g. "EPSG:25832", "WGS84 UTM 32N" or "+proj=utm +zone=32 +datum=WGS84"'


class UnspecifiedFoot(float):
    """A foot [m] of unknown kind, international or US survey; international where nothing decides."""


@dataclass(frozen=True)
class Units:
    """Units of the coordinates of a table."""

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


def same_unit(a: float, b: float) -> bool:
    """Whether two units [m] are one."""
    return abs(a / b - 1.0) < _SAME_UNIT


def common_unit_m(
    units: Mapping[str, float | None], names: tuple[str, str], path: Path, error: type[SurveyError]
) -> float | None:
    """The common unit [m] of two columns, by their names; None where they name none.

    Raises
    ------
    error
        Where they say two, or one for one of them alone.
    """
    east, north = (units.get(name) for name in names)
    if east is None and north is None:
        return None
    if east is None or north is None or not same_unit(east, north):
        parts = ["without a unit" if unit is None else f"in units of {unit:.10g} m" for unit in (east, north)]
        raise error(
            f"{path}: {names[0]} is {parts[0]} and {names[1]} {parts[1]}, by the names of their columns; expected one "
            "unit: convert one, or name it in both"
        )
    return east


def meaning(cell: str, words: Mapping[str, str]) -> tuple[str, float | None] | None:
    """Meaning of a column and its unit [m], by its name in lower case; None where the name is none of the words.

    Examples
    --------
    >>> words = {"z": "height", "depth": "depth", "std_m": "std"}
    >>> meaning("depth_ft", words), meaning("z [m]", words), meaning("std_m", words), meaning("z_up", words)
    (('depth', 0.3048), ('height', 1.0), ('std', None), None)
    """
    if cell in words:
        return words[cell], None
    for bare, unit in _parts(cell):
        if bare in words and unit in _DEGREES:
            return words[bare], None
        metres = unit_named(unit) if bare in words else None
        if metres is not None:
            return words[bare], UnspecifiedFoot(metres) if unit in _UNSPECIFIED_FOOT else metres
    return None


def _parts(cell: str) -> Iterator[tuple[str, str]]:
    """A name and what may be its unit: in brackets, or behind an underscore or blank."""
    if (found := _IN_BRACKETS.fullmatch(cell)) is not None:
        yield found[1], found[2]
    for i, letter in enumerate(cell):
        if letter in "_ " and 0 < i < len(cell) - 1:
            yield cell[:i], cell[i + 1 :]


def crs_of_comment(path: Path, error: type[SurveyError]) -> CRS | None:
    """The CRS in a line ``# CoordinateSystem: WKT or code``, ``# EPSG:code`` or ``# crs = EPSG:code``.

    None where there is none, one of the site, or a datum of heights alone.

    Raises
    ------
    error
        If it is not known.
    """
    lines = (line.strip() for _, line in text_lines(path, error))
    found = next((named for line in lines if (named := _crs_named(line)) is not None), None)
    if found is None or "LOCAL_CS" in found:
        return None
    try:
        crs = crs_of(found.strip())
    except CRSError as wrong:
        raise error(
            f"{path}: the CRS {shortened(found)} of a comment is not a known CRS; correct the comment, or remove it "
            "where coordinates are in the crs of survey.toml"
        ) from wrong
    # A comment on what heights count from does not tell where places are.
    return None if crs.is_vertical and not crs.is_compound else crs


def _crs_named(line: str) -> str | None:
    """CRS that a line of a file names."""
    if match := _COMMENT.match(line):
        return match[1]
    if match := _SRID.fullmatch(line):
        return f"EPSG:{match[1]}"
    match = _CODE.fullmatch(line)
    return None if match is None else re.sub(r"\s*[:=]\s*", ":", match[1])


def is_odm_crs(line: str) -> bool:
    """Whether a line has the form of one that names a CRS."""
    return "+proj" in line or any(known.fullmatch(line) for known in (_UTM, _EPSG, _WGS84))


def odm_crs(line: str, where: str, name: str, error: type[SurveyError]) -> CRS:
    """The CRS that a line names.

    Parameters
    ----------
    line : str
        Without blanks around it.
    where, name : str
        Of the line, and of the file, for errors.

    Raises
    ------
    error
        If the line names none, or one that is not known.
    """
    if _WGS84.fullmatch(line):
        return CRS.from_epsg(4326)
    utm, epsg = _UTM.fullmatch(line), _EPSG.fullmatch(line)
    message = f'{where}: "{shortened(line)}"'
    if utm is not None:
        zone = int(utm[1])
        if not 1 <= zone <= 60:
            raise error(f"{message} is not a UTM zone, expected 1 to 60; correct it")
        return CRS.from_epsg((32600 if utm[2].upper() == "N" else 32700) + zone)
    if not is_odm_crs(line):
        if sum(math.isfinite(number_of(word)) for word in line.split()) > 1:
            raise error(f"{message} is a line of a point, expected the CRS before it, {_FORM}; add it")
        raise error(f"{message} is not a CRS that {name} may begin with, expected {_FORM}; correct it")
    try:
        crs = crs_of(f"EPSG:{epsg[1]}" if epsg is not None else line.strip("'\""))
    except CRSError as wrong:
        raise error(f"{message} is not a known CRS, expected {_FORM}; correct it") from wrong
    if not (crs.is_projected or crs.is_geographic):
        raise error(
            f"{message} is {crs.name}, expected a CRS of a map or of longitude and latitude, {_FORM}; correct it"
        )
    return crs
