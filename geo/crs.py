"""Coordinate reference systems: those that a survey may have, and how files state them and units.

A CRS of this project has a horizontal part (projected or geographic, axes east and north) and heights that
count upwards, either above a vertical datum (compound) or above the ellipsoid (3D). Coordinates are always
ordered easting or longitude, northing or latitude, height, whatever order the authority prefers; `geo.projection` alone
sets that order.
"""

import math
from functools import cache, lru_cache
from pathlib import Path
from typing import cast

import numpy as np
from pyproj import CRS
from pyproj.crs import Ellipsoid, PrimeMeridian
from pyproj.database import get_units_map
from pyproj.exceptions import CRSError, ProjError

from geo.errors import GeoError, UnreadableFile

# Radius of the sphere with the volume of the Earth: for lengths of degrees to a part in three hundred.
EARTH_RADIUS_M = 6.371e6
# Surveys may lie some degrees outside a zone, as countries use one for all; swapped or shifted places lie far away.
AREA_MARGIN_DEG = 10.0
# EPSG code of heights above mean sea level by the geoid model EGM96: those of consumer receivers and drones.
EGM96_HEIGHT = 5773
_HORIZONTAL_KINDS = ("Projected CRS", "Geographic 2D CRS", "Geographic 3D CRS")
_EXAMPLE = "EPSG:25832+5778"


def parse_crs(text: str | CRS, *, where: str = "crs") -> CRS:
    """A CRS from its EPSG code (``"EPSG:25832+5778"``, ``"EPSG:4979"``), WKT or PROJ string, fit for a survey.

    Errors name ``where``, for example ``"crs in survey.toml"``.
    """
    try:
        crs = crs_of(text)
    except CRSError as error:
        raise GeoError(
            f"{where} is {_short(text)}, which is not a known coordinate reference system; give an EPSG code "
            f'with a vertical part such as "{_EXAMPLE}", WKT or a PROJ string.'
        ) from error
    _require_fit(crs, text if isinstance(text, str) else crs.name, where)
    wkt1(crs)  # raises now, rather than when the finished cloud is to be written
    return crs


def crs_of(text: str | CRS) -> CRS:
    """A CRS from its code, WKT or PROJ string, which PROJ reads once: a compound code takes it 20 ms."""
    return _crs_of_text(text) if isinstance(text, str) else text


@lru_cache(maxsize=256)
def _crs_of_text(text: str) -> CRS:
    return CRS.from_user_input(text)


def _require_fit(crs: CRS, text: str, where: str) -> None:
    """Raise GeoError unless the coordinates of a CRS are easting, northing and height."""
    message = f"{where} is {_short(text)} ({crs.name})"
    if crs.is_vertical and not crs.is_compound:
        raise GeoError(f'{message}, which has heights only; put the horizontal code before it, e.g. "{_EXAMPLE}".')
    kind = horizontal_crs(crs).type_name
    if kind not in _HORIZONTAL_KINDS:
        raise GeoError(
            f"{message}, of kind {kind}; expected a projected or geographic CRS with heights, "
            f'e.g. "{_EXAMPLE}" or "EPSG:4979".'
        )
    axes = crs.axis_info
    if any(axis.direction == "west" for axis in axes[:2]):
        raise GeoError(
            f"{message}, whose axes point {axes[0].direction} and {axes[1].direction}; expected easting and "
            "northing: convert the coordinates to a CRS with these axes, e.g. the UTM zone."
        )
    if len(axes) < 3:
        raise GeoError(f"{message}, which has no vertical part; {_vertical_remedy(crs)}.")
    if axes[2].direction != "up":
        raise GeoError(
            f"{message}, whose third axis counts {axes[2].direction} ({axes[2].name}); give heights that count "
            'upwards in the matching height CRS, e.g. "+5714" (MSL height) in place of "+5715" (MSL depth).'
        )


def _vertical_remedy(crs: CRS) -> str:
    code = crs.to_epsg()
    remedy = f'add a vertical CRS, e.g. "{_EXAMPLE}"'
    geodetic = geodetic_crs(crs).to_3d().to_epsg() if code else None
    if geodetic is None:
        return remedy
    ellipsoidal = f"EPSG:{geodetic}" if crs.is_geographic else f"EPSG:{code}+{geodetic}"
    return f'{remedy}, or "{ellipsoidal}" if the heights are ellipsoidal'


def _short(text: object) -> str:
    words = " ".join(str(text).split())
    return f'"{words}"' if len(words) <= 80 else f'"{words[:77]}..."'


def _unbound(crs: CRS) -> CRS:
    """The CRS without a transformation to WGS 84 that its text attaches (TOWGS84, nadgrids)."""
    return _unbound(crs.source_crs) if crs.is_bound and crs.source_crs is not None else crs


def horizontal_crs(crs: CRS) -> CRS:
    """The 2D horizontal part of a compound, 3D or 2D CRS."""
    return _horizontal_part(crs.srs)


@lru_cache(maxsize=256)
def _horizontal_part(srs: str) -> CRS:
    # Cached, since PROJ takes 1 ms to make it.
    part = _unbound(crs_of(srs))
    if part.is_compound:
        part = _unbound(part.sub_crs_list[0])
    return part.to_2d() if part.is_projected or part.is_geographic else part


def vertical_crs(crs: CRS) -> CRS | None:
    """The vertical part of a compound CRS; None where heights are ellipsoidal (3D) or absent (2D)."""
    part = _unbound(crs)
    return _unbound(part.sub_crs_list[1]) if part.is_compound else None


def has_height(crs: CRS) -> bool:
    """Whether the CRS defines a vertical datum."""
    return len(crs.axis_info) == 3


def is_geographic(crs: CRS) -> bool:
    """Whether horizontal coordinates are angles (longitude, latitude) rather than lengths."""
    return horizontal_crs(crs).is_geographic


def crs_name(crs: CRS) -> str:
    """The name of a CRS, or a description where its text gives none, as for a PROJ string.

    >>> crs_name(CRS("EPSG:32632")), crs_name(CRS("+proj=utm +zone=17 +units=us-ft"))
    ('WGS 84 / UTM zone 32N', 'a CRS without a name (UTM zone 17N, US survey foot)')
    """
    plan = horizontal_crs(crs)
    if plan.name not in ("", "unknown", "unnamed"):
        return crs.name
    parts = [plan.coordinate_operation.name] if plan.coordinate_operation is not None else []
    parts = [part for part in parts if part not in ("", "unknown", "unnamed")]
    return f"a CRS without a name ({', '.join([*parts, plan.axis_info[0].unit_name])})"


def horizontal_unit(crs: CRS) -> float:
    """Unit of easting in metres, or of longitude in radians."""
    return horizontal_crs(crs).axis_info[0].unit_conversion_factor


def height_unit_m(crs: CRS) -> float:
    """Unit of height in metres: 1, or a foot."""
    return crs.axis_info[2].unit_conversion_factor


def angular_unit_rad(crs: CRS) -> float:
    """Unit of longitude and latitude in the geographic system under a CRS: a degree, or a grad."""
    return geodetic_crs(crs).axis_info[0].unit_conversion_factor


def geodetic_crs(crs: CRS) -> CRS:
    """The geographic system under a projected or geographic CRS."""
    geodetic = horizontal_crs(crs).geodetic_crs
    if geodetic is None:
        raise GeoError(f"{crs.name} is not placed on the Earth; expected a projected or geographic CRS.")
    return geodetic


def ellipsoid(crs: CRS) -> Ellipsoid:
    return cast("Ellipsoid", geodetic_crs(crs).ellipsoid)


def prime_meridian_rad(crs: CRS) -> float:
    """Longitude of the prime meridian of a CRS, from Greenwich."""
    meridian = cast("PrimeMeridian", geodetic_crs(crs).prime_meridian)
    return meridian.longitude * float(meridian.unit_conversion_factor)  # a number, though pyproj's stubs say str


def crs_code(crs: CRS) -> str | None:
    """Codes of a CRS, e.g. "EPSG:25832+5778"; None where it has none."""
    codes = crs.to_authority(min_confidence=100)
    if codes is not None:
        return ":".join(codes)
    vertical = vertical_crs(crs)
    plan, height = (part and part.to_authority(min_confidence=100) for part in (horizontal_crs(crs), vertical))
    if not plan or not height:
        return None
    return f"{':'.join(plan)}+" + (height[1] if plan[0] == height[0] else ":".join(height))


def degrees_outside_area(crs: CRS, lon: float, lat: float) -> float:
    """Distance [deg] of a longitude (from the CRS's own prime meridian) and latitude [rad] from its area of use.

    Zero where the area is not known.
    """
    area = horizontal_crs(crs).area_of_use
    if area is None:
        return 0.0
    east, north = math.degrees(lon + prime_meridian_rad(crs)), math.degrees(lat)
    width = (area.east - area.west) % 360.0 or 360.0
    beyond = (east - area.west) % 360.0
    outside_lon = 0.0 if beyond <= width else min(beyond - width, 360.0 - beyond)
    return max(outside_lon, area.south - north, north - area.north, 0.0)


def wkt1(crs: CRS) -> str:
    """The CRS as OGC WKT 1 (2001), the only dialect that LAS 1.4 admits; ellipsoidal heights as GDAL writes them."""
    try:
        if has_height(crs) and not _unbound(crs).is_compound:
            horizontal = horizontal_crs(crs)
            name = f"{horizontal.name} + Ellipsoid ({crs.axis_info[2].unit_name})"
            return f'COMPD_CS["{name}",{horizontal.to_wkt("WKT1_GDAL")},{ellipsoidal_wkt1(crs)}]'
        return _unbound(crs).to_wkt("WKT1_GDAL")
    except (CRSError, ProjError) as error:
        raise GeoError(
            f"the CRS {_short(crs.name)} cannot be written as WKT 1, which LAS 1.4 requires; process the "
            "survey in a CRS of common EPSG codes, e.g. the UTM zone with a vertical part."
        ) from error


def ellipsoidal_wkt1(crs: CRS) -> str:
    """The vertical part of a CRS with ellipsoidal heights as WKT 1, in which they have none of their own."""
    axis = crs.axis_info[2]
    authority = ',AUTHORITY["EPSG","9001"]' if axis.unit_name == "metre" else ""
    unit = f'UNIT["{axis.unit_name}",{axis.unit_conversion_factor:.15g}{authority}]'
    return f'VERT_CS["Ellipsoid ({axis.unit_name})",VERT_DATUM["Ellipsoid",2002],{unit},AXIS["Up",UP]]'


def middle_lon_lat(lon_lat_deg: np.ndarray) -> np.ndarray:
    """Median longitude and latitude (2,) [deg] of places (N, 2) of a survey, which may lie across 180 degrees."""
    lon, lat = np.asarray(lon_lat_deg, dtype=np.float64).T
    if np.ptp(lon) > 180.0:
        lon = np.where(lon < 0.0, lon + 360.0, lon)
    middle = float(np.median(lon))
    return np.array([middle - 360.0 if middle > 180.0 else middle, np.median(lat)])


def utm_code(lat_deg: float, lon_deg: float) -> int:
    """EPSG code of the UTM zone (WGS 84) of a place [deg]; without the exceptions for Norway and Svalbard."""
    zone = math.floor((lon_deg + 180.0) / 6.0) % 60 + 1
    return (32600 if lat_deg >= 0.0 else 32700) + zone


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
    """Metres of a unit of height that a file states besides its CRS; None where the CRS has one, or none is stated."""
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
