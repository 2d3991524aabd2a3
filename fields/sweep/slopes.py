"""Slopes of height maps, and the filter of steep pixels: walls and edges."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from fields.image_store import Masks
from fields.sweep.kernels.arrays import floats, host
from fields.sweep.kernels.backend import kernels
from fields.sweep.kernels.rays import point_at
from fields.sweep.kernels.stack import ViewStack

# Heights around a pixel on a wall lie in one plane: residuals (rms) below this share of its slope. A step has 0.47.
_MOST_BENT = 0.4
# An edge is located to the windows of the sweep only: heights within this square may be those of its pixel [px].
_NEAR_PX = 5
# Rise from column to column of the plane through 3x3 heights.
_RISE = np.tile(np.array([-1.0, 0.0, 1.0], dtype=np.float32) / 6.0, (3, 1))
# A steep pixel is dropped if more maps see through its point than contain it. One is added if so many maps contain it
# and at most this share of them see through it.
_LEAST_FOR, _MOST_AGAINST = 4, 0.25
# Gaps that are filled have this radius, in ground sampling distances.
_GAP_GSD = 1.25
# Spatial hash: side of a cell in distances, size of the table, primes of the hash.
_CUBE, _TABLE_SIZE, _PRIMES = 4.0, 2**22, (73_856_093, 19_349_663, 83_492_791)


def steep_and_wall_pixels(height: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Steep pixels (height, width) bool, and those of them on a wall: in one plane with all around.

    Steep is what differs from the neighbours by more than what counts as agreement, ``tolerance`` [m].
    """
    slope = slope_of(height)
    # About the middle of the map: squares of large heights would lose the small ones.
    height = height - np.median(height)
    mean, square = (cv2.blur(each, (3, 3)) for each in (height, height * height))
    # Along its rise the squares of a plane are two thirds of that of its slope.
    off_plane = square - mean * mean - (2.0 / 3.0) * slope * slope
    steep = slope > tolerance
    return steep, steep & (off_plane < (_MOST_BENT * slope) ** 2)


def half_range(height: np.ndarray) -> np.ndarray:
    """Half of the range of the heights within two pixels, (height, width) [m]."""
    about = np.ones((_NEAR_PX, _NEAR_PX), np.uint8)
    return 0.5 * (cv2.dilate(height, about) - cv2.erode(height, about))


def slope_of(height: np.ndarray) -> np.ndarray:
    """Slope (height, width) float32 [m per pixel] of the plane through 3x3 heights."""
    return cv2.magnitude(*gradient_of(height))


def gradient_of(height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient of that plane along columns and rows, (height, width) float32 [m per pixel] each."""
    across, down = (cv2.filter2D(height, -1, kernel) for kernel in (_RISE, _RISE.T))
    return across, down


@dataclass(frozen=True)
class SteepPixels:
    """Steep pixels of height maps.

    Attributes
    ----------
    steep : Masks
    fit : Masks
        Those of them that may be added.
    sure : Masks
        All pixels, steep or not, whose heights count against a point.
    """

    steep: Masks
    fit: Masks
    sure: Masks


@dataclass(frozen=True)
class _Pixels:
    """N pixels of height maps: number of the map, flat index in it, and points (3, N) in the frame of the water."""

    number: np.ndarray
    pixel: np.ndarray
    xyz: np.ndarray

    @staticmethod
    def of(stack: ViewStack, masks: Iterable[np.ndarray]) -> _Pixels:
        """Those of masks (height, width) bool, one for each map."""
        pixels = [np.flatnonzero(mask) for mask in masks]
        number = np.repeat(np.arange(len(pixels)), [len(each) for each in pixels])
        parts = [_points(stack, number, each) for number, each in enumerate(pixels)]
        return _Pixels(number, np.concatenate(pixels), np.concatenate(parts, axis=1))

    def __getitem__(self, which: np.ndarray) -> _Pixels:
        return _Pixels(self.number[which], self.pixel[which], self.xyz[:, which])

    def votes(self, stack: ViewStack, sure: Masks, apart: float) -> tuple[np.ndarray, np.ndarray]:
        """Number of other maps (N,) that contain the point, and number that see through it."""
        having, through = (np.zeros(len(self.number), dtype=np.int32) for _ in range(2))
        if not len(self.number):
            return having, through
        points = tuple(floats(stack.device, each) for each in self.xyz)
        for number, mask in enumerate(sure):
            other = self.number != number
            has, looks = kernels(stack.device).vote_on_points(stack, points, number, apart, mask)
            having += has & other
            through += looks & other
        return having, through

    def mark(self, masks: Masks, to: bool) -> None:
        """Set these pixels of masks."""
        for number in np.unique(self.number):
            mask = np.array(masks[number])
            mask.flat[self.pixel[self.number == number]] = to
            masks[number] = mask


def filter_steep_pixels(stack: ViewStack, found: SteepPixels, kept: Masks, gsd: float) -> None:
    """Update the ``kept`` pixels: drop steep ones that other maps see through, add others that fill gaps on walls.

    ``stack`` has the height maps. A map has a point that lies within ``gsd`` [m] of its heights there, and looks
    through one that lies farther above them.
    """
    if not len(kept):
        return
    old = _Pixels.of(stack, (keep & steep for keep, steep in zip(kept, found.steep, strict=True)))
    having, through = old.votes(stack, found.sure, gsd)
    old[through > having].mark(kept, False)
    new = _Pixels.of(stack, (fit & ~keep for fit, keep in zip(found.fit, kept, strict=True)))
    new = new[_far_from(stack, kept, new.xyz, _GAP_GSD * gsd)]
    having, through = new.votes(stack, found.sure, gsd)
    new = new[(having >= _LEAST_FOR) & (through <= _MOST_AGAINST * having)]
    new[thin_out(new.xyz.T, _GAP_GSD * gsd)].mark(kept, True)


def thin_out(points: np.ndarray, distance: float) -> np.ndarray:
    """Greedy thinning of points (N, 3) to a least distance: (N,) bool."""
    left, taken = np.ones(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
    pairs = cKDTree(points).query_pairs(distance, output_type="ndarray")
    while left.any():
        first = left.copy()
        first[pairs[:, 1]] = False
        taken |= first
        left &= ~first
        left[pairs[first[pairs[:, 0]], 1]] = False
        pairs = pairs[left[pairs].all(axis=1)]
    return taken


def _points(stack: ViewStack, number: int, pixels: np.ndarray) -> np.ndarray:
    """Points (3, N) float32 of pixels of a map."""
    if not len(pixels):
        return np.zeros((3, 0), dtype=np.float32)
    point = point_at(*kernels(stack.device).rays_and_heights(stack, number, pixels))
    return np.stack([host(stack.device, each) for each in point])


def _far_from(stack: ViewStack, kept: Sequence[np.ndarray], xyz: np.ndarray, distance: float) -> np.ndarray:
    """Points (3, N) farther than a distance from all kept ones: (N,) bool."""
    if not xyz.size:
        return np.ones(xyz.shape[1], dtype=bool)
    # Few of the points that are kept are near any.
    corners = np.stack(np.meshgrid(*[(-distance, distance)] * 3)).reshape(3, 8, 1).astype(np.float32)
    reached = np.zeros(_TABLE_SIZE, dtype=bool)
    for corner in corners.transpose(1, 0, 2):
        reached[_hash_cells(xyz + corner, distance)] = True
    near = []
    for number, keep in enumerate(kept):
        points = _points(stack, number, np.flatnonzero(keep))
        near.append(points[:, reached[_hash_cells(points, distance)]])
    tree = cKDTree(np.concatenate(near, axis=1).T, balanced_tree=False, compact_nodes=False)
    return np.isinf(tree.query(xyz.T, distance_upper_bound=distance)[0])


def _hash_cells(points: np.ndarray, distance: float) -> np.ndarray:
    """Spatial hash (N,) of the grid cell of each of the points (3, N); distant cells may collide."""
    cell = np.floor(points / np.float32(_CUBE * distance)).astype(np.int32).view(np.uint32)
    x, y, z = (each * np.uint32(prime) for each, prime in zip(cell, _PRIMES, strict=True))
    return (x ^ y ^ z) % np.uint32(_TABLE_SIZE)
