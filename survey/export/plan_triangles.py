"""Delaunay triangles in plan between the most certain points of cells, in bands of rows to limit memory.

A triangle is Delaunay where its circumcircle holds no other point. So every triangle of the whole whose vertices lie in
a band with its rim is one of the band too; those of the band whose circle holds a point elsewhere are dropped.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from geo.shapes import portions

# Points that are read at a time, and those of a band of rows: 60 bytes each while they are sorted.
_PORTION, _POINTS_OF_BAND = 200_000, 2_000_000
# Vertices of a band, of which Qhull takes 0.4 kB each.
_VERTICES_OF_BAND = 300_000
# Rim of a band in longest sides: few circles reach further. A band is no narrower than so many rims.
_RIM, _LEAST_RIMS = 2.0, 3.0
# Points nearest to the centre of a circle that are tested: its three corners are among them.
_NEAREST = 4


def most_certain(points: np.ndarray, std: np.ndarray, cell_m: float, of_band: int = _POINTS_OF_BAND) -> np.ndarray:
    """Numbers (V,) of the points with the smallest std of their square cells, from the south, row by row.

    Points (N, 3) [m] may lie in a file. Of equal std (N,) [m] the first stays; NaN counts as infinite. Some
    ``of_band`` points are sorted at a time; a row is not divided.
    """
    low = points[:, :2].min(axis=0)
    rows, columns = (int(np.floor((points[:, axis].max() - low[axis]) / cell_m)) + 1 for axis in (1, 0))
    count, ends = np.zeros(rows, dtype=np.int64), []
    for part in portions(len(points), _PORTION):
        row = _cell(points[part, 1], low[1], cell_m)
        count += np.bincount(row, minlength=rows)
        ends.append((part, row.min(), row.max()))
    found = []
    for first, last in _bands(count, of_band):
        numbers = []
        for part, lowest, highest in ends:
            if lowest < last and highest >= first:
                row = _cell(points[part, 1], low[1], cell_m)
                numbers.append(part.start + np.flatnonzero((row >= first) & (row < last)))
        number = np.concatenate([np.empty(0, dtype=np.int64), *numbers])
        if not len(number):
            continue
        x, y = points[number, :2].T
        cell = _cell(y, low[1], cell_m) * columns + _cell(x, low[0], cell_m)
        value = np.asarray(std[number])
        order = np.lexsort((np.where(np.isfinite(value), value, np.inf), cell))
        ordered = cell[order]
        found.append(number[order[np.append(True, ordered[1:] != ordered[:-1])]])
    return np.concatenate(found)


def triangles(
    xy: np.ndarray, south_m: float, longest_m: float, cell_m: float, of_band: int = _VERTICES_OF_BAND
) -> np.ndarray:
    """Delaunay triangles (F, 3) int32 of places in plan, counter-clockwise, without those with a longer side.

    Places (V, 2) [m] are in the order of `most_certain`: by rows of cells from the south, the first of which begins at
    the lowest of the points that it chose from. Some ``of_band`` are triangulated at a time, with a rim.
    """
    if len(xy) < 3:
        return np.zeros((0, 3), dtype=np.int32)
    row = _cell(xy[:, 1], south_m, cell_m)
    rim = int(np.ceil(_RIM * longest_m / cell_m)) + 1
    bands = list(_bands(np.bincount(row), of_band, int(_LEAST_RIMS * rim)))
    tree, found = None, []
    for first, last in bands:
        begin, end = np.searchsorted(row, (first - rim, last + rim))
        places = xy[begin:end]
        faces = _whole(places, longest_m)
        if len(bands) > 1 and len(faces):
            middle = _cell(places[faces, 1].mean(axis=1), south_m, cell_m)
            # A middle beyond the outermost places by rounding belongs to the band there.
            faces = faces[(middle.clip(0, bands[-1][1] - 1) >= first) & (middle < last)]
            edges = south_m + cell_m * np.array([first - rim, last + rim])
            centre, radius = _circles(places, faces)
            doubtful = ~((centre[:, 1] - radius > edges[0]) & (centre[:, 1] + radius < edges[1]))
            if doubtful.any():
                tree = cKDTree(xy, balanced_tree=False, compact_nodes=False) if tree is None else tree
                doubtful[doubtful] = _contains_a_point(xy, tree, faces[doubtful] + begin)
            faces = faces[~doubtful]
        found.append((faces + begin).astype(np.int32))
    return np.concatenate(found)


def _cell(values: np.ndarray, low: float, cell_m: float) -> np.ndarray:
    return np.floor((values - low) / cell_m).astype(np.int64)


def _bands(count: np.ndarray, most: int, least_rows: int = 1) -> Iterator[tuple[int, int]]:
    """Rows from and to of bands of at most so many points, if they have the least rows; count (R,) of each row."""
    total = np.cumsum(count)
    first = 0
    while first < len(count):
        before = total[first - 1] if first else 0
        last = max(int(np.searchsorted(total, before + most, side="right")), first + least_rows)
        last = len(count) if len(count) - last < least_rows else last
        yield first, last
        first = last


def _whole(xy: np.ndarray, longest_m: float) -> np.ndarray:
    """Triangles (F, 3) of some places, without those with a side of that length."""
    try:
        # Qhull loses digits where coordinates are large.
        faces = Delaunay(xy - xy.mean(axis=0)).simplices
    except (QhullError, ValueError):  # fewer than three points, or all on one line
        return np.zeros((0, 3), dtype=np.int64)
    sides = np.linalg.norm(xy[faces] - xy[np.roll(faces, 1, axis=1)], axis=2)
    return faces[sides.max(axis=1) < longest_m]


def _circles(xy: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (F, 2) and radii (F,) of circumcircles; not finite for corners on a line."""
    corner = xy[faces[:, 0]]
    (bx, by), (cx, cy) = (xy[faces[:, 1]] - corner).T, (xy[faces[:, 2]] - corner).T
    with np.errstate(divide="ignore", invalid="ignore"):
        twice = 2.0 * (bx * cy - by * cx)
        b, c = bx * bx + by * by, cx * cx + cy * cy
        centre = np.column_stack([(cy * b - by * c) / twice, (bx * c - cx * b) / twice])
    return corner + centre, np.linalg.norm(centre, axis=1)


def _contains_a_point(xy: np.ndarray, tree: cKDTree, faces: np.ndarray) -> np.ndarray:
    """Whether each circumcircle (F,) contains another place; True for triangles without one."""
    centre, _ = _circles(xy, faces)
    known = np.isfinite(centre).all(axis=1)
    holds = ~known
    _, near = tree.query(centre[known], k=_NEAREST, workers=-1)
    corners = faces[known]
    for other in near.T:
        # With four places in all the last may be missing.
        is_there = other < len(xy)
        is_other = is_there & (other[:, None] != corners).all(axis=1)
        at = xy[np.where(is_there, other, 0)]
        # Over the paraboloid of squared distances the place lies under the plane of the corners (counter-clockwise).
        rows = xy[corners] - at[:, None]
        lifted = np.concatenate([rows, (rows**2).sum(axis=2, keepdims=True)], axis=2)
        holds[known] |= is_other & (np.linalg.det(lifted) > 0.0)
    return holds
