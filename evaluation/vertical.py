"""Vertical errors: differences between a cloud and a mesh, positive above it, and heights of a cloud at places.

Where the surface is steep, the distance to its nearest point is shorter than the vertical difference.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from evaluation.bootstrap import cell_numbers

# Barycentric weights down to this count as inside: points on an edge, to rounding.
_ON_EDGE = -1e-9
# Pairs of point and triangle at a time for each thread: about 50 MB of intermediate values.
_PAIRS = 500_000
_WORKERS = min(os.cpu_count() or 1, 4)
# Limits of the entries of triangles in cells; a few large triangles among many small ones would fill the memory.
_ENTRIES_PER_FACE, _ENTRIES = 16, 1_000_000
_NEIGHBOURS = 12
# Fewer do not determine a plane against noise.
_FEWEST = 4
# A place whose neighbours all lie to one side is beyond the rim. Their centroid may be off by this share of the
# distance to the farthest: on a straight rim of an even cloud the share is 0.42, in a corner 0.6.
_MOST_OFF = 0.5


def vertical_difference(
    points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, *, advance: Callable[[int], object] | None = None
) -> np.ndarray:
    """Height (N,) [m] of points over the surface of a mesh straight above or below them, positive above.

    NaN where no triangle lies above or below the point (beyond the rim, in a hole) and for points that are not finite.
    Where several do (an overhang, a hull), the one nearest in height counts. Points (N, 3) [m] and vertices (V, 3) [m]
    are in one Cartesian frame, z up; ``advance`` is called with the number of points finished since the last call.
    """
    points = np.asarray(points, dtype=np.float64)
    vertices = np.asarray(vertices, dtype=np.float64)
    difference = np.full(len(points), np.nan)
    grid = _Grid.of(vertices, np.asarray(faces, dtype=np.int64))
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    if grid is None:
        return difference
    cell = grid.cell_of(points[finite, :2])
    inside = (cell >= 0) & (grid.start[cell + 1] > grid.start[cell])
    order = np.argsort(cell[inside], kind="stable")
    rows, cell = finite[inside][order], cell[inside][order]
    counts = grid.start[cell + 1] - grid.start[cell]
    block = np.cumsum(counts) // _PAIRS
    cuts = np.flatnonzero(np.diff(block)) + 1
    parts = [np.split(values, cuts) for values in (rows, cell, counts)]
    with ThreadPoolExecutor(_WORKERS) as pool:
        found = pool.map(lambda part, *held: grid.nearest_in_height(points[part], *held), *parts)
        for part, values in zip(parts[0], found, strict=True):
            difference[part] = values
            if advance is not None:
                advance(len(part))
    if advance is not None:
        advance(len(points) - len(rows))
    return difference


@dataclass(frozen=True)
class _Grid:
    """Triangles by the square cells of the plan that their boxes touch.

    ``faces[start[i] : start[i + 1]]`` are those of cell i, row by row, of ``shape`` (rows, columns);
    ``corner`` (3, F, 2) and ``height`` (3, F) hold the corners a, b, c.
    """

    low: np.ndarray
    cell: float
    shape: tuple[int, int]
    start: np.ndarray
    faces: np.ndarray
    corner: np.ndarray
    height: np.ndarray

    @staticmethod
    def of(vertices: np.ndarray, faces: np.ndarray) -> _Grid | None:
        """The grid of all triangles that have an area in plan; None if none has."""
        corner = vertices[faces.T]
        a, b, c = corner[..., :2]
        flat = _cross(b - a, c - a) == 0.0
        corner = corner[:, ~flat]
        if not corner.shape[1]:
            return None
        low, high = corner[..., :2].min(axis=0), corner[..., :2].max(axis=0)
        origin, end = low.min(axis=0), high.max(axis=0)
        cell = 0.5 * math.sqrt(float((end - origin).prod()) / len(low))
        most = _ENTRIES_PER_FACE * len(low) + _ENTRIES
        while _spans(low, high, origin, cell)[1].prod(axis=1).sum() > most:
            cell *= 1.5
        shape = np.floor((end - origin) / cell).astype(np.int64) + 1
        first, span = _spans(low, high, origin, cell)
        entries = span.prod(axis=1)
        face = np.repeat(np.arange(len(low)), entries)
        within = np.arange(entries.sum()) - np.repeat(np.cumsum(entries) - entries, entries)
        column, row = first[face, 0] + within % span[face, 0], first[face, 1] + within // span[face, 0]
        number = row * shape[0] + column
        start = np.concatenate([[0], np.cumsum(np.bincount(number, minlength=shape.prod()))])
        by_cell = face[np.argsort(number, kind="stable")]
        return _Grid(origin, cell, (int(shape[1]), int(shape[0])), start, by_cell, corner[..., :2], corner[..., 2])

    def cell_of(self, plan: np.ndarray) -> np.ndarray:
        """Cell of each point (N, 2), -1 beyond all."""
        return cell_numbers((plan - self.low) / self.cell, self.shape)

    def nearest_in_height(self, points: np.ndarray, cell: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """Difference (N,) of points in cells of ``counts`` triangles each, one at least."""
        starts = np.cumsum(counts) - counts
        point = np.repeat(np.arange(len(points)), counts)
        face = self.faces[self.start[cell][point] + np.arange(counts.sum()) - starts[point]]
        a, b, c = self.corner[0, face], self.corner[1, face], self.corner[2, face]
        p = points[point, :2]
        twice_area = _cross(b - a, c - a)
        wb, wc = _cross(p - a, c - a) / twice_area, _cross(b - a, p - a) / twice_area
        wa = 1.0 - wb - wc
        height = wa * self.height[0, face] + wb * self.height[1, face] + wc * self.height[2, face]
        above = points[point, 2] - height
        covers = (wa >= _ON_EDGE) & (wb >= _ON_EDGE) & (wc >= _ON_EDGE)
        size = np.where(covers, np.abs(above), np.inf)
        least = np.minimum.reduceat(size, starts)
        # Of two surfaces at equal distance above and below, the one below.
        above = np.where(size == least[point], above, -np.inf)
        return np.where(np.isfinite(least), np.maximum.reduceat(above, starts), np.nan)


def _spans(low: np.ndarray, high: np.ndarray, origin: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """First cell and number of cells (F, 2) along each axis that boxes touch."""
    first = np.floor((low - origin) / cell).astype(np.int64)
    return first, np.floor((high - origin) / cell).astype(np.int64) - first + 1


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def height_at(cloud: np.ndarray, places: np.ndarray, *, within_m: float = 1.0) -> np.ndarray:
    """Height (K,) [m] of a cloud (N, 3) [m], z up, at places (K, 2) [m] in plan.

    That of the least-squares plane through its twelve nearest points in plan, at most ``within_m`` off; NaN where there
    are fewer than four, they lie on a line, or all to one side.
    """
    heights = np.full(len(places), np.nan)
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    if not len(cloud):
        return heights
    tree = cKDTree(cloud[:, :2])
    distances, numbers = tree.query(places, k=min(_NEIGHBOURS, len(cloud)), distance_upper_bound=within_m)
    for i, (distance, number) in enumerate(zip(np.atleast_2d(distances.T).T, np.atleast_2d(numbers.T).T, strict=True)):
        near = number[np.isfinite(distance)]
        if len(near) >= _FEWEST:
            heights[i] = _plane_at(cloud[near] - [*places[i], 0.0])
    return heights


def _plane_at(points: np.ndarray) -> float:
    """Height at the origin of the plane that fits points (M, 3); NaN where they do not surround it."""
    centre = points[:, :2].mean(axis=0)
    farthest = float(np.linalg.norm(points[:, :2], axis=1).max())
    if np.linalg.norm(centre) > _MOST_OFF * farthest:
        return np.nan
    design = np.column_stack([np.ones(len(points)), points[:, :2]])
    solution, _, rank, _ = np.linalg.lstsq(design, points[:, 2], rcond=1e-6)
    return float(solution[0]) if rank == 3 else np.nan
