"""Boxes beside depth steps, the layer of the bed in each, carried on below what stands over it, and holes of the cloud.

Beside a step a surface over the bed may hide some of it from some photographs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from scipy import sparse
from scipy.linalg import solveh_banded
from scipy.ndimage import binary_erosion, distance_transform_edt, grey_dilation, grey_erosion, map_coordinates
from scipy.spatial import cKDTree

from evaluation.summary import std_by_median
from fields.sweep.maps import HeightMap, trusted
from refract import FlatWater, PinholeCamera

# Side of a box, its margin, and how far about it the bed is looked at: in ground sampling distances.
SIDE_GSD, MARGIN_GSD, CONTEXT_GSD = 100, 20, 80
# A step is a rise by more than this, in ground sampling distances, within so many pixels of a height map.
_STEP_GSD, _REACH_PX = 8.0, 6
_AT_ONCE = 200_000  # Pixels beside steps whose rays are bent at a time, of some 500 bytes each
_LEAST_PIXELS = 30  # Pixels beside steps that make a box
# Side of the cells of the layer, half the width of what may stand over the bed, and the thickness of the bed in a
# cell: in ground sampling distances.
_CELL_GSD, _RADIUS_GSD, _THICK_GSD = 5, 60, 3.0
# Points of the bed are this near to the morphologically opened surface, then to the smooth one, in ground sampling
# distances.
_OPENED_GSD, _SMOOTH_GSD = 14.0, (8.0, 4.5, 3.0, 3.0)
# Weight of second differences against heights: while the bed is classified, and for the final surface.
_STIFF, _SOFT = 10.0, 1.0
_BEYOND_GSD = 30.0  # How far the layer goes beyond the bed, in ground sampling distances
_LEAST_BED = 0.1  # Least share of the cells that are bed
# A cell has a point of the cloud within so many ground sampling distances in plan, and in height.
_NEAR_GSD, _LEVEL_GSD = 1.5, 4.0
_LEAST_CELLS = 10  # Fewest cells that are worth a look


@dataclass(frozen=True)
class StepBox:
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


def step_places(
    camera: PinholeCamera, water: FlatWater | None, height_map: HeightMap, gsd: float
) -> Iterator[np.ndarray]:
    """Places [m], local, of trusted pixels of a map beside which it rises steeply, in parts (N, 2)."""
    shape = np.s_[: camera.height, : camera.width]
    is_trusted, height = trusted(height_map)[shape], height_map.height[shape]
    side = 2 * _REACH_PX + 1
    highest = cv2.dilate(np.where(is_trusted, height, np.float32(-np.inf)), np.ones((side, side), np.uint8))
    pixels = np.flatnonzero(is_trusted & (highest - height > _STEP_GSD * gsd))
    for first in range(0, len(pixels), _AT_ONCE):
        row, column = np.divmod(pixels[first : first + _AT_ONCE], camera.width)
        path = camera.paths(np.column_stack([column + 0.5, row + 0.5]), water)
        yield path.at_height(height[row, column].astype(np.float64), water)[:, :2]


def boxes_about(places: Iterable[np.ndarray], gsd: float) -> list[StepBox]:
    """Boxes that hold enough of such places, each part of the ground in one of them at most."""
    side, pixels = SIDE_GSD * gsd, Counter[tuple[int, int]]()
    for part in places:
        column, row = np.floor(part / side).astype(np.int64).T
        # One number for each corner: rows of an array take twenty times as long to sort.
        number, count = np.unique((row << 32) + column, return_counts=True)
        column = (number + 2**31) % 2**32 - 2**31
        row = (number - column) >> 32
        pixels.update(dict(zip(zip(column.tolist(), row.tolist(), strict=True), count.tolist(), strict=True)))
    enough = sorted(corner for corner, count in pixels.items() if count >= _LEAST_PIXELS)
    return [StepBox(float(x * side), float(y * side), gsd) for x, y in enough]


class BedLayer:
    """A smooth surface through the lowest points about a box.

    ``roughness`` [m]: standard deviation of the bed from it.
    """

    def __init__(self, box: StepBox, low: np.ndarray, is_bed: np.ndarray):
        z = smooth(low, is_bed, _SOFT)
        far = _CELL_GSD * distance_transform_edt(~is_bed) > _BEYOND_GSD
        self._box, self._z = box, np.where(far, np.nan, z)
        left = (low - z)[is_bed]
        self.roughness = float(std_by_median(left))

    @staticmethod
    def of(box: StepBox, points: np.ndarray) -> BedLayer | None:
        """Layer of points (N, 3) [m], local; None where too little of the bed is known."""
        low = _lowest(box, points)
        known = np.isfinite(low)
        if known.mean() < _LEAST_BED:
            return None
        reach = _RADIUS_GSD // _CELL_GSD
        offsets = np.arange(-reach, reach + 1)
        disc = offsets[:, None] ** 2 + offsets**2 <= reach * reach
        eroded = grey_erosion(np.where(known, low, np.inf), footprint=disc, mode="nearest")
        opened = grey_dilation(np.where(np.isinf(eroded), -np.inf, eroded), footprint=disc, mode="nearest")
        is_bed = known & (low < opened + _OPENED_GSD * box.gsd)
        for within in _SMOOTH_GSD:
            if is_bed.mean() < _LEAST_BED:
                return None
            is_bed = known & (np.abs(low - smooth(low, is_bed, _STIFF)) < within * box.gsd)
        # Beside an edge the windows of the sweep raise the bed.
        is_bed = binary_erosion(is_bed, np.ones((3, 3)), border_value=1)
        return BedLayer(box, low, is_bed) if is_bed.mean() >= _LEAST_BED else None

    def at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Heights [m], local z, of the layer at places (...) [m]; NaN far from the bed."""
        cell, context = _CELL_GSD * self._box.gsd, CONTEXT_GSD * self._box.gsd
        row, column = ((each + context) / cell - 0.5 for each in (y - self._box.y, x - self._box.x))
        return map_coordinates(self._z, [row, column], order=1, mode="nearest")


def _lowest(box: StepBox, points: np.ndarray) -> np.ndarray:
    """Mean height of the lowest points of each cell about a box; NaN where none is."""
    size = (SIDE_GSD + 2 * CONTEXT_GSD) // _CELL_GSD
    cell = _CELL_GSD * box.gsd
    column, row = (
        # Rounding may put a point beside the upper edge.
        ((points[:, axis] - corner) / cell + CONTEXT_GSD / _CELL_GSD).astype(np.int64).clip(0, size - 1)
        for axis, corner in enumerate((box.x, box.y))
    )
    index, z = row * size + column, points[:, 2]
    order = np.lexsort((z, index))
    index, z = index[order], z[order]
    first = np.searchsorted(index, np.arange(size * size))
    count = np.bincount(index, minlength=size * size)
    # Of some points the lowest may be a stray.
    least = z[np.minimum(first + count // 10, max(len(z) - 1, 0))] if len(z) else np.zeros(size * size)
    near = np.abs(z - least[index]) < _THICK_GSD * box.gsd
    number = np.bincount(index[near], minlength=size * size)
    total = np.bincount(index[near], weights=z[near], minlength=size * size)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan).reshape(size, size)


def smooth(values: np.ndarray, known: np.ndarray, stiffness: float) -> np.ndarray:
    """Surface (rows, columns) near the known values, with the least second differences elsewhere: a thin plate."""
    diagonals = stiffness * _bending(values.shape)
    diagonals[0] += known.ravel()
    return solveh_banded(diagonals, np.where(known, values, 0.0).ravel(), lower=True).reshape(values.shape)


@lru_cache(maxsize=4)
def _bending(shape: tuple[int, int]) -> np.ndarray:
    """Sum of squares of the second differences of a grid as a matrix: its diagonal and those below."""
    rows, columns = (sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(size - 2, size)) for size in shape)
    down, across = (sparse.diags([-1.0, 1.0], [0, 1], shape=(size - 1, size)) for size in shape)
    parts = (
        (1.0, sparse.kron(rows, sparse.eye(shape[1]))),
        (1.0, sparse.kron(sparse.eye(shape[0]), columns)),
        (2.0, sparse.kron(down, across)),
    )
    matrix = sum(weight * (part.T @ part) for weight, part in parts)
    # Second differences reach two rows down.
    return np.stack([np.pad(matrix.diagonal(-below), (0, below)) for below in range(2 * shape[1] + 1)])


@dataclass(frozen=True)
class KnownBed:
    """The points of a cloud, in whose holes more are looked for."""

    xyz: np.ndarray  # (N, 3) [m], local
    gsd: float  # [m]: ground sampling distance
    area: tuple[float, float, float, float] | None = None  # (x0, y0, x1, y1) [m], local: where points are wanted

    def about(self, box: StepBox) -> np.ndarray:
        """Points (M, 3) within a box and its surroundings, in their order."""
        middle, reach = 0.5 * SIDE_GSD * self.gsd, (0.5 * SIDE_GSD + CONTEXT_GSD + 1.0) * self.gsd
        number = self.tree.query_ball_point([box.x + middle, box.y + middle], reach, p=np.inf, return_sorted=True)
        near = self.xyz[np.array(number, dtype=np.int64)]
        return near[box.around(near, CONTEXT_GSD)]

    @cached_property
    def tree(self) -> cKDTree:
        """Tree of the points in plan, to be made once before threads ask for some."""
        return cKDTree(self.xyz[:, :2], balanced_tree=False, compact_nodes=False)


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
    def probe_points(self) -> np.ndarray:
        """Its outermost points to all four sides and a middle one, (5, 3), to find the photographs that may see it."""
        known = self.points[np.isfinite(self.points[..., 2])]
        east, north = known[:, 0], known[:, 1]
        return known[[east.argmin(), east.argmax(), north.argmin(), north.argmax(), len(known) // 2]]

    @staticmethod
    def of(box: StepBox, known: KnownBed) -> Holes | None:
        """Holes of a cloud in a box and in its area; None where few, or no bed is known."""
        area = known.area
        x, y = box.places
        inside = np.zeros(x.shape, dtype=bool)
        inside[MARGIN_GSD:-MARGIN_GSD, MARGIN_GSD:-MARGIN_GSD] = True
        if area is not None:
            inside &= (x >= area[0]) & (y >= area[1]) & (x <= area[2]) & (y <= area[3])
        if not inside.any():
            return None
        near = known.about(box)
        if not len(near):
            return None
        layer = BedLayer.of(box, near)
        if layer is None:
            return None
        points = np.stack([x, y, layer.at(x, y)], axis=-1)
        inside &= np.isfinite(points[..., 2])
        # A point above the layer by less than the error of heights lies on it, too. A point below shows that the bed
        # is lower there than the layer: that is not a hole.
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
