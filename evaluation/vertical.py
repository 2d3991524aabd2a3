"""Heights over a mesh or a cloud, positive above it, and of a cloud at places; M3C2 (by py4dgeo, the extra ``m3c2``).

Where a surface is steep, the distance to its nearest point is shorter than the vertical difference. The distance to the
nearest point of a sparse reference measures its spacing, not the error of what is compared.
"""

import logging
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.spatial import cKDTree

# Barycentric weights down to this count as inside: points on an edge, to rounding.
_ON_EDGE = -1e-9
# Points at a time for each thread, and pairs of a point and a triangle: about 50 MB of intermediate values.
_POINTS, _PAIRS = 20_000, 500_000
_WORKERS = min(os.cpu_count() or 1, 4)
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
    corners = np.asarray(vertices, dtype=np.float64)[np.asarray(faces, dtype=np.int64)]
    a, b, c = (corners[:, k, :2] for k in range(3))
    corners = corners[_cross(b - a, c - a) != 0.0]
    difference = np.full(len(points), np.nan)
    if not len(corners):
        return difference
    boxes = shapely.STRtree(shapely.box(*corners[..., :2].min(axis=1).T, *corners[..., :2].max(axis=1).T))
    parts = [slice(start, start + _POINTS) for start in range(0, len(points), _POINTS)]
    with ThreadPoolExecutor(_WORKERS) as pool:
        found = pool.map(lambda part: _nearest_in_height(points[part], corners, boxes), parts)
        for part, values in zip(parts, found, strict=True):
            difference[part] = values
            if advance is not None:
                advance(len(values))
    return difference


def _nearest_in_height(points: np.ndarray, corners: np.ndarray, boxes: shapely.STRtree) -> np.ndarray:
    """Difference (N,) of points from triangles (F, 3, 3), the nearest in height; ``boxes`` are theirs in plan."""
    difference = np.full(len(points), np.nan)
    point, face = boxes.query(shapely.points(points[:, :2]))
    if len(point) > _PAIRS and len(points) > 1:
        halves = np.array_split(points, 2)
        return np.concatenate([_nearest_in_height(half, corners, boxes) for half in halves])
    rows, starts = np.unique(point, return_index=True)
    a, b, c = (corners[face, k, :2] for k in range(3))
    p = points[point, :2]
    twice_area = _cross(b - a, c - a)
    wb, wc = _cross(p - a, c - a) / twice_area, _cross(b - a, p - a) / twice_area
    wa = 1.0 - wb - wc
    height = wa * corners[face, 0, 2] + wb * corners[face, 1, 2] + wc * corners[face, 2, 2]
    above = points[point, 2] - height
    covers = (wa >= _ON_EDGE) & (wb >= _ON_EDGE) & (wc >= _ON_EDGE)
    size = np.where(covers, np.abs(above), np.inf)
    if len(rows):
        least = np.minimum.reduceat(size, starts)
        # Of two surfaces at equal distance above and below, the one below.
        above = np.where(size == np.repeat(least, np.diff(starts, append=len(size))), above, -np.inf)
        difference[rows] = np.where(np.isfinite(least), np.maximum.reduceat(above, starts), np.nan)
    return difference


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
            heights[i] = _plane_through(cloud[near] - [*places[i], 0.0])
    return heights


def _plane_through(points: np.ndarray) -> float:
    """Height at the origin of the plane that fits points (M, 3); NaN where they do not surround it."""
    centre = points[:, :2].mean(axis=0)
    farthest = float(np.linalg.norm(points[:, :2], axis=1).max())
    if np.linalg.norm(centre) > _MOST_OFF * farthest:
        return np.nan
    design = np.column_stack([np.ones(len(points)), points[:, :2]])
    solution, _, rank, _ = np.linalg.lstsq(design, points[:, 2], rcond=1e-6)
    return float(solution[0]) if rank == 3 else np.nan


_NEIGHBOURS = 12
# Fewer do not determine a plane against noise.
_FEWEST = 4
# Tricube weights fall to zero at this many distances of the farthest neighbour.
_REACH = 1.1
# Above this leverage a height is less certain than a single point of the reference: an extrapolation.
_MOST_LEVERAGE = 1.0
# A place is in a gap where its nearest point is farther away than this many times the distance from such points to
# their fourth neighbour: on a grid the ratio is at most 0.7; among random points 2 in 10,000 places exceed the limit.
_GAP = 1.5
# Neighbours whose spread across is less than this share of their spacing along lie on a line, as echo soundings do: the
# slope across is unknown, and heights are valid up to half a spacing to either side.
_ON_A_LINE, _BESIDE_A_LINE = 0.25, 0.5
# Places at a time: about 100 MB of intermediate values.
_CHUNK = 100_000


@dataclass(frozen=True)
class LocalSurface:
    """Heights of a cloud at places in plan; NaN where its points do not surround a place."""

    height: np.ndarray  # (N,) [m]
    # (N,) [m]: std of prediction, of the height that a new point of the cloud would have there: relief and noise
    std: np.ndarray
    spacing_m: float  # [m]: between neighbouring points, median over the places; NaN where none has a height


def local_surface(
    cloud: np.ndarray, places: np.ndarray, *, advance: Callable[[int], object] | None = None
) -> LocalSurface:
    """Heights of a cloud (M, 3) [m], z up, at places (N, 2) [m] in plan, by local regression.

    ``advance`` is called with the number of places that were finished since the last call.

    Notes
    -----
    A plane by least squares through the heights of the twelve nearest points in plan, with tricube weights (W. S.
    Cleveland, Robust locally weighted regression, 1979): exact on a plane of any slope, whatever the spacing. ``std``
    is that of prediction, s sqrt(1 + sum of squared weights of the heights), s from the residuals; at places farther
    from all points than these from four others (between lines) it grows with the square of that ratio.
    """
    places = np.asarray(places, dtype=np.float64)
    height, std, radius = (np.full(len(places), np.nan) for _ in range(3))
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    count = min(_NEIGHBOURS, len(cloud))
    rows = np.flatnonzero(np.isfinite(places).all(axis=1))
    if count >= _FEWEST:
        tree = cKDTree(cloud[:, :2], balanced_tree=False, compact_nodes=False)
        spacing = tree.query(cloud[:, :2], k=min(_FEWEST + 1, count), workers=-1)[0][:, -1]
        for start in range(0, len(rows), _CHUNK):
            part = rows[start : start + _CHUNK]
            distances, numbers = tree.query(places[part], k=count, workers=-1)
            offsets = cloud[numbers]
            offsets[..., :2] -= places[part, None]
            found, found_std = _plane_at(offsets, distances)
            # Residuals show relief between neighbours; where it is smooth, errors grow as the square of the distance.
            gap = distances[:, 0] / np.maximum(np.median(spacing[numbers], axis=1), np.finfo(np.float64).tiny)
            height[part] = np.where(gap <= _GAP, found, np.nan)
            std[part] = np.where(gap <= _GAP, found_std * np.square(np.maximum(gap, 1.0)), np.nan)
            radius[part] = distances[:, -1]
            if advance is not None:
                advance(len(part))
    known = np.isfinite(height)
    spacing_m = float(np.median(radius[known])) * np.sqrt(np.pi / count) if known.any() else np.nan
    return LocalSurface(height, std, float(spacing_m))


def _plane_at(points: np.ndarray, distances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heights (N,) at the origin of planes through points (N, k, 3) at distances (N, k), and their std (N,)."""
    farthest = distances[:, -1]
    weights = (1.0 - (distances / np.where(farthest > 0.0, _REACH * farthest, 1.0)[:, None]) ** 3) ** 3
    weights /= weights.sum(axis=1, keepdims=True)
    x, y, z = (points[..., i] for i in range(3))
    mean_x, mean_y, mean_z = (_mean(weights, values) for values in (x, y, z))
    x, y, z = x - mean_x[:, None], y - mean_y[:, None], z - mean_z[:, None]
    # The axes along which the points spread most and least: u along, v across.
    angle = 0.5 * np.arctan2(2.0 * _mean(weights, x * y), _mean(weights, x * x) - _mean(weights, y * y))
    cos, sin = np.cos(angle), np.sin(angle)
    u, v = cos[:, None] * x + sin[:, None] * y, cos[:, None] * y - sin[:, None] * x
    along, across = _mean(weights, u * u), _mean(weights, v * v)
    num = 1.0 / np.square(weights).sum(axis=1)
    # The variance of n equal steps is (n^2 - 1) / 12 of their squares.
    step = np.sqrt(12.0 * along / np.maximum(num**2 - 1.0, 1.0))
    is_line = across <= np.square(_ON_A_LINE * step)
    per_along = 1.0 / np.where(along > 0.0, along, np.inf)
    per_across = np.where(is_line, 0.0, 1.0 / np.where(across > 0.0, across, np.inf))
    slope_u, slope_v = per_along * _mean(weights, u * z), per_across * _mean(weights, v * z)
    here_u, here_v = -cos * mean_x - sin * mean_y, sin * mean_x - cos * mean_y
    height = mean_z + here_u * slope_u + here_v * slope_v
    residuals = z - slope_u[:, None] * u - slope_v[:, None] * v
    freedom = np.maximum(num - np.where(is_line, 2.0, 3.0), 1.0)
    variance = _mean(weights, np.square(residuals)) * num / freedom
    shares = weights * (1.0 + (per_along * here_u)[:, None] * u + (per_across * here_v)[:, None] * v)
    leverage = np.square(shares).sum(axis=1)
    known = (leverage <= _MOST_LEVERAGE) & ~(is_line & (np.abs(here_v) > _BESIDE_A_LINE * step))
    std = np.sqrt(variance * (1.0 + leverage))
    return np.where(known, height, np.nan), np.where(known, std, np.nan)


def _mean(weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.einsum("nk,nk->n", weights, values)


@dataclass(frozen=True)
class M3C2Distances:
    """M3C2 distances along the normals of the reference, positive where the cloud lies above it."""

    signed: np.ndarray  # (K,) [m]: at the core points; NaN where a cylinder holds no points of either cloud
    # (K,) [m]: level of detection at 95 %: smaller distances are not significant. NaN where there are too few points.
    detection_m: np.ndarray


def m3c2_distances(
    reference: np.ndarray, cloud: np.ndarray, core_points: np.ndarray, *, radius_m: float, reach_m: float
) -> M3C2Distances:
    """Multiscale model to model cloud comparison, at core points (K, 3) [m], usually some of the reference.

    Both clouds are in one Cartesian frame near its origin, z up. ``radius_m`` is that of the cylinders along the
    normals, and of the spheres in which normals are found, ``reach_m`` half the length of the cylinders. D. Lague, N.
    Brodu, J. Leroux, Accurate 3D comparison of complex topography with terrestrial laser scanner, ISPRS Journal 82
    (2013); normals point up.
    """
    import py4dgeo

    # py4dgeo logs to standard output, which belongs to the command line, and to a file in the working folder.
    logging.getLogger("py4dgeo").handlers = [logging.NullHandler()]
    epochs = tuple(py4dgeo.Epoch(np.ascontiguousarray(points, dtype=np.float64)) for points in (reference, cloud))
    algorithm = py4dgeo.M3C2(
        epochs=epochs,
        corepoints=np.ascontiguousarray(core_points, dtype=np.float64),
        cyl_radius=radius_m,
        normal_radii=[radius_m],
        max_distance=reach_m,
    )
    signed, uncertainty = algorithm.run()
    return M3C2Distances(np.asarray(signed), np.asarray(uncertainty["lodetection"]))
