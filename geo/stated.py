"""CRSs and units as files state them, by name or code."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from pyproj import CRS
from pyproj.database import get_units_map
from pyproj.exceptions import CRSError

from geo.crs import crs_of, has_height, height_unit_m
from geo.errors import UnreadableFile

US_SURVEY_FOOT_M = 1200.0 / 3937.0
# Names of units as GDAL, ESRI, PDAL and people write them, without case, blanks and signs.
_UNIT_NAMES = {
    1.0: ("m", "meter", "meters", "metre", "metres"),
    0.1: ("dm", "decimeter", "decimeters", "decimetre", "decimetres"),
    1e-2: ("cm", "centimeter", "centimeters", "centimetre", "centimetres"),
    1e-3: ("mm", "millimeter", "millimeters", "millimetre", "millimetres"),
    1e3: ("km", "kilometer", "kilometers", "kilometre", "kilometres"),
    0.3048: ("ft", "foot", "feet", "internationalfoot", "internationalfeet", "footinternational", "footintl", "ftintl"),
    US_SURVEY_FOOT_M: (
        "ftus", "usft", "usfoot", "usfeet", "ussurveyfoot", "ussurveyfeet", "surveyfoot", "surveyfeet", "footus",
        "footussurvey", "ussurveyft", "sftus", "feetussurvey",
    ),
    0.0254: ("in", "inch", "inches", "internationalinch"),
    0.9144: ("yd", "yard", "yards"),
    1.8288: ("fathom", "fathoms", "ftm"),
}  # fmt: skip
_METRES_OF_NAME = {name: metres for metres, names in _UNIT_NAMES.items() for name in names}
# Feet of two kinds differ by 2e-6.
_SAME_UNIT = 1e-9


def unit_named(name: str | None) -> float | None:
    """Metres of a unit of length by its name, as people, programs or PROJ write it; None for an unknown name.

    Examples
    --------
    >>> unit_named("US survey foot") == 1200 / 3937, unit_named("Centimetre"), unit_named("kelvin")
    (True, 0.01, None)
    >>> round(unit_named("British foot (Sears 1922)"), 9)
    0.304799472
    """
    bare = _bare(name or "")
    return _METRES_OF_NAME.get(bare) or _units_of_proj()[1].get(bare)


def unit_of_code(code: int) -> float | None:
    """Metres of a unit of length by its EPSG code, as keys of GeoTIFF and LAS name it."""
    return _units_of_proj()[0].get(code)


@cache
def _units_of_proj() -> tuple[dict[int, float], dict[str, float]]:
    """Metres of the units of length that PROJ knows, by code of EPSG and by bare name."""
    units = get_units_map(auth_name="EPSG", category="linear", allow_deprecated=True)
    by_code = {int(unit.code): unit.conv_factor for unit in units.values()}
    return by_code, {_bare(name): unit.conv_factor for name, unit in units.items()}


def _bare(name: str) -> str:
    """Name without case, blanks and signs; digits stay: there are feet of several years."""
    return "".join(c for c in name.lower() if c.isalnum())


def crs_named(text: str, path: Path) -> tuple[CRS | None, tuple[str, ...]]:
    """The CRS that a comment of a file names, by code or WKT, and a note: (None, why) if it is not understood."""
    try:
        crs = crs_of(text.strip())
    except CRSError as error:
        return None, (f"{path} names a CRS that is not understood ({text.strip()[:80]}: {str(error)[:80]}).",)
    return crs, () if has_height(crs) else (f"{path} states the CRS {crs.name} without a vertical part.",)


def checked_height_unit(crs: CRS | None, stated: float | None, path: Path, where: str) -> float | None:
    """Metres of a unit of height that a file states besides its CRS; None where the CRS has one, or none is stated.

    A message names the path, and where in it the unit stands.
    """
    if stated is None or crs is None or not has_height(crs):
        return stated
    own = height_unit_m(crs)
    if abs(own - stated) > _SAME_UNIT:
        raise UnreadableFile(
            f"{path} contradicts itself: {where} is {stated:.10g} m, and its CRS {crs.name} has heights in "
            f"{crs.axis_info[2].unit_name} ({own:.10g} m); correct the one that is wrong (gdal_edit, las2las, pdal)."
        )
    return None


def with_height_unit(vertical: CRS, unit_m: float) -> CRS:
    """A vertical CRS with its heights in another unit [m], of the same datum."""
    content = vertical.to_json_dict()
    axis = content["coordinate_system"]["axis"][0]
    own = vertical.axis_info[0].unit_conversion_factor
    if abs(own - unit_m) <= _SAME_UNIT:
        return vertical
    axis["unit"] = {"type": "LinearUnit", "name": f"{unit_m:.10g} m", "conversion_factor": unit_m}
    content["name"] += f" ({unit_m:.10g} m)"
    content.pop("id", None)
    return CRS.from_json_dict(content)
