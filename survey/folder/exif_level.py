"""Whether the level of the water fits the heights in EXIF, before structure from motion uses them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pyproj import CRS

from survey.folder.config import SurveyConfig
from survey.folder.datum_mixups import above_start_of, explanation
from survey.folder.plausible import MAX_HEIGHT_OVER_WATER_M, require_level_fits
from survey.folder.pose_priors import common_up_std_of_exif
from survey.photos.exif import Exif

# Heights in EXIF are not off by more standard deviations of what they have in common.
_MOST_STD = 3.0


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
    if over_water.max() > -unknown_m and over_water.min() <= MAX_HEIGHT_OVER_WATER_M + unknown_m:
        return
    like = f"the heights in EXIF{why}; if they are a barometer's, say so: [cameras] position_std_m = [3, 3, 80]"
    require_level_fits(config.water, "EXIF has the cameras", heights, over_water, like)
