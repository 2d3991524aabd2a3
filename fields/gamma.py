"""Gamma: linear light to stored grey levels and back."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

# sRGB-like photographs are linear in light to the power of 2.2.
GAMMA = 2.2
# Clamp, darker than any photograph resolves: below it the derivative of the gamma curve diverges.
DARKEST = 1e-4


def as_stored(radiance: Tensor) -> Tensor:
    """Stored values, 0 to 1 (more where overexposed), of linear radiance, which is clamped to `DARKEST`."""
    return radiance.clamp(min=DARKEST) ** (1.0 / GAMMA)
