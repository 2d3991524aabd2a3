"""Consistency of the water level with the heights in EXIF, before structure from motion."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pyproj import CRS
from scipy.spatial import KDTree

from geo.crs import EARTH_RADIUS_M
from survey.folder.datum_mixups import above_start_of, explanation
from survey.folder.plausible import (
    AIRCRAFT_HEIGHT_M,
    DRONE_HEIGHT_M,
    MOST_OF_OVERLAP,
    USUAL_OVERLAP,
    require_level_fits,
)
from survey.folder.pose_priors import common_up_std_of_exif
from survey.photos.exif import Exif
from survey.settings.config import SurveyConfig

# Heights in EXIF are not off by more standard deviations of what they have in common.
_MOST_STD = 3.0
# Of the shorter side of a photograph over its focal length, of the lenses of drones.
_SHORT_SIDE = 0.6


def require_level_fits_exif(config: SurveyConfig, heads: Mapping[str, Exif], crs: CRS) -> None:
    """Raise where the level cannot fit the heights in EXIF, which structure from motion would use.

    Raises
    ------
    ConfigError
        Where all images lie under the water or far above it, by more than heights in EXIF may have in common; or by
        less, if a mix-up of datums explains it and `position_std_m` does not say that they are as bad.
    """
    places = np.array([h.lat_lon_height for h in heads.values() if h.lat_lon_height is not None]).reshape(-1, 3)
    places = places[np.isfinite(places).all(axis=1)]
    heights = places[:, 2]
    if config.water is None or config.water.level_m is None or config.cameras.gps_height != "crs" or not heights.size:
        return
    over_water = heights - config.water.known_level_m
    lat, lon, _ = np.median(places, axis=0).tolist()
    why = explanation(float(np.median(over_water)), config.water.known_level_m, (lat, lon), crs, above_start_of(heads))
    unknown_m = _MOST_STD * common_up_std_of_exif(config.cameras, heads)
    if why and config.cameras.position_std_m is None:
        unknown_m = 0.0
    most_m = DRONE_HEIGHT_M if why else _most_over_water(places)
    if over_water.max() > -unknown_m and over_water.min() <= most_m + unknown_m:
        return
    like = f"the heights in EXIF{why}; if they are a barometer's, say so: [cameras] position_std_m = [3, 3, 80]"
    require_level_fits(config.water, "EXIF has the cameras", heights, over_water, like, most_m=most_m)


def _most_over_water(places: np.ndarray) -> float:
    """Height over the water [m] that cameras at places (N, 3) can have, by how far apart they are.

    As `survey.folder.plausible.most_over_water` for lenses that are not known yet.
    """
    metres = EARTH_RADIUS_M * np.radians(places[:, :2]) * [1.0, np.cos(np.radians(np.median(places[:, 0])))]
    base = float(np.median(KDTree(metres).query(metres, k=2)[0][:, 1])) if len(places) > 1 else 0.0
    by_overlap = base / ((1.0 - USUAL_OVERLAP) * _SHORT_SIDE)
    return float(np.clip(MOST_OF_OVERLAP * by_overlap, DRONE_HEIGHT_M, AIRCRAFT_HEIGHT_M))
