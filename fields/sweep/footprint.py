"""The ground that a view may show, as a rectangle in plan: views whose rectangles do not meet share nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from refract import FlatWater, PinholeCamera

# Places along each side of an image, and the share of its extent by which a rectangle is wider than they say.
_PLACES, _MARGIN = 17, 0.02


@dataclass(frozen=True)
class Footprint:
    """A rectangle; low and high corner (2,) [m], local, infinite where a view sees to the horizon."""

    low: np.ndarray
    high: np.ndarray

    @staticmethod
    def of(camera: PinholeCamera, water: FlatWater | None, heights: tuple[float, float]) -> Footprint:
        """Of what lies between two heights [m] over the water plane."""
        share = np.linspace(0.0, 1.0, _PLACES)
        sides = [[(x, y) for x in share for y in (0.0, 1.0)], [(x, y) for x in (0.0, 1.0) for y in share]]
        paths = camera.paths(np.concatenate(sides) * (camera.width, camera.height), water)
        # Paths are straight between these heights: they bend at the water.
        levels = {*heights, float(np.clip(0.0, *heights))}
        points = np.concatenate([paths.at_height(np.full(4 * _PLACES, level), water)[:, :2] for level in levels])
        if not np.isfinite(points).all():
            return Footprint(np.full(2, -np.inf), np.full(2, np.inf))
        low, high = points.min(axis=0), points.max(axis=0)
        margin = _MARGIN * (high - low).max()
        return Footprint(low - margin, high + margin)

    def meets(self, other: Footprint) -> bool:
        """Whether the two have ground in common."""
        return bool((self.low <= other.high).all() and (other.low <= self.high).all())
