"""Status code per ray; every failed ray is counted."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from refract._array import as_numpy


class Regime(IntEnum):
    """How a ray meets the water, as `BentPaths.regime`, `Projection.regime` and `bend_regime` say it."""

    BENT = 0
    """It passes through the surface."""
    STRAIGHT = 1
    """It never meets the water, or comes from a point that is not below it."""
    PARALLEL = 2
    """It never meets the water because it runs along the surface."""
    UNDER_WATER = 3
    """The camera is on or below the surface: straight."""
    REFLECTED = 4
    """Totally reflected, or on the wrong side of the surface: NaN."""
    CRITICAL = 5
    """It passes, but so near the critical angle that its gradient is set to zero."""
    UNSEEN = 6
    """No path leads from the point to the camera: NaN."""
    INVALID = 7
    """A coordinate is NaN or beyond 1e15 m (`kernels.REACH`), or camera and point coincide: NaN."""


def counts(regime) -> dict[str, int]:
    """How many rays there are of each `Regime`, by its name in lower case; `regime` is an array of any library."""
    found = np.bincount(as_numpy(regime).ravel().astype(np.int64), minlength=len(Regime))
    return {kind.name.lower(): int(found[kind]) for kind in Regime}
