"""Points of pixels of height maps in space: what other maps say of them, and which become points or cease to be some.

Steep pixels are tested once more: on walls, where neighbouring pixels lie far apart, gaps are filled.

Beneath overhangs there is bed that agreement of heights alone takes for duplicates: beside a depth step a ray may pass
near two surfaces of one height, of which only one becomes points; there the points that are kept are told apart in
space. And there are ghosts over a flat surface: few maps match them, and they stand off a surface that many maps match.
Windows of the sweep that cover an edge and what lies behind it leave heights between both.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from fields.image_store import Masks
from fields.sweep.block import Block
from fields.sweep.kernels.arrays import floats, host
from fields.sweep.kernels.rays import point_at, rays_and_heights, rays_of_rows, vote_on_points
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.maps import HeightMap, trusted, views_of

# Spatial hash: side of a cell in distances, size of the table, primes of the hash.
_CUBE, _TABLE_SIZE, _PRIMES = 4.0, 2**22, (73_856_093, 19_349_663, 83_492_791)
# A steep pixel is dropped if more maps see through its point than span it. One is added if so many maps span it
# and at most this share of them see through it.
_LEAST_FOR, _MOST_AGAINST = 4, 0.25
_GAP_GSD = 1.25  # Gaps that are filled have this radius, in ground sampling distances


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


@dataclass(frozen=True)
class SteepPixels:
    steep: Masks
    addable: Masks  # Those of them that may be added
    trusted: Masks  # All pixels, steep or not, whose heights count against a point


def filter_steep_pixels(stack: ViewStack, found: SteepPixels, kept: Masks, gsd: float) -> None:
    """Update the ``kept`` pixels: drop steep ones that other maps see through, add others that fill gaps on walls.

    ``stack`` has the height maps. A map spans a point within ``gsd`` [m] of its heights there, and sees through one
    farther above them.
    """
    if not len(kept):
        return
    old = MapPoints.of(stack, (keep & steep for keep, steep in zip(kept, found.steep, strict=True)))
    spanning, through, _ = old.votes(stack, found.trusted, gsd)
    old[through > spanning].mark(kept, False)
    new = MapPoints.of(stack, (each & ~keep for each, keep in zip(found.addable, kept, strict=True)))
    new = new[far_from(stack, kept, new.xyz, _GAP_GSD * gsd)]
    spanning, through, _ = new.votes(stack, found.trusted, gsd)
    new = new[(spanning >= _LEAST_FOR) & (through <= _MOST_AGAINST * spanning)]
    new[thin_out(new.xyz.T, _GAP_GSD * gsd)].mark(kept, True)


# A pixel is beside a step where its map rises by more than this, in ground sampling distances, within so many pixels.
_STEP_GSD, _REACH_PX = 12.0, 6
# Side of the cells of the ground, and how much higher a kept point of the same cell is: in ground sampling distances.
_CELL_GSD, _OVER_GSD = 3.0, 8.0
# Least distance of points from each other, in ground sampling distances: those of neighbouring pixels of two maps of
# the same surface lie 0.7 from each other at most.
_APART_GSD = 0.75
# Of the maps that span a point so many, and this share, match it in a pixel: windows over an edge leave heights between
# both surfaces, which maps span where they jump.
_LEAST_MATCHING, _SHARE_MATCHING = 2, 0.7
# Farther than this from all points, in ground sampling distances, one map that matches a point is enough, if at most as
# many see through it as match it.
_ALONE_GSD = 1.5
# How much higher a kept point of the same cell of the ground, or of one beside it, is: in ground sampling distances.
_GHOST_OVER_GSD = 6.0
# A point of a surface is matched by so many other maps. A piece of the surface has so many of them at least, and at
# most, within so many ground sampling distances.
_WELL_MATCHED, _LEAST_POINTS, _MOST_POINTS, _REACH_GSD = 4, 8, 30, 6.0
_AT_ONCE = 50_000  # Points that are compared with it at a time, of 3 kB each
# The piece is flat where its standard deviation from its plane is less than this, and a surface, not a line, where that
# along its shorter side is more: in ground sampling distances.
_FLAT_GSD, _WIDE_GSD = 0.8, 0.8
# Distances of a ghost: from the plane at least, from the middle of the piece in plan at most.
_OFF_GSD, _BESIDE_GSD = 1.5, 2.5
# It is matched by less than this share of the maps that match the points of the piece, in the mean.
_SHARE_OF_PIECE = 0.25


def pixels_beside_steps(height: np.ndarray, gsd: float) -> np.ndarray:
    """Pixels (height, width) bool of a map [m] beside which it rises steeply."""
    side = 2 * _REACH_PX + 1
    return cv2.dilate(height, np.ones((side, side), np.uint8)) - height > _STEP_GSD * gsd


def add_points_beneath(stack: ViewStack, addable: Masks, trusted: Masks, kept: Masks, gsd: float) -> None:
    """Update the ``kept`` pixels: add those of ``addable`` that lie beneath kept points and apart from all of them.

    ``stack`` has the height maps, ``trusted`` are all pixels whose heights count against a point.
    """
    new = MapPoints.of(stack, (each & ~old for each, old in zip(addable, kept, strict=True)))
    new = new[far_from(stack, kept, new.xyz, _APART_GSD * gsd)]
    new = new[lie_beneath(stack, kept, new.xyz, gsd, _OVER_GSD)]
    spanning, through, matching = new.votes(stack, trusted, gsd)
    is_matched = (matching >= _LEAST_MATCHING) & (matching >= _SHARE_MATCHING * spanning)
    _mark_thinned(new[is_matched & (through <= _MOST_AGAINST * spanning)], kept, _APART_GSD * gsd)
    alone = new[(matching >= 1) & (matching >= through)]
    alone = alone[far_from(stack, kept, alone.xyz, _ALONE_GSD * gsd)]
    _mark_thinned(alone, kept, _ALONE_GSD * gsd)


def _mark_thinned(points: MapPoints, kept: Masks, distance: float) -> None:
    points[thin_out(points.xyz.T, distance)].mark(kept, True)


def lie_beneath(
    stack: ViewStack, kept: Masks, xyz: np.ndarray, gsd: float, over_gsd: float, around: int = 0
) -> np.ndarray:
    """Points (3, N) with a kept point more than ``over_gsd`` over them: (N,) bool.

    It is in the same cell of the ground, or in one of those ``around`` it.
    """
    if not xyz.size:
        return np.zeros(0, dtype=bool)
    steps = range(-around, around + 1)
    column, row = _columns_and_rows(xyz, gsd)
    cells_around = np.stack([_number(column + x, row + y) for x in steps for y in steps])
    cells, cell_of = np.unique(cells_around, return_inverse=True)
    top = np.full(len(cells), -np.inf, dtype=np.float32)
    for number, mask in enumerate(kept):
        points = points_of_pixels(stack, number, np.flatnonzero(mask))
        key = _number(*_columns_and_rows(points, gsd))
        place = np.minimum(np.searchsorted(cells, key), len(cells) - 1)
        same = cells[place] == key
        np.maximum.at(top, place[same], points[2][same])
    return top[cell_of.reshape(cells_around.shape)].max(axis=0) > xyz[2] + over_gsd * gsd


def _columns_and_rows(xyz: np.ndarray, gsd: float) -> np.ndarray:
    """Cells (2, N) of the ground of points (3, N)."""
    return np.floor(xyz[:2] / np.float32(_CELL_GSD * gsd)).astype(np.int64)


def _number(column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Number of cells of the ground."""
    return (row << 32) + column


def without_ghosts(block: Block, maps: Sequence[HeightMap], kept: Masks, gsd: float) -> Masks:
    """Pixels ``kept`` of each map less those beneath others that are ghosts.

    ``maps``: with the heights of the solver: they tell ghosts apart better than those of the sweep. ``kept``: masks
    (height, width), in the order of `maps`. ``gsd`` [m]: ground sampling distance.
    """
    cameras = [block.cameras[view] for view in views_of(maps)]
    shapes = [(camera.height, camera.width) for camera in cameras]
    all_trusted, near_steps, left = (Masks(list(shapes)) for _ in range(3))
    for index, m in enumerate(maps):
        all_trusted[index], left[index] = trusted(m), kept[index]
        near_steps[index] = left[index] & pixels_beside_steps(m.height, gsd)
    stack = ViewStack.lazy(block.device, cameras, lambda index: maps[index].height, block.water)
    points = MapPoints.of(stack, near_steps)
    points = points[lie_beneath(stack, kept, points.xyz, gsd, _GHOST_OVER_GSD, around=1)]
    matching = points.votes(stack, all_trusted, gsd)[2]
    points, matching = points[matching < _WELL_MATCHED], matching[matching < _WELL_MATCHED]
    if len(matching):
        about = MapPoints.about(stack, kept, points.xyz, _REACH_GSD * gsd)
        matching_about = about.votes(stack, all_trusted, gsd)[2]
        points[are_off_surface(points.xyz.T / gsd, matching, about.xyz.T / gsd, matching_about)].mark(left, False)
    return left


def are_off_surface(
    points: np.ndarray, matching: np.ndarray, about: np.ndarray, matching_about: np.ndarray
) -> np.ndarray:
    """Points (N, 3) that stand off a flat piece of those about them, which far more maps match: (N,) bool.

    ``points``, ``about`` (N, 3), (M, 3): in ground sampling distances. ``matching``, ``matching_about`` (N,), (M,):
    number of other maps that match them.
    """
    is_surface = matching_about >= _WELL_MATCHED
    surface, of_surface = about[is_surface].astype(np.float64), matching_about[is_surface]
    if len(surface) < _LEAST_POINTS:
        return np.zeros(len(points), dtype=bool)
    tree, off_surface = cKDTree(surface), np.zeros(len(points), dtype=bool)
    for first in range(0, len(points), _AT_ONCE):
        part = np.s_[first : first + _AT_ONCE]
        off_surface[part] = _are_off(points[part], matching[part], surface, of_surface, tree)
    return off_surface


def _are_off(
    points: np.ndarray, matching: np.ndarray, surface: np.ndarray, of_surface: np.ndarray, tree: cKDTree
) -> np.ndarray:
    """`are_off_surface` of well matched points (M, 3)."""
    most = min(_MOST_POINTS, len(surface))
    distance, near = tree.query(points, k=most, distance_upper_bound=_REACH_GSD)
    known = np.isfinite(distance)
    near[~known] = 0
    weight = known * np.exp(-((np.where(known, distance, 0.0) / (0.5 * _REACH_GSD)) ** 2))
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    middle = np.einsum("nk,nka->na", weight, surface[near])
    spread = surface[near] - middle[:, None]
    variances, axes = np.linalg.eigh(np.einsum("nk,nka,nkb->nab", weight, spread, spread))
    thick, wide = np.sqrt(np.maximum(variances[:, :2], 0.0)).T
    offset, normal = points - middle, axes[:, :, 0]
    off = np.einsum("na,na->n", offset, normal)
    lateral = np.linalg.norm(offset - off[:, None] * normal, axis=1)
    is_piece = (known.sum(axis=1) >= _LEAST_POINTS) & (thick < _FLAT_GSD) & (wide > _WIDE_GSD)
    few = matching < _SHARE_OF_PIECE * np.einsum("nk,nk->n", weight, of_surface[near])
    return is_piece & few & (np.abs(off) > _OFF_GSD) & (lateral < _BESIDE_GSD)
