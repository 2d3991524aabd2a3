"""Boxes beside depth steps: where a surface over the bed may hide some of it from some photographs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from fields.sweep.maps import HeightMap, trusted
from refract import FlatWater, PinholeCamera

# Side of a box, its margin, and how far about it the bed is looked at: in ground sampling distances.
SIDE_GSD, MARGIN_GSD, CONTEXT_GSD = 100, 20, 80
# A step is a rise by more than this, in ground sampling distances, within so many pixels of a height map.
_STEP_GSD, _REACH_PX = 8.0, 6
# Pixels beside steps that make a box.
_LEAST_PIXELS = 30


@dataclass(frozen=True)
class Box:
    """A square of the ground, of cells of one ground sampling distance, with a margin."""

    # x, y [m], local: its lower corner, without the margin
    x: float
    y: float
    gsd: float  # [m]

    @cached_property
    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (rows, columns) [m] of its cells, margin included."""
        along = (np.arange(-MARGIN_GSD, SIDE_GSD + MARGIN_GSD) + 0.5) * self.gsd
        return tuple(np.meshgrid(self.x + along, self.y + along))

    def around(self, points: np.ndarray, margin: float) -> np.ndarray:
        """Points (N, 3) within it and a margin [ground sampling distances]: (N,) bool."""
        low, high = -margin * self.gsd, (SIDE_GSD + margin) * self.gsd
        east, north = points[:, 0] - self.x, points[:, 1] - self.y
        return (east >= low) & (east < high) & (north >= low) & (north < high)


def step_places(camera: PinholeCamera, water: FlatWater | None, height_map: HeightMap, gsd: float) -> np.ndarray:
    """Places (N, 2) [m], local, of trusted pixels of a map beside which it rises steeply."""
    part = np.s_[: camera.height, : camera.width]
    sure, height = trusted(height_map)[part], height_map.height[part]
    side = 2 * _REACH_PX + 1
    highest = cv2.dilate(np.where(sure, height, np.float32(-np.inf)), np.ones((side, side), np.uint8))
    row, column = np.nonzero(sure & (highest - height > _STEP_GSD * gsd))
    path = camera.paths(np.column_stack([column + 0.5, row + 0.5]), water)
    return path.at_height(height[row, column].astype(np.float64), water)[:, :2]


def boxes_about(places: Iterable[np.ndarray], gsd: float) -> list[Box]:
    """Boxes that hold enough of such places, each part of the ground in one of them at most."""
    side = SIDE_GSD * gsd
    found = [np.floor(each / side).astype(np.int64) for each in places]
    corners, count = np.unique(np.concatenate([np.empty((0, 2), dtype=np.int64), *found]), axis=0, return_counts=True)
    return [Box(float(x * side), float(y * side), gsd) for x, y in corners[count >= _LEAST_PIXELS].tolist()]
