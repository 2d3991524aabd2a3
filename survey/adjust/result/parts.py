"""The mean height of an adjusted block, and parts of it that share no points.

Photographs of two places with nothing between them that matches, as where a survey crosses deep water, are adjusted
together, and share the lens and the water; where one part lies against another, positions and control alone tell.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from refract import FlatWater
from survey.adjust.block.normal_matrix import propagated_variance
from survey.adjust.result.adjustment import Adjustment, Residuals
from survey.adjust.result.std_common import place_jacobian
from survey.display.quantities import length, listed
from survey.photos.poses import TiePoints, connected_parts, least_track

# The standard deviation of a mean over this many places, spread over the area, is that over all to a few per cent.
_PLACES_OF_MEAN = 50
# The cloud has each place from several views, of which these are enough for an average geometry.
_VIEWS_OF_MEAN = 6
# Squares along the longer side of the area, from each of which one place at most is taken.
_SQUARES_OF_MEAN = 12
# Runs of photographs that are named.
_MOST_RUNS = 6


@dataclass(frozen=True)
class CommonError:
    """Standard deviation of the height by water, lens and poses [m]."""

    mean: float  # Of the mean height over the area: by so much the whole cloud may be too high or too low
    typical: float  # Median over the places of the standard deviation of the height there
    num_places: int


def common_error(found: Adjustment, water: FlatWater | None) -> CommonError | None:
    """Std of the mean height over an adjusted block under local water, but for errors of single points."""
    jacobian = height_jacobian_over_area(found, water)
    if not len(jacobian):
        return None
    by_place = propagated_variance(jacobian, found.covariance.matrix)
    mean_jacobian = jacobian.mean(axis=0)
    return CommonError(
        mean=math.sqrt(float(propagated_variance(mean_jacobian, found.covariance.matrix))),
        typical=float(np.median(np.sqrt(by_place))),
        num_places=len(jacobian),
    )


def height_jacobian_over_area(found: Adjustment, water: FlatWater | None) -> np.ndarray:
    """Jacobian (K, P) of the heights of points spread over the area, by the parameters of the covariance."""
    ties = _places_of_mean(found)
    return place_jacobian(found, water, ties)[:, 2] if len(ties) else np.zeros((0, len(found.covariance.matrix)))


def _places_of_mean(found: Adjustment) -> TiePoints:
    """Points of the adjustment spread over the area, each with some of the views that show it."""
    first = np.searchsorted(found.residuals.point, np.arange(len(found.points) + 1))
    seen = np.diff(first)
    enough = np.flatnonzero(seen >= least_track(len(found.poses.names)))
    if not len(enough):
        return TiePoints(np.empty((0, 3)), *(np.empty(0, dtype=np.int64),) * 2, np.empty((0, 2)))
    plan = found.points[enough, :2]
    side = max(float(np.ptp(plan, axis=0).max()), 1e-9) / _SQUARES_OF_MEAN
    # Of each square the point that most views show.
    order = np.argsort(-seen[enough], kind="stable")
    _, one = np.unique(np.floor((plan[order] - plan.min(axis=0)) / side), axis=0, return_index=True)
    chosen = np.sort(enough[order[one]])
    chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, _PLACES_OF_MEAN).round().astype(np.int64))]
    rows = [
        first[k] + np.linspace(0, seen[k] - 1, min(seen[k], _VIEWS_OF_MEAN)).round().astype(np.int64) for k in chosen
    ]
    at = np.concatenate(rows)
    point = np.repeat(np.arange(len(chosen)), [len(row) for row in rows])
    return TiePoints(found.points[chosen], point, found.residuals.view[at], found.residuals.at_px[at])


@dataclass(frozen=True)
class Part:
    names: tuple[str, ...]  # Of its photographs
    listed: str  # The same as runs of neighbours, "a to d, f, k to m"
    num_points: int  # Tie points
    apart_m: float  # Between the nearest cameras of this part and another
    # Standard deviation of its mean height by water, lens and poses; None with too few points to tell
    height_std_m: float | None
    to_first_std_m: float | None  # That of its mean height less that of the first part; None for the first itself


def part_numbers(found: Adjustment) -> np.ndarray:
    """Part of each view by shared tie points, without marks of control (`survey.photos.poses.connected_parts`)."""
    is_tie = found.residuals.point < len(found.points) - len(found.control)
    return connected_parts(len(found.poses.names), found.residuals.point[is_tie], found.residuals.view[is_tie])


def parts_of_adjustment(found: Adjustment, water: FlatWater | None) -> tuple[Part, ...]:
    """The parts of an adjusted block, the largest first; none where it is whole."""
    number = part_numbers(found)
    if number.max() < 1:
        return ()
    parts: list[Part] = []
    first: np.ndarray | None = None
    names = np.array(found.poses.names)
    for each in range(int(number.max()) + 1):
        views = np.flatnonzero(number == each)
        own = _only(found, number == each)
        jacobian = height_jacobian_over_area(own, water)
        mean = jacobian.mean(axis=0) if len(jacobian) else None
        first = mean if each == 0 else first
        others = found.poses.centres[(number != each) & (number >= 0)]
        between = np.linalg.norm(found.poses.centres[views][:, None] - others[None], axis=-1)
        to_first = None if each == 0 or mean is None or first is None else _std(found, mean - first)
        # Neighbours by the first and last of them.
        runs = [names[run].tolist() for run in np.split(views, np.flatnonzero(np.diff(views) > 1) + 1)]
        spans = [run[0] if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs]
        parts.append(
            Part(
                names=tuple(names[views].tolist()),
                listed=listed(spans, _MOST_RUNS),
                num_points=len(own.points),
                apart_m=float(between.min()),
                height_std_m=None if mean is None else _std(found, mean),
                to_first_std_m=to_first,
            )
        )
    return tuple(parts)


def parts_warning(found: Adjustment, water: FlatWater | None) -> list[str]:
    """Warning where a block falls into parts."""
    parts = parts_of_adjustment(found, water)
    if not parts:
        return []
    sizes = [f"{len(part.names)} ({part.listed})" for part in parts]
    known = [part.to_first_std_m for part in parts if part.to_first_std_m is not None]
    by = f", which determine their relative height to {length(max(known))} (1 sigma)" if known else ""
    return [
        f"the photographs fall into {len(parts)} parts without common points, of {', '.join(sizes[:-1])} and "
        f"{sizes[-1]} photographs: only positions, control and water connect them{by}; where they should be one block, "
        "fly more overlap between them"
    ]


def _only(found: Adjustment, keep: np.ndarray) -> Adjustment:
    """An adjustment with only the tie points of views (V,) bool; the covariance stays."""
    is_tie = found.residuals.point < len(found.points) - len(found.control)
    is_kept = is_tie & keep[found.residuals.view]
    kept, point = np.unique(found.residuals.point[is_kept], return_inverse=True)
    residuals = Residuals(
        found.residuals.view[is_kept], found.residuals.px[is_kept], found.residuals.at_px[is_kept], point
    )
    return replace(found, residuals=residuals, points=found.points[kept])


def _std(found: Adjustment, jacobian: np.ndarray) -> float:
    return math.sqrt(max(float(jacobian @ found.covariance.matrix @ jacobian), 0.0))
