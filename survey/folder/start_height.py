"""The height of the take-off point over the water, which a drone's own height over it implies."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from survey.photos.exif import Exif

# A barometer drifts by some metres during a flight, and a drone may start from a boat.
_UNDER_WATER_M = 5.0
# People rarely start further above the water than this; a height above the ellipsoid for one above the sea is.
_ABOVE_WATER_M = 30.0


def start_doubts(over_water: Mapping[str, float], heads: Mapping[str, Exif]) -> list[str]:
    """A warning where cameras, water and the drone's height over its take-off point cannot all be true.

    Parameters
    ----------
    over_water : name to [m]
        Heights of the cameras over the water.
    heads : name to Exif
    """
    starts = [
        over - above
        for name, over in over_water.items()
        if (above := heads[name].above_start_m) is not None and np.isfinite(over)
    ]
    if not starts:
        return []
    start = float(np.median(starts))
    if -_UNDER_WATER_M <= start <= _ABOVE_WATER_M:
        return []
    over = float(np.median(list(over_water.values())))
    side = f"{-start:.1f} m under" if start < 0.0 else f"{start:.1f} m over"
    return [
        f"the cameras are {over:.1f} m over the water (median), and by RelativeAltitude in XMP {over - start:.1f} m "
        f"over the take-off point, which would lie {side} the water; check that [water] level_m and the heights of the "
        "cameras have the same vertical datum"
    ]
