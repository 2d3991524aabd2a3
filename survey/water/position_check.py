"""Test whether places on the water lie where the cameras are."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from pyproj import CRS
from scipy.spatial import KDTree

from geo.crs import EARTH_RADIUS_M
from geo.transformation import lon_lat
from survey.errors import ConfigError
from survey.settings.config import WaterConfig
from survey.water.level_observation import LevelObservation

# From the nearest camera: beyond the first, places are not of this survey, as cameras would not be; beyond the second
# they may be of another water.
FARTHEST_M, DOUBTFUL_M = 20e3, 2e3


def doubts_of_water_places(
    crs: CRS, cameras: np.ndarray, water: WaterConfig | None, levels: Iterable[LevelObservation]
) -> list[str]:
    """Warnings where places on the water lie far from the cameras.

    Parameters
    ----------
    cameras : (N, 2)
        Longitude and latitude of WGS 84 [deg].
    levels : of the survey, whose places are in crs

    Raises
    ------
    ConfigError
        If one lies too far away to be of this survey, or on no map.
    """
    cameras = cameras[np.isfinite(cameras).all(axis=1)]
    if water is None or not len(cameras):
        return []
    places: dict[str, list[tuple[float, float]]] = {}
    for level in levels:
        # Clicks are where their rays meet.
        if level.place is not None and level.source != "clicks":
            places.setdefault("level_at" if level.source == "level_m" else level.source, []).append(level.place)
    if water.level_at is not None and not places:
        places["level_at"] = [water.level_at]
    warnings = []
    for source, found in places.items():
        away = _distances_m(crs, cameras, np.array(found))
        worst, num_far = int(np.argmax(away)), int((away > FARTHEST_M).sum())
        said = f"[water] {source}: {int((away > DOUBTFUL_M).sum())} of {len(away)} places"
        if num_far:
            raise ConfigError(_too_far(crs, cameras, source, np.array(found), away))
        if away[worst] > DOUBTFUL_M:
            warnings.append(
                f"{said} lie more than {DOUBTFUL_M / 1e3:g} km from all cameras, the farthest {away[worst] / 1e3:.1f} "
                "km: check that they are on the water that the photographs show"
            )
    return warnings


def _too_far(crs: CRS, cameras: np.ndarray, source: str, places: np.ndarray, away: np.ndarray) -> str:
    worst = int(np.argmax(away))
    e, n = places[worst]
    said = f"[water] {source} has a place at {e:.10g}, {n:.10g}, which "
    if np.isfinite(away[worst]):
        said += f"lies {away[worst] / 1e3:.0f} km from the nearest camera in {crs.name}"
    else:
        said += f"is not on the map of {crs.name}"
    if (_distances_m(crs, cameras, places[:, ::-1]) <= FARTHEST_M).all():
        return f"{said}, and near the cameras as {n:.10g}, {e:.10g}: give easting (or longitude) first"
    return f"{said}; give places on the water of this survey in crs"


def _distances_m(crs: CRS, cameras: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Distances of places (K, 2) in crs to the nearest camera [m], as on a sphere; infinite off the map."""
    degrees = lon_lat(crs, places)
    middle = np.median(cameras, axis=0)
    metres = EARTH_RADIUS_M * np.radians([np.cos(np.radians(middle[1])), 1.0])

    def flat(at: np.ndarray) -> np.ndarray:
        turned = at - middle
        turned[:, 0] = (turned[:, 0] + 180.0) % 360.0 - 180.0
        return turned * metres

    away = np.full(len(places), np.inf)
    known = np.isfinite(degrees).all(axis=1)
    away[known] = KDTree(flat(cameras)).query(flat(degrees[known]))[0]
    return away
