"""Points of pixels of height maps in space: what other maps say of them, and which lie near them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fields.image_store import Masks
from fields.sweep.block import Block
from fields.sweep.kernels.arrays import floats, host
from fields.sweep.kernels.lookups import rays_and_heights, rays_of_rows, vote_on_points
from fields.sweep.kernels.rays import point_at
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.maps import HeightMap

# Spatial hash: side of a cell in distances, size of the table, primes of the hash.
_CUBE, _TABLE_SIZE, _PRIMES = 4.0, 2**22, (73_856_093, 19_349_663, 83_492_791)


@dataclass(frozen=True)
class MapPoints:
    """N pixels of height maps: number of the map, flat index in it, and points (3, N) in the frame of the water."""

    number: np.ndarray
    pixel: np.ndarray
    xyz: np.ndarray

    @staticmethod
    def of(stack: ViewStack, masks: Iterable[np.ndarray]) -> MapPoints:
        """Points of the True pixels of masks (height, width) bool, one for each map."""
        pixels = [np.flatnonzero(mask) for mask in masks]
        number = np.repeat(np.arange(len(pixels)), [len(each) for each in pixels])
        parts = [points_of_pixels(stack, number, each) for number, each in enumerate(pixels)]
        return MapPoints(number, np.concatenate(pixels), np.concatenate(parts, axis=1))

    @staticmethod
    def about(stack: ViewStack, masks: Iterable[np.ndarray], xyz: np.ndarray, distance: float) -> MapPoints:
        """True pixels within a distance of points (3, N), N at least 1, and some beyond it."""
        # Few of all points are near any.
        corners = np.stack(np.meshgrid(*[(-distance, distance)] * 3)).reshape(3, 8, 1).astype(np.float32)
        reached = np.zeros(_TABLE_SIZE, dtype=bool)
        for corner in corners.transpose(1, 0, 2):
            reached[_hash_cells(xyz + corner, distance)] = True
        parts = []
        for number, mask in enumerate(masks):
            pixel = np.flatnonzero(mask)
            points = points_of_pixels(stack, number, pixel)
            near = reached[_hash_cells(points, distance)]
            parts.append(MapPoints(np.full(near.sum(), number), pixel[near], points[:, near]))
        return MapPoints.joined(parts)

    @staticmethod
    def joined(parts: Sequence[MapPoints]) -> MapPoints:
        """Points of several, in this order."""
        number, pixel = (np.concatenate([getattr(each, name) for each in parts]) for name in ("number", "pixel"))
        return MapPoints(number, pixel, np.concatenate([each.xyz for each in parts], axis=1))

    def __getitem__(self, which: np.ndarray) -> MapPoints:
        return MapPoints(self.number[which], self.pixel[which], self.xyz[:, which])

    def votes(self, stack: ViewStack, trusted: Masks, tolerance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Number of other maps (N,) that span the point, that see through it, and that match it in a pixel."""
        spanning, through, matching = (np.zeros(len(self.number), dtype=np.int32) for _ in range(3))
        if not len(self.number):
            return spanning, through, matching
        points = tuple(floats(stack.device, each) for each in self.xyz)
        for number, mask in enumerate(trusted):
            other = self.number != number
            spans, sees_through, matches = vote_on_points(stack, points, number, tolerance, mask)
            spanning += spans & other
            through += sees_through & other
            matching += matches & other
        return spanning, through, matching

    def mark(self, masks: Masks, to: bool) -> None:
        """Set these pixels of masks."""
        for number in np.unique(self.number):
            mask = np.array(masks[number])
            mask.flat[self.pixel[self.number == number]] = to
            masks[number] = mask


def places_in_plan(block: Block, m: HeightMap) -> np.ndarray:
    """Places (height, width, 2) float32 [m], local, of the points that a height map shows."""
    stack = ViewStack.build(block.device, [block.cameras[m.view]], [m.height], block.water)
    rays = rays_of_rows(stack, 0, 0, stack.height)
    points = point_at(rays, floats(block.device, m.height))
    over_water = np.stack([host(block.device, each) for each in points])
    water = stack.kernel_water
    xy = (water.from_local.T[:2] @ over_water).T + water.origin[:2]
    return xy.astype(np.float32).reshape(*m.height.shape, 2)


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


def far_from(stack: ViewStack, kept: Iterable[np.ndarray], xyz: np.ndarray, distance: float) -> np.ndarray:
    """Points (3, N) farther than a distance from those of all ``kept`` pixels: (N,) bool."""
    if not xyz.size:
        return np.ones(xyz.shape[1], dtype=bool)
    tree = cKDTree(MapPoints.about(stack, kept, xyz, distance).xyz.T, balanced_tree=False, compact_nodes=False)
    return np.isinf(tree.query(xyz.T, distance_upper_bound=distance)[0])


def points_of_pixels(stack: ViewStack, number: int, pixels: np.ndarray) -> np.ndarray:
    """Points (3, N) float32 of pixels of a map."""
    if not len(pixels):
        return np.zeros((3, 0), dtype=np.float32)
    point = point_at(*rays_and_heights(stack, number, pixels))
    return np.stack([host(stack.device, each) for each in point])


def _hash_cells(points: np.ndarray, distance: float) -> np.ndarray:
    """Spatial hash (N,) of the grid cell of each of the points (3, N); distant cells may collide."""
    cell = np.floor(points / np.float32(_CUBE * distance)).astype(np.int32).view(np.uint32)
    x, y, z = (each * np.uint32(prime) for each, prime in zip(cell, _PRIMES, strict=True))
    return (x ^ y ^ z) % np.uint32(_TABLE_SIZE)
