"""Heights of cameras against the water, the take-off point and EXIF: what shows two vertical datums, feet, or a sign.

What cannot be true of any survey is an error; what is unlikely is a warning.
"""

from collections.abc import Mapping

import numpy as np
from pyproj import CRS

from geo.compatibility import approximate_undulation_m
from geo.crs import height_unit_m, middle_lon_lat, vertical_crs
from geo.transformation import lon_lat
from survey.errors import FILE_NAME, ConfigError
from survey.photos.exif import Exif
from survey.photos.xmp import ELLIPSOIDAL
from survey.settings.config import WaterConfig

# Drones take bathymetric photographs from below the first height, aircraft from below the second. Higher than the first
# suggests, higher than the second proves another vertical datum.
DRONE_HEIGHT_M, AIRCRAFT_HEIGHT_M = 300.0, 3000.0
# A barometer drifts by some metres during a flight, and a drone may start from a boat. Take-off points are rarely
# higher over the water than the second; with mixed up ellipsoid and geoid they often seem to be.
_UNDER_WATER_M, _ABOVE_WATER_M = 5.0, 30.0
# Usual flying heights for bathymetry, where the height over the take-off point is not known.
_LOWEST_FLIGHT_M, _HIGHEST_FLIGHT_M = 2.0, 150.0
# The geoid undulation is approximate to some metres here, and so are heights in EXIF.
_ROUGH_M = 10.0
_FOOT_M = 0.3048
# Tolerance for heights over the take-off point that were given as heights in crs.
_SAME_M = 3.0


def place_of(crs: CRS, point_crs: np.ndarray) -> tuple[float, float]:
    """Latitude and longitude [deg] of a point in crs."""
    lon, lat = lon_lat(crs, np.asarray(point_crs, dtype=np.float64)[None])[0]
    return float(lat), float(lon)


def above_start_of(headers: Mapping[str, Exif]) -> float | None:
    """The median height [m] over the take-off point, by XMP; None where no photograph has one."""
    heights = [header.above_start_m for header in headers.values() if header.above_start_m is not None]
    return float(np.median(heights)) if heights else None


def explanation(
    over_m: float, level_m: float, place: tuple[float, float], crs: CRS, above_start_m: float | None
) -> str:
    """Explanation of cameras `over_m` over the water, as the rest of a sentence; empty without one.

    Heights [m] are medians: over the water, over the take-off point. ``place`` is latitude and longitude [deg].
    """
    cameras_m, unit = level_m + over_m, height_unit_m(crs)
    undulation = approximate_undulation_m(*place)
    side = "over" if undulation > 0.0 else "under"
    geoid = f"the geoid lies about {abs(undulation):.0f} m {side} the ellipsoid here"
    candidates = [
        (over_m - undulation, f"{geoid}, and heights of the cameras above the ellipsoid with a level above the sea"),
        (over_m + undulation, f"{geoid}, and a level above the ellipsoid with heights of the cameras above the sea"),
    ]
    lowest, highest = _LOWEST_FLIGHT_M, _HIGHEST_FLIGHT_M
    if above_start_m is not None:
        lowest, highest = above_start_m - _UNDER_WATER_M - _ROUGH_M, above_start_m + _ABOVE_WATER_M + _ROUGH_M
        if abs(cameras_m - above_start_m) < _SAME_M:
            what = "heights of the cameras over the take-off point instead of heights in crs"
            candidates.append((above_start_m, what))
    if unit != 1.0:
        candidates.append((cameras_m - level_m * unit, "a level in the unit of crs instead of metres"))
    else:
        candidates.append((cameras_m * _FOOT_M - level_m, "heights of the cameras in feet"))
    sentences = [
        f"{words} would explain it: the cameras would be {over:.0f} m over the water"
        for over, words in candidates
        if lowest <= over <= highest and abs(over - over_m) > _LOWEST_FLIGHT_M
    ]
    return f"; {'; or '.join(sentences)}" if sentences else ""


def require_level_fits(
    water: WaterConfig,
    who: str,
    heights: np.ndarray,
    over_water: np.ndarray,
    like: str,
    *,
    most_m: float = AIRCRAFT_HEIGHT_M,
) -> None:
    """Raise where cameras of heights (N,) [m] in crs, and over the water, lie all under it or more than most_m over it.

    In the message, ``who`` is the source of the heights, and ``like`` has the datum that the level should have.
    """
    level_m = water.known_level_m
    message = f"[water] level_m is {level_m:g} m and {who} at {heights.min():.1f} to {heights.max():.1f} m"
    remedy = f"give level_m in {FILE_NAME} in the same vertical datum as {like}"
    if (over_water <= 0.0).all():
        # With the other sign the water is twice the level lower.
        over_other = over_water + 2.0 * level_m
        is_sign = ((over_other > 0.0) & (over_other < DRONE_HEIGHT_M)).all()
        sign = f"give level_m = {-level_m:g} if its sign is wrong, else " if is_sign else ""
        raise ConfigError(f"{message}, all of them under the water; {sign}{remedy}")
    if (over_water > most_m).all():
        raise ConfigError(f"{message}, all of them more than {most_m:.0f} m over the water; {remedy}")


def low_flight_warnings(over_m: np.ndarray, level_m: float, place: tuple[float, float], crs: CRS) -> list[str]:
    """A warning where cameras (N,) [m] over the water fly nearly on it."""
    middle = float(np.median(over_m))
    if not 0.0 < middle < _LOWEST_FLIGHT_M:
        return []
    return [
        f"the cameras are only {middle:.2f} m over the water (median): check that level_m and the heights of the "
        f"cameras count from the same{explanation(middle, level_m, place, crs, None)}"
    ]


def exif_height_warnings(heights_m: Mapping[str, float], headers: Mapping[str, Exif]) -> list[str]:
    """A warning where poses and EXIF differ in height by as much as the geoid and the ellipsoid do."""
    if above_start_of(headers) is not None:
        return []  # `start_height_warnings` is more specific
    positions = {name: headers[name].lat_lon_height for name in heights_m if name in headers}
    known = {name: place for name, place in positions.items() if place is not None and np.isfinite(place[2])}
    if not known:
        return []
    higher = float(np.median([heights_m[name] - place[2] for name, place in known.items()]))
    lon, lat = middle_lon_lat(np.array([place[1::-1] for place in known.values()])).tolist()
    undulation = approximate_undulation_m(lat, lon)
    if abs(undulation) < 2.0 * _ROUGH_M or abs(abs(higher) - abs(undulation)) > _ROUGH_M:
        return []
    return [
        f"the poses lie {abs(higher):.0f} m {'above' if higher > 0.0 else 'below'} the heights in EXIF, about as much "
        f"as the geoid differs from the ellipsoid here ({undulation:.0f} m): one of them counts from the ellipsoid; "
        "check that [water] level_m has the datum of the poses"
    ]


def xmp_height_warnings(gps_height: str, crs: CRS, headers: Mapping[str, Exif]) -> list[str]:
    """A warning where XMP says that GPS heights count from something else than `gps_height` takes them for."""
    vertical = vertical_crs(crs)
    datums = [header.height_datum for header in headers.values() if header.height_datum is not None]
    if not datums or vertical is None:
        return []
    ellipsoidal, num = datums.count(ELLIPSOIDAL), len(headers)
    if gps_height == "crs" and ellipsoidal > len(datums) / 2:
        return [
            f"XMP says that the heights of {ellipsoidal} of {num} images count from the ellipsoid, and gps_height = "
            f'"crs" takes them as {vertical.name}: write gps_height = "ellipsoidal" in [cameras], and level_m in the '
            "heights of crs"
        ]
    if gps_height == "ellipsoidal" and ellipsoidal < len(datums) / 2:
        other = next(datum for datum in datums if datum != ELLIPSOIDAL)
        return [
            f'gps_height = "ellipsoidal", but XMP says that the heights of {len(datums) - ellipsoidal} of {num} images '
            f'count from {other}: write gps_height = "crs" in [cameras] if that is the datum of crs'
        ]
    return []


def start_height_warnings(
    over_water: Mapping[str, float], headers: Mapping[str, Exif], level_m: float, place: tuple[float, float], crs: CRS
) -> list[str]:
    """Warning where cameras, water and the drone's height over its take-off point are inconsistent."""
    starts = [
        over - above
        for name, over in over_water.items()
        if (above := headers[name].above_start_m) is not None and np.isfinite(over)
    ]
    start = float(np.median(starts)) if starts else 0.0
    if -_UNDER_WATER_M <= start <= _ABOVE_WATER_M:
        return []
    over = float(np.median(list(over_water.values())))
    return [
        f"the cameras are {over:.1f} m over the water (median), and by RelativeAltitude in XMP {over - start:.1f} m "
        f"over the take-off point, which would lie {abs(start):.1f} m {'under' if start < 0.0 else 'over'} the water; "
        "check that [water] level_m and the heights of the cameras have the same vertical datum"
        f"{explanation(over, level_m, place, crs, over - start)}"
    ]
