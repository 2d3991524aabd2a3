"""Height of the take-off point over the water, implied by a drone's height over take-off."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pyproj import CRS

from survey.folder.datum_mixups import ABOVE_WATER_M, UNDER_WATER_M, explanation
from survey.photos.exif import Exif


def start_doubts(
    over_water: Mapping[str, float], heads: Mapping[str, Exif], level_m: float, place: tuple[float, float], crs: CRS
) -> list[str]:
    """A warning where cameras, water and the drone's height over its take-off point cannot all be true.

    Parameters
    ----------
    over_water : name to [m]
        Heights of the cameras over the water.
    heads : name to Exif
    level_m : [m]
    place : (latitude, longitude) [deg]
    crs : pyproj.CRS
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
