"""Mix-ups of vertical datums between the heights of cameras and water.

With them the height of the take-off point over the water, which a drone's height over take-off implies.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pyproj import CRS

from geo.crs import height_unit_m, vertical_crs
from geo.transformation import lon_lat
from geo.undulation import rough_undulation_m
from survey.photos.exif import Exif
from survey.photos.xmp import ELLIPSOIDAL

# A barometer drifts by some metres during a flight, and a drone may start from a boat.
UNDER_WATER_M = 5.0
# People rarely start further above the water than this; a height above the ellipsoid for one above the sea is.
ABOVE_WATER_M = 30.0
# Without a height over the take-off point: how high drones fly that photograph a bed.
_LOWEST_FLIGHT_M, _HIGHEST_FLIGHT_M = 2.0, 150.0
# The geoid is known here to some metres, and so are heights in EXIF.
_ROUGH_M = 10.0
_FOOT_M = 0.3048
# Heights over the take-off point that stand for heights in crs are the same numbers.
_SAME_M = 3.0


def place_of(crs: CRS, point_crs: np.ndarray) -> tuple[float, float]:
    """Latitude and longitude [deg] of a point in crs."""
    lon, lat = lon_lat(crs, np.asarray(point_crs, dtype=np.float64)[None])[0]
    return float(lat), float(lon)


def above_start_of(heads: Mapping[str, Exif]) -> float | None:
    """The median height [m] over the take-off point, by XMP; None where no photograph has one."""
    heights = [head.above_start_m for head in heads.values() if head.above_start_m is not None]
    return float(np.median(heights)) if heights else None


def explanation(
    over_m: float, level_m: float, place: tuple[float, float], crs: CRS, above_start_m: float | None
) -> str:
    """Explanation of cameras `over_m` over the water, as the rest of a sentence; empty without one.

    Parameters
    ----------
    over_m, level_m : [m]
        Height of the cameras over the water, median; the level.
    place : (latitude, longitude) [deg]
    above_start_m : [m] or None
        Height of the cameras over the take-off point, median.
    """
    cameras_m, unit = level_m + over_m, height_unit_m(crs)
    undulation = rough_undulation_m(*place)
    side = "over" if undulation > 0.0 else "under"
    geoid = f"the geoid lies about {abs(undulation):.0f} m {side} the ellipsoid here"
    candidates = [
        (over_m - undulation, f"{geoid}, and heights of the cameras above the ellipsoid with a level above the sea"),
        (over_m + undulation, f"{geoid}, and a level above the ellipsoid with heights of the cameras above the sea"),
    ]
    if above_start_m is not None and abs(cameras_m - above_start_m) < _SAME_M:
        candidates.append((above_start_m, "heights of the cameras over the take-off point instead of heights in crs"))
    if unit != 1.0:
        candidates.append((cameras_m - level_m * unit, "a level in the unit of crs instead of metres"))
    else:
        candidates.append((cameras_m * _FOOT_M - level_m, "heights of the cameras in feet"))
    found = [
        f"{words} would explain it: the cameras would be {over:.0f} m over the water"
        for over, words in candidates
        if _is_plausible(over, above_start_m) and abs(over - over_m) > _LOWEST_FLIGHT_M
    ]
    return f"; {'; or '.join(found)}" if found else ""


def _is_plausible(over_m: float, above_start_m: float | None) -> bool:
    if above_start_m is None:
        return _LOWEST_FLIGHT_M <= over_m <= _HIGHEST_FLIGHT_M
    return -UNDER_WATER_M - _ROUGH_M <= over_m - above_start_m <= ABOVE_WATER_M + _ROUGH_M


def low_flight_doubts(over_m: np.ndarray, level_m: float, place: tuple[float, float], crs: CRS) -> list[str]:
    """A warning where cameras (N,) [m] over the water fly nearly on it."""
    middle = float(np.median(over_m))
    if not 0.0 < middle < _LOWEST_FLIGHT_M:
        return []
    return [
        f"the cameras are only {middle:.2f} m over the water (median): check that level_m and the heights of the "
        f"cameras count from the same{explanation(middle, level_m, place, crs, None)}"
    ]


def exif_doubts(heights_m: Mapping[str, float], heads: Mapping[str, Exif]) -> list[str]:
    """A warning where poses and EXIF differ in height by as much as the geoid and the ellipsoid do.

    Parameters
    ----------
    heights_m : name to [m]
        Of the cameras, by their poses.
    heads : name to Exif
    """
    if above_start_of(heads) is not None:
        return []  # tells more: `survey.folder.datum_mixups`
    known = [(name, head.lat_lon_height) for name, head in heads.items() if name in heights_m]
    pairs = [(heights_m[name], position) for name, position in known if position is not None]
    pairs = [(height, position) for height, position in pairs if np.isfinite(position[2])]
    if not pairs:
        return []
    higher = float(np.median([height - position[2] for height, position in pairs]))
    lat, lon = np.median([position[:2] for _, position in pairs], axis=0)
    undulation = rough_undulation_m(lat, lon)
    if abs(undulation) < 2.0 * _ROUGH_M or abs(abs(higher) - abs(undulation)) > _ROUGH_M:
        return []
    return [
        f"the poses lie {abs(higher):.0f} m {'above' if higher > 0.0 else 'below'} the heights in EXIF, about as much "
        f"as the geoid differs from the ellipsoid here ({undulation:.0f} m): one of them counts from the ellipsoid; "
        "check that [water] level_m counts from where the poses do"
    ]


def xmp_doubts(gps_height: str, crs: CRS, heads: Mapping[str, Exif]) -> list[str]:
    """A warning where XMP says that GPS heights count from something else than `gps_height` takes them for."""
    vertical, said = vertical_crs(crs), [head.height_datum for head in heads.values() if head.height_datum is not None]
    if not said or vertical is None:
        return []
    ellipsoidal = sum(datum == ELLIPSOIDAL for datum in said)
    if gps_height == "crs" and ellipsoidal > len(said) / 2:
        return [
            f"XMP says that the heights of {ellipsoidal} of {len(heads)} images count from the ellipsoid, and "
            f'gps_height = "crs" takes them as {vertical.name}: write gps_height = "ellipsoidal" in [cameras], and '
            "level_m in the heights of crs"
        ]
    if gps_height == "ellipsoidal" and ellipsoidal < len(said) / 2:
        other = next(datum for datum in said if datum != ELLIPSOIDAL)
        return [
            f'gps_height = "ellipsoidal", but XMP says that the heights of {len(said) - ellipsoidal} of {len(heads)} '
            f'images count from {other[:40]}: write gps_height = "crs" in [cameras] if that is the datum of crs'
        ]
    return []


def start_doubts(
    over_water: Mapping[str, float], heads: Mapping[str, Exif], level_m: float, place: tuple[float, float], crs: CRS
) -> list[str]:
    """Warning where cameras, water and the drone's height over its take-off point are inconsistent.

    Parameters
    ----------
    over_water : name to [m]
        Heights of the cameras over the water.
    heads : name to Exif
    level_m : [m]
    place : (latitude, longitude) [deg]
    """
    starts = [
        over - above
        for name, over in over_water.items()
        if (above := heads[name].above_start_m) is not None and np.isfinite(over)
    ]
    if not starts:
        return []
    start = float(np.median(starts))
    if -UNDER_WATER_M <= start <= ABOVE_WATER_M:
        return []
    over = float(np.median(list(over_water.values())))
    side = f"{-start:.1f} m under" if start < 0.0 else f"{start:.1f} m over"
    return [
        f"the cameras are {over:.1f} m over the water (median), and by RelativeAltitude in XMP {over - start:.1f} m "
        f"over the take-off point, which would lie {side} the water; check that [water] level_m and the heights of the "
        f"cameras have the same vertical datum{explanation(over, level_m, place, crs, over - start)}"
    ]
