"""Between linear light and the numbers that a photograph stores."""

from __future__ import annotations

from torch import Tensor

# sRGB-like photographs are linear in light to the power of 2.2.
GAMMA = 2.2
# Light that is darker than any photograph tells: below, the slope of the stored value has no bound.
DARKEST = 1e-4


def as_stored(radiance: Tensor) -> Tensor:
    """What a photograph stores, 0 to 1 (more where it is overexposed), of linear radiance; at least `DARKEST` of it."""
    return radiance.clamp(min=DARKEST) ** (1.0 / GAMMA)
