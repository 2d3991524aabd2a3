"""Holes of a cloud in the layer of a box."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from fields.occluded.boxes import CONTEXT_GSD, MARGIN_GSD, Box
from fields.occluded.layer import BedLayer

# A cell has a point of the cloud within so many ground sampling distances in plan, and in height.
_NEAR_GSD, _LEVEL_GSD = 1.5, 4.0
# Fewest cells that are worth a look.
_LEAST_CELLS = 10


@dataclass(frozen=True)
class Holes:
    """Cells of a layer without a point of the cloud, and the cells about them."""

    points: np.ndarray  # (rows, columns, 3) [m], local: of the layer; its height is NaN far from the bed
    are_holes: np.ndarray  # (rows, columns) bool
    # gsd, roughness [m]: side of a cell; standard deviation of the bed from the layer
    gsd: float
    roughness: float

    @property
    def shape(self) -> tuple[int, int]:
        return self.are_holes.shape

    @cached_property
    def corners(self) -> np.ndarray:
        """Points (N, 3) along the border of the layer, to find the photographs that may see it."""
        known = self.points[np.isfinite(self.points[..., 2])]
        east, north = known[:, 0], known[:, 1]
        return known[[east.argmin(), east.argmax(), north.argmin(), north.argmax(), len(known) // 2]]

    @staticmethod
    def of(box: Box, cloud: np.ndarray, area: tuple[float, float, float, float] | None) -> Holes | None:
        """Holes of a cloud (N, 3) [m] in a box and an area (x0, y0, x1, y1); None where few, or no bed is known."""
        x, y = box.places
        inside = np.zeros(x.shape, dtype=bool)
        inside[MARGIN_GSD:-MARGIN_GSD, MARGIN_GSD:-MARGIN_GSD] = True
        if area is not None:
            inside &= (x >= area[0]) & (y >= area[1]) & (x <= area[2]) & (y <= area[3])
        near = cloud[box.around(cloud, CONTEXT_GSD)]
        if not inside.any() or not len(near):
            return None
        layer = BedLayer.of(box, near)
        if layer is None:
            return None
        points = np.stack([x, y, layer.at(x, y)], axis=-1)
        inside &= np.isfinite(points[..., 2])
        # A point above the layer by less than the error of heights lies on it, too. A point below shows that the bed
        # is lower there than the layer: that is no hole.
        floor = layer.at(near[:, 0], near[:, 1])
        seen = np.column_stack([near[:, :2], np.fmax(near[:, 2], floor)])
        flat, reach = np.array([1.0, 1.0, _NEAR_GSD / _LEVEL_GSD]), _NEAR_GSD * box.gsd
        distance, _ = cKDTree(seen * flat).query(points[inside] * flat, distance_upper_bound=reach)
        holes = np.zeros(x.shape, dtype=bool)
        holes[inside] = np.isinf(distance)
        if holes.sum() < _LEAST_CELLS:
            return None
        part = tuple(
            slice(max(index.min() - MARGIN_GSD, 0), index.max() + MARGIN_GSD + 1) for index in np.nonzero(holes)
        )
        return Holes(points[part], holes[part], box.gsd, layer.roughness)
