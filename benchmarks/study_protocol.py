"""How the BathyNeRF simulation study measured its clouds, step by step, so that its Table 4 can be set beside ours.

Heights and distances in metres, local frame. The study moved its dry field by 18.9 cm by hand; here nothing is moved.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, median_filter
from scipy.spatial import cKDTree

CROP_M = 75.0
OBJECT_M = (25.0, 30.0)
THIN_M = {"dry": 0.05, "wet": 0.065}
OUTLIER_SIGMAS, PLANE_SIGMAS = 2.0, 2.0
# Of the statistical outlier filter, as CloudCompare and Open3D have it in their examples.
OUTLIER_NEIGHBOURS = 6
# What rises this far over the median of this many metres about it is an object.
OBJECT_RISE_M, OBJECT_WINDOW_M, RASTER_M = 0.3, 8.0, 0.25
CLEAR_M = 1.0


def thinned(points: np.ndarray, cell: float) -> np.ndarray:
    """One point, the first, of each cube of that edge [m], in their order."""
    _, first = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]


def tops(points: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Greatest heights (rows, columns) of points (N, 3) in square cells [m], and row and column (N,) of each point.

    Cells without points are -inf.
    """
    column, row = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / cell).astype(np.int64).T
    top = np.full((row.max() + 1, column.max() + 1), -np.inf)
    np.maximum.at(top, (row, column), points[:, 2])
    return top, row, column


def cropped(points: np.ndarray, middle: np.ndarray, width: float, height: float) -> np.ndarray:
    """Points (N, 3) over a rectangle about a middle (2,)."""
    away = np.abs(points[:, :2] - middle)
    return points[(away[:, 0] <= width / 2) & (away[:, 1] <= height / 2)]


def without_outliers(points: np.ndarray) -> np.ndarray:
    """Without points whose mean distance to their neighbours exceeds the mean of all by two standard deviations."""
    mean = cKDTree(points).query(points, k=OUTLIER_NEIGHBOURS + 1, workers=-1)[0][:, 1:].mean(axis=1)
    return points[mean <= mean.mean() + OUTLIER_SIGMAS * mean.std()]


def near_their_plane(points: np.ndarray) -> np.ndarray:
    """Without points further than two standard deviations from the least-squares plane."""
    middle = points.mean(axis=0)
    design = np.column_stack([points[:, :2] - middle[:2], np.ones(len(points))])
    left = points[:, 2] - design @ np.linalg.lstsq(design, points[:, 2], rcond=None)[0]
    return points[np.abs(left) <= PLANE_SIGMAS * left.std()]


def study_cloud(points: np.ndarray, middle: np.ndarray, *, wet: bool, field: bool) -> np.ndarray:
    """The points of a cloud that the study would have measured."""
    kept = thinned(cropped(points, middle, CROP_M, CROP_M), THIN_M["wet" if wet else "dry"])
    kept = without_outliers(kept)
    return near_their_plane(kept) if wet and field else kept


def away_from_objects(points: np.ndarray) -> np.ndarray:
    """Which points (N,) of a surface lie more than 1 m from anything that rises out of its bed."""
    top, row, column = tops(points, RASTER_M)
    known = np.isfinite(top)
    middle = np.median(points[:, 2])
    bed = median_filter(np.where(known, top, middle), size=int(OBJECT_WINDOW_M / RASTER_M) | 1, mode="nearest")
    rises = known & (top > bed + OBJECT_RISE_M)
    reach = int(np.ceil(CLEAR_M / RASTER_M))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return ~binary_dilation(rises, x * x + y * y <= reach * reach)[row, column]
