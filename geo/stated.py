"""CRS and units that a file states in words."""

from __future__ import annotations

from pathlib import Path

from pyproj import CRS
from pyproj.exceptions import CRSError

from geo.crs import has_height, height_unit_m
from geo.errors import UnreadableFile

US_SURVEY_FOOT_M = 1200.0 / 3937.0
# EPSG codes of units of length, as GeoTIFF keys name them.
UNIT_CODES = {
    9001: 1.0, 9002: 0.3048, 9003: US_SURVEY_FOOT_M, 1025: 1e-3, 1033: 1e-2, 9036: 1e3, 9005: 0.3047972654,
    9080: 0.3047995142, 9096: 0.9144, 9014: 1.8288,
}  # fmt: skip
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
        "footussurvey", "ussurveyft",
    ),
    0.9144: ("yd", "yard", "yards"),
    1.8288: ("fathom", "fathoms", "ftm"),
}  # fmt: skip
_METRES_OF_NAME = {name: metres for metres, names in _UNIT_NAMES.items() for name in names}
# Feet of two kinds differ by 2e-6.
_SAME_UNIT = 1e-9


def unit_named(name: str | None) -> float | None:
    """Metres of a unit of length by its name, e.g. "US survey foot"; None where it is not one that is known.

    Examples
    --------
    >>> unit_named("US survey foot") == 1200 / 3937, unit_named("Centimetre"), unit_named("kelvin")
    (True, 0.01, None)
    """
    return _METRES_OF_NAME.get("".join(c for c in (name or "").lower() if c.isalpha()))


def crs_named(text: str, path: Path) -> tuple[CRS | None, tuple[str, ...]]:
    """The CRS that a comment of a file names, by code or WKT, and a note: (None, why) if it is not understood."""
    try:
        crs = CRS.from_user_input(text.strip())
    except CRSError as error:
        return None, (f"{path} names a CRS that is not understood ({text.strip()[:80]}: {str(error)[:80]}).",)
    return crs, () if has_height(crs) else (f"{path} states the CRS {crs.name} without a vertical part.",)


def height_unit_said(crs: CRS | None, said: float | None, path: Path, where: str) -> float | None:
    """Metres of a unit of height that a file gives beside its CRS; None where the CRS gives it itself, or nobody does.

    Parameters
    ----------
    crs : pyproj.CRS or None
    said : [m] or None
    path, where : what gives it, for a message.

    Raises
    ------
    UnreadableFile
        If the CRS has heights in another unit.
    """
    if said is None or crs is None or not has_height(crs):
        return said
    own = height_unit_m(crs)
    if abs(own - said) > _SAME_UNIT:
        raise UnreadableFile(
            f"{path} contradicts itself: {where} is {said:.10g} m, and its CRS {crs.name} has heights in "
            f"{crs.axis_info[2].unit_name} ({own:.10g} m); correct the one that is wrong (gdal_edit, las2las, pdal)."
        )
    return None


def with_height_unit(vertical: CRS, unit_m: float) -> CRS:
    """A vertical CRS with its heights in another unit [m], of the same datum."""
    said = vertical.to_json_dict()
    axis = said["coordinate_system"]["axis"][0]
    own = vertical.axis_info[0].unit_conversion_factor
    if abs(own - unit_m) <= _SAME_UNIT:
        return vertical
    axis["unit"] = {"type": "LinearUnit", "name": f"{unit_m:.10g} m", "conversion_factor": unit_m}
    said["name"] += f" ({unit_m:.10g} m)"
    said.pop("id", None)
    return CRS.from_json_dict(said)
