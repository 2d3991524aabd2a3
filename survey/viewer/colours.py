"""Colours of points by their attributes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

# Of values that are not known.
UNKNOWN = (128, 128, 128)
# Values beyond these shares do not stretch the colours; of errors a tenth is beyond, that at rims and walls.
_SHARES, _OF_ERRORS = (0.02, 0.98), 0.9
# Points by which a range is found.
_SOME = 200_000
_STEPS = 256


@dataclass(frozen=True)
class Scale:
    """How the values of a quantity become colours.

    Attributes
    ----------
    label, unit : str
    colormap : str
        A name of `survey.display.palette`, or of matplotlib.
    is_signed : bool
        Zero has the middle colour.
    """

    label: str
    unit: str
    colormap: str
    is_signed: bool = False

    def limits(self, values: np.ndarray) -> tuple[float, float]:
        """Values (low, high) of the first and the last colour, by the values (N,) of the cloud."""
        some = values[:: len(values) // _SOME + 1]
        some = some[np.isfinite(some)]
        if not len(some):
            return 0.0, 1.0
        if self.is_signed:
            most = max(float(np.quantile(np.abs(some), _OF_ERRORS)), 1e-6)
            return -most, most
        low, high = (float(v) for v in np.quantile(some, _SHARES))
        return low, max(high, low + 1e-6)

    def colours(self, values: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
        """Colours (N, 3) uint8 of values (N,)."""
        low, high = limits
        share = (values - low) / (high - low)
        known = np.isfinite(share)
        step = np.clip(np.where(known, share, 0.0) * _STEPS, 0, _STEPS - 1).astype(np.int64)
        return np.where(known[:, None], _table(self.colormap)[step], np.array(UNKNOWN, dtype=np.uint8))

    def bar(self, width: int, height: int) -> np.ndarray:
        """The colours from low to high as a picture (height, width, 3) uint8."""
        steps = (np.arange(width) * _STEPS) // width
        return np.broadcast_to(_table(self.colormap)[steps], (height, width, 3)).copy()


@lru_cache
def _table(name: str) -> np.ndarray:
    """The colours (256, 3) uint8 of a colour map."""
    from matplotlib import colormaps

    from survey.display import palette

    drawn = getattr(palette, name, None)
    colormap = drawn if callable(drawn) else colormaps[drawn or name]
    return np.round(255.0 * colormap(np.linspace(0.0, 1.0, _STEPS))[:, :3]).astype(np.uint8)


# By the name of the column in `survey.viewer.shown.Shown`, in the order in which they are offered.
SCALES = {
    "height": Scale("height", "m", "HEIGHTS"),
    "depth": Scale("true depth", "m", "DEPTHS"),
    "std": Scale("std, random", "m", "SPREADS"),
    "std_common": Scale("std, shared", "m", "SPREADS"),
    "num_views": Scale("number of views", "", "COUNTS"),
    "error": Scale("error to the reference", "m", "DIFFERENCES", is_signed=True),
}
