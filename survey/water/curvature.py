"""Still water over a large survey: it follows the curvature of the Earth away from the plane that touches it."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from geo.frames import LocalFrame
from refract import FlatWater, curvature_drop
from survey.water.surface import Departure

SOURCE = "curvature of the Earth"
# Least drop [m] that is followed, of 250 m: depths change by it, and heights of the bed by n - 1 of it, 1.7 mm.
_LEAST_DROP_M = 5e-3
# Places along each side at which its height is computed.
_NODES = 13


class StillWater(Departure):
    """Heights over the plane of water that has one height in crs: of second order, a micrometre off at 10 km."""

    source = SOURCE

    def __post_init__(self):
        object.__setattr__(self, "_tree", KDTree(self.points[:, :2]))

    @cached_property
    def _terms(self) -> np.ndarray:
        return np.linalg.lstsq(self._design(self.points[:, :2]), self.points[:, 2], rcond=None)[0]

    @cached_property
    def _scale(self) -> tuple[np.ndarray, float]:
        xy = self.points[:, :2]
        return xy.mean(axis=0), float(np.ptp(xy, axis=0).max())

    def _design(self, xy: np.ndarray) -> np.ndarray:
        middle, size = self._scale
        x, y = ((xy - middle) / size).T
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)

    def _near(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._design(xy) @ self._terms, np.zeros(len(xy))


def still_water(frame: LocalFrame, plane: FlatWater, centres: np.ndarray) -> StillWater | None:
    """Heights over the plane of water that has one height in crs; None where the plane is as good.

    Parameters
    ----------
    frame : LocalFrame
    plane : FlatWater
        That touches the water at its point, apart from slopes that both have.
    centres : (N, 3) [m], local
        Of the cameras, to know how far the survey reaches.
    """
    point, xy = np.array(plane.point), centres[:, :2]
    if not curvature_drop(np.linalg.norm(xy - point[:2], axis=1).max()) > _LEAST_DROP_M:
        return None
    place = frame.crs_from_local(point)
    up = frame.local_from_grid(place)[:, 2]
    # With the point, since cameras may all hover at one place.
    reached = np.vstack([xy, point[:2]])
    middle, half = 0.5 * (reached.min(axis=0) + reached.max(axis=0)), 0.6 * np.ptp(reached, axis=0).max()
    nodes = np.linspace(-half, half, _NODES)
    ground = middle + np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2)

    def touching(at: np.ndarray) -> np.ndarray:
        return point[2] - (at - point[:2]) @ up[:2] / up[2]

    level = frame.crs_from_local(np.column_stack([ground, touching(ground)]))
    level[:, 2] = place[2]
    points = frame.local_from_crs(level)
    points[:, 2] -= touching(points[:, :2])
    return StillWater(points, np.zeros(len(points)))
