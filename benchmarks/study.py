"""How the BathyNeRF simulation study measured its clouds, and the bias of straight rays, for table4.py.

Heights and distances in metres, local frame. The study moved the clouds of both its fields, dry and wet, up by 18.9 cm
by hand; here nothing is moved. Where it leaves a choice is said here: how many neighbours the plane of its noise filter
has, and whether the inner 90 % are those of the least size or those between the quantiles of 5 and 95 %. How far over
the bed straight rays end is measured, and predicted from the geometry of the views alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from baselines import apparent_points
from scipy.ndimage import binary_dilation, median_filter
from scipy.spatial import cKDTree

from evaluation.c2m import is_outlier
from fields.sweep import views
from fields.sweep.matching import PASSES
from refract import FlatWater, PinholeCamera
from survey.folder.survey import Survey

# Heights are tried up to this share of the depth over the bed.
HIGHEST, NUM_HYPOTHESES = 0.6, 241
# Points drawn evenly from the bed: enough for a median.
POINTS = 2000
# Steps of the study.
CROP_M = 75.0
OBJECT_M = (25.0, 30.0)
THIN_M = {"dry": 0.05, "wet": 0.065}
OUTLIER_SIGMAS, PLANE_SIGMAS = 2.0, 2.0
# Of the statistical outlier filter of Nerfstudio's export, with which the study cleaned the clouds of its fields.
OUTLIER_NEIGHBOURS = 20
# Of the plane of a point: as many as CloudCompare's filter of noise has in the radius that it proposes.
PLANE_NEIGHBOURS = 12
# Points whose planes are fitted at once: about 100 MB.
CHUNK = 100_000
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


def near_their_planes(points: np.ndarray) -> np.ndarray:
    """Without points further from the plane through their neighbours than twice the neighbours' standard deviation.

    As CloudCompare's filter of noise: the plane is that of total least squares, the point itself has no part in it.
    """
    tree, parts = cKDTree(points), [np.zeros(0, dtype=bool)]
    for start in range(0, len(points), CHUNK):
        part = points[start : start + CHUNK]
        # The nearest of all is the point itself.
        around = points[tree.query(part, k=PLANE_NEIGHBOURS + 1, workers=-1)[1][:, 1:]]
        middle = around.mean(axis=1)
        spread = around - middle[:, None]
        variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread) / PLANE_NEIGHBOURS)
        away = np.einsum("ni,ni->n", part - middle, axes[:, :, 0])
        parts.append(np.abs(away) <= PLANE_SIGMAS * np.sqrt(np.maximum(variances[:, 0], 0.0)))
    return points[np.concatenate(parts)]


def study_cloud(points: np.ndarray, middle: np.ndarray, *, wet: bool, field: bool) -> np.ndarray:
    """The points of a cloud that the study would have measured: clouds of fields alone are cleaned."""
    if field:
        points = points[~is_outlier(points, neighbours=OUTLIER_NEIGHBOURS, num_std=OUTLIER_SIGMAS)]
    kept = thinned(cropped(points, middle, CROP_M, CROP_M), THIN_M["wet" if wet else "dry"])
    return near_their_planes(kept) if wet and field else kept


def trimmed(distances: np.ndarray) -> tuple[float, float]:
    """Mean and standard deviation of distances (N,) between their quantiles of 5 and 95 %."""
    low, high = np.quantile(distances, (0.05, 0.95))
    inner = distances[(distances >= low) & (distances <= high)]
    return float(inner.mean()), float(inner.std())


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


@dataclass(frozen=True)
class Bias:
    """Medians over points of the bed of how far straight rays end above it, [m].

    ``same_views_m`` uses the views that the sweep compares, the best-agreeing half of each; ``all_views_m`` all that
    see the point.
    """

    measured_m: float
    same_views_m: float
    all_views_m: float
    num_points: int


def straight_bias(cloud: np.ndarray, bed: np.ndarray, survey: Survey, times_seen: tuple[int, int]) -> Bias:
    """The bias of a straight-ray cloud (N, 3) over visible points of the bed (M, 3), local [m]."""
    cameras, water = [view.camera for view in survey.views], survey.water
    bed = bed[away_from_objects(bed)]
    bed = bed[np.random.default_rng(0).permutation(len(bed))[:POINTS]]
    projections = Projections.of(bed, cameras, water)
    everyone = apparent_points(projections.centres, projections.directions, projections.seen)
    same = matched_points(projections, bed, water.depth(bed), cameras, water, times_seen)
    known = np.isfinite(same).all(axis=1) & np.isfinite(everyone).all(axis=1)
    reach = 2.0 * float(np.median([-water.depth(c.centre) / c.fx for c in cameras]))
    measured = rise_of(cloud, same, bed, HIGHEST * water.depth(bed), reach)
    known &= np.isfinite(measured)
    medians = [float(np.median(rise[known])) for rise in (measured, (same - bed)[:, 2], (everyone - bed)[:, 2])]
    return Bias(*medians, int(known.sum()))


@dataclass(frozen=True)
class Projections:
    """Where N points appear to V cameras: pixels (V, N, 2), and rays as `apparent_points` takes them, (N, V, ...)."""

    pixels: np.ndarray
    centres: np.ndarray
    directions: np.ndarray
    seen: np.ndarray

    @staticmethod
    def of(points: np.ndarray, cameras: list[PinholeCamera], water: FlatWater) -> Projections:
        pixels = np.array([c.project(points, water) for c in cameras])
        size = np.array([(c.width, c.height) for c in cameras])[:, None]
        seen = ((pixels > 0.0) & (pixels < size)).all(axis=2).T
        centres = np.broadcast_to(np.array([c.centre for c in cameras]), (len(points), len(cameras), 3))
        directions = np.stack([c.directions(p) for c, p in zip(cameras, pixels, strict=True)], axis=1)
        return Projections(pixels, centres, directions, seen)


def matched_points(
    projections: Projections,
    bed: np.ndarray,
    depth: np.ndarray,
    cameras: list[PinholeCamera],
    water: FlatWater,
    times_seen,
) -> np.ndarray:
    """Where the apparent rays of the views that the sweep matches meet, (N, 3): of its height maps the steepest, as in
    the cloud (`fields.sweep.bed.unique_pixels`).

    Of each map the height is taken at which the better half of its neighbours comes nearest to what it sees, as the
    sweep takes that where they look most alike.
    """
    straight = replace(water, n_water=1.0)
    seen, cells = views.coverage(cameras, straight, float(np.median(bed[:, 2])))
    rises, found = np.linspace(0.0, HIGHEST, NUM_HYPOTHESES) * depth[:, None], []
    chosen = views.cover(seen, cells, cameras, *times_seen)
    for view in sorted(chosen, key=lambda v: cameras[v].cam_from_local[2][2]):
        others = views.neighbours(cameras, seen, cells, view, list(range(len(cameras))), PASSES[-1].neighbours)
        ray, centre = projections.directions[:, view], cameras[view].centre
        t = (bed[:, 2:] + rises - centre[2]) / ray[:, 2:]
        hypotheses = centre + t[..., None] * ray[:, None]
        miss = [
            np.where(
                projections.seen[:, o, None],
                ((cameras[o].project(hypotheses, None) - projections.pixels[o][:, None]) ** 2).sum(axis=2),
                np.inf,
            )
            for o in others
        ]
        found.append(_best_half_meets(projections, np.array(miss), view, others))
    found = np.array(found)
    first = np.isfinite(found[..., 0]).argmax(axis=0)
    return found[first, np.arange(len(bed))]


def _best_half_meets(projections: Projections, miss: np.ndarray, view: int, others: list[int]) -> np.ndarray:
    """Where a view's rays meet those of the neighbours that ``miss`` them least (neighbours, N, hypotheses): (N, 3)."""
    count = np.isfinite(miss[:, :, 0]).sum(axis=0)
    keep = np.maximum((count + 1) // 2, 1)
    order = np.sort(miss, axis=0)
    among = np.arange(len(others))[:, None, None] < keep[:, None]
    nearest = np.where(among, order, 0.0).sum(axis=0).argmin(axis=1)
    there = np.take_along_axis(miss, nearest[None, :, None], axis=2)[:, :, 0]
    rank = there.argsort(axis=0).argsort(axis=0)
    chosen = np.zeros_like(projections.seen)
    chosen[:, others] = ((rank < keep) & np.isfinite(there)).T
    chosen[:, view] = True
    points = apparent_points(projections.centres, projections.directions, chosen & projections.seen)
    edge = (nearest == 0) | (nearest == miss.shape[2] - 1) | ~projections.seen[:, view] | (count == 0)
    points[edge] = np.nan
    return points


def rise_of(cloud: np.ndarray, places: np.ndarray, bed: np.ndarray, highest: np.ndarray, reach: float) -> np.ndarray:
    """Median height (N,) over the bed of the cloud's points within ``reach`` [m] of places in plan; NaN without any."""
    measured = np.full(len(bed), np.nan)
    known = np.flatnonzero(np.isfinite(places).all(axis=1))
    for index, near in zip(known, cKDTree(cloud[:, :2]).query_ball_point(places[known, :2], reach), strict=True):
        rise = cloud[near, 2] - bed[index, 2]
        rise = rise[(rise > -reach) & (rise < highest[index])]
        if len(rise):
            measured[index] = np.median(rise)
    return measured
