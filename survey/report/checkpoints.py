"""Accuracy of the cloud of a run: height differences at check points, and its stated uncertainty."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from scipy.spatial import cKDTree

from evaluation import height_at
from evaluation.standards import TVU, order_by_tvu
from geo.shapes import ComputedColumn, portions
from survey.compare.inputs import within
from survey.control.points import Checkpoint, ControlPoint
from survey.display.blocks import Block, Rows, Text
from survey.display.plan_grid import median
from survey.display.quantities import count, length, named, share
from survey.folder.survey import Survey
from survey.water.surface import height_above

# 95 % of normal errors are within so many standard deviations: along one axis, and in two that are alike.
LE95, CE95 = 1.959964, 2.447747
_SHARE = 0.95
_NOTE = (
    "By the standard deviations that the cloud states, random and shared, taken as those of normal errors; nothing is "
    "compared, which check points or a reference would do. An order of IHO S-44 (Ed. 6.1.0) also asks for horizontal "
    "uncertainty, coverage and feature detection."
)
# Radius around a check point within which points of the cloud are used, in ground sampling distances; points lie about
# 1.2 of them apart.
WITHIN_GSD = 5.0
# Differences beyond this many stated standard deviations of the cloud cause a warning, and of many check points, as of
# photons, those beyond what normal errors of all of them reach with this probability.
_MOST_STD, _BY_CHANCE = 3.0, 0.01
# Radius of the search for candidates, in that radius.
_SEARCH = 4.0
# Check points that the table lists and the map labels: those of the largest differences.
MOST_ROWS = 50
# Number of nearest points whose standard deviations give that at a check point.
_NEAREST = 8


@dataclass(frozen=True)
class StatedOrder:
    """An order of IHO S-44."""

    name: str
    # [-]: share of the points under water whose stated uncertainty at 95 % is at most the one that the order allows
    share_within: float


@dataclass(frozen=True)
class StatedFigures:
    """Stated uncertainty of the heights of the cloud."""

    # [m]: median of 1.96 standard deviations, random and shared: the error of a height that 95 % are below
    le95_m: float
    points_wet: int
    orders: tuple[StatedOrder, ...]  # The strictest first; none without points under water

    @property
    def strictest(self) -> StatedOrder | None:
        """The first order for 95 % of the points; None where there is none."""
        return next((order for order in self.orders if order.share_within >= _SHARE), None)


def stated_of(std_m: np.ndarray | ComputedColumn, depth_m: np.ndarray | ComputedColumn) -> StatedFigures | None:
    """The figures of points with standard deviations (N,) [m] of their heights, at depths (N,) [m]; None of no points.

    Depths are positive under water; NaN counts for nothing.
    """
    middle = median(std_m)
    if np.isnan(middle):
        return None
    counts = np.zeros(len(TVU) + 2, dtype=np.int64)
    for part in portions(len(std_m)):
        counts += np.bincount(order_by_tvu(std_m[part], depth_m[part]), minlength=len(counts))
    wet, within = int(counts[1:].sum()), np.cumsum(counts[1:])
    shares = [StatedOrder(name, float(num / wet)) for (name, _, _), num in zip(TVU, within, strict=False) if wet]
    return StatedFigures(LE95 * middle, wet, tuple(shares))


def table(found: StatedFigures | None) -> list[Block]:
    """Error of a height at 95 %, and how many points each order takes; nothing without points."""
    if found is None:
        return []
    of = f"of {count(found.points_wet)} points under water"
    orders = [(f"IHO S-44, vertical, {order.name}", f"{share(order.share_within)} {of}") for order in found.orders]
    return [Rows([("height, 95 %, median", length(found.le95_m)), *orders]), Text(_NOTE, is_soft=True)]


@dataclass(frozen=True)
class CheckpointRow:
    """Check point with its residual."""

    name: str
    easting: float  # easting, northing, height in crs
    northing: float
    height: float
    depth_m: float | None  # Under the water, negative above; None for a dry survey
    # Height of the cloud less that of the check point; None where the cloud does not surround it
    difference_m: float | None
    # Standard deviation of the height of the cloud there, random and shared; None without a difference
    stated_m: float | None = None
    std_m: float = 0.0  # Standard deviation of the height of the check point itself; 0 where nothing states it
    is_outside: bool = False  # Whether it lies outside [area] bounds, beyond which there is no cloud


@dataclass(frozen=True)
class CheckpointGroup:
    """Differences at several check points."""

    name: str
    num: int  # Those with a difference
    # mean_m, rms_m, largest_m [m]: the last by size, with its sign
    mean_m: float
    rms_m: float
    largest_m: float
    le95_m: float  # [m]: 1.96 times `rms_m`: 95 % of normal errors are smaller
    # [m]: root mean square of the standard deviations of those check points themselves that state one, and their number
    own_m: float = 0.0
    num_own: int = 0


@dataclass(frozen=True)
class CheckpointAccuracy:
    """The cloud at all check points."""

    rows: tuple[CheckpointRow, ...]
    # All, and those under and above water where there are both; none where no check point has a difference
    groups: tuple[CheckpointGroup, ...]
    within_m: float  # How far from a check point the points of the cloud count


def checkpoint_differences(points: np.ndarray, places: np.ndarray, gsd_m: float) -> np.ndarray:
    """Heights of a cloud (N, 3) less those of check points (K, 3) [m], local: (K,) [m].

    By the plane through the nearest points of the cloud, as `compare --checkpoints` has it; NaN where they are fewer
    than four, or do not surround the check point.
    """
    near = points[_near(points, places, gsd_m)]
    return height_at(near, places[:, :2], within_m=WITHIN_GSD * gsd_m) - places[:, 2]


def _near(points: np.ndarray, places: np.ndarray, gsd_m: float) -> np.ndarray:
    """Numbers of the points (N, 3) about places (K, 2 or more), in plan.

    A tree of all points would take more memory than the cloud.
    """
    tree, rows = cKDTree(places[:, :2]), [np.empty(0, dtype=np.int64)]
    for part in portions(len(points)):
        distance, _ = tree.query(points[part, :2], distance_upper_bound=_SEARCH * WITHIN_GSD * gsd_m)
        rows.append(part.start + np.flatnonzero(np.isfinite(distance)))
    return np.concatenate(rows)


def _stated_at(points: np.ndarray, stated: np.ndarray | ComputedColumn, places: np.ndarray, gsd_m: float) -> np.ndarray:
    """Standard deviations (K,) [m] of the cloud at places (K, 3): the median of the nearest points; NaN without."""
    rows = _near(points, places, gsd_m)
    if len(rows) < _NEAREST:
        return np.full(len(places), np.nan)
    distance, nearest = cKDTree(points[rows, :2]).query(places[:, :2], k=_NEAREST)
    # Those of another place are none of this one.
    is_near = distance[:, -1] <= _SEARCH * WITHIN_GSD * gsd_m
    return np.where(is_near, np.median(stated[rows][nearest], axis=1), np.nan)


def checkpoints_of(
    survey: Survey, points: np.ndarray, gsd_m: float, stated: np.ndarray | ComputedColumn | None = None
) -> CheckpointAccuracy | None:
    """The figures of a cloud (N, 3) [m], local, with the standard deviations (N,) [m] of its heights, where known.

    None for a survey without check points: those of [control] checkpoints, and the control points that their file calls
    check points.
    """
    control = survey.observations.control
    marked = () if control is None else tuple(point for point in control.points if point.is_check)
    given: tuple[Checkpoint | ControlPoint, ...] = (*survey.observations.checkpoints, *marked)
    if not given:
        return None
    places, unknown = np.array([point.local for point in given]), np.full(len(given), np.nan)
    differences = checkpoint_differences(points, places, gsd_m)
    stds = unknown if stated is None else _stated_at(points, stated, places, gsd_m)
    stds = np.where(np.isfinite(differences), stds, np.nan)
    depths = unknown
    if survey.water is not None:
        depths = -height_above(survey.water, survey.observations.departure, places)
    outside = ~within(np.array([point.crs for point in given]), survey.bounds)
    known = (
        [float(value) if np.isfinite(value) else None for value in values] for values in (depths, differences, stds)
    )
    rows = tuple(
        CheckpointRow(
            point.name, east, north, height, depth_m, difference_m, stated_m, float(point.std[2]), bool(is_outside)
        )
        for point, (east, north, height), depth_m, difference_m, stated_m, is_outside in zip(
            given, (point.crs for point in given), *known, outside, strict=True
        )
    )
    return CheckpointAccuracy(rows, tuple(_groups(rows)), WITHIN_GSD * gsd_m)


def checkpoint_warnings(found: CheckpointAccuracy | None) -> list[str]:
    """A warning that names the check points whose difference the stated uncertainty does not explain."""
    if found is None:
        return []
    known = [
        (row.name, row.difference_m, math.hypot(row.stated_m, row.std_m))
        for row in found.rows
        if row.difference_m is not None and row.stated_m is not None
    ]
    # The more there are, the farther the farthest of them lies by chance.
    beyond = NormalDist().inv_cdf(1.0 - 0.5 * _BY_CHANCE / max(len(known), 1))
    most = round(max(_MOST_STD, beyond), 1)
    far = [
        f"{name} ({length(difference)}, stated {length(std)})"
        for name, difference, std in known
        if abs(difference) > most * std
    ]
    return named(far, "check point", f"farther from the cloud than {most:g} standard deviations")


def _groups(rows: Sequence[CheckpointRow]) -> list[CheckpointGroup]:
    wet = [row for row in rows if row.depth_m is not None and row.depth_m > 0.0]
    dry = [row for row in rows if row.depth_m is not None and row.depth_m <= 0.0]
    parts = [("all", rows), *([("under water", wet), ("above water", dry)] if wet and dry else [])]
    groups = []
    for name, part in parts:
        pairs = [(row.difference_m, row.std_m) for row in part if row.difference_m is not None]
        if pairs:
            known, own = np.array(pairs).T
            own = own[own > 0.0]
            largest, rms = float(known[np.argmax(np.abs(known))]), float(np.sqrt(np.mean(known**2)))
            own_m = float(np.sqrt(np.mean(own**2))) if len(own) else 0.0
            numbers = float(known.mean()), rms, largest, LE95 * rms, own_m
            groups.append(CheckpointGroup(name, len(known), *numbers, len(own)))
    return groups
