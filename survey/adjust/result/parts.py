"""Parts of a block that share no points: what each is, and how well its heights are known against those of the others.

Photographs of two places with nothing between them that matches, as where a survey crosses deep water, are adjusted
together, and share the lens and the water; where one part lies against another, positions and control alone tell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from refract import FlatWater
from survey.adjust.result.adjustment import Adjustment, Residuals
from survey.adjust.result.std_common import moves_over_area
from survey.display.quantities import length
from survey.photos.poses import parts_of

# Runs of photographs that are named.
_MOST_RUNS = 6


@dataclass(frozen=True)
class Part:
    """A part of an adjusted block."""

    names: tuple[str, ...]  # Of its photographs
    listed: str  # The same as runs of neighbours, "a to d, f, k to m"
    num_points: int  # Tie points
    apart_m: float  # Between the nearest cameras of this part and another
    # Standard deviation of its mean height by water, lens and poses; None with too few points to tell
    height_std_m: float | None
    to_first_std_m: float | None  # That of its mean height less that of the first part; None for the first itself


def part_numbers(found: Adjustment) -> np.ndarray:
    """Part of each view by shared tie points, without marks of control (`survey.photos.poses.parts_of`)."""
    is_tie = found.residuals.point < len(found.points) - len(found.control)
    return parts_of(len(found.poses.names), found.residuals.point[is_tie], found.residuals.view[is_tie])


def parts_of_adjustment(found: Adjustment, water: FlatWater | None) -> tuple[Part, ...]:
    """The parts of an adjusted block, the largest first; none where it is whole."""
    number = part_numbers(found)
    if number.max() < 1:
        return ()
    parts: list[Part] = []
    first: np.ndarray | None = None
    for each in range(int(number.max()) + 1):
        views = np.flatnonzero(number == each)
        own = _only(found, number == each)
        moves = moves_over_area(own, water)
        mean = moves.mean(axis=0) if len(moves) else None
        first = mean if each == 0 else first
        others = found.poses.centres[(number != each) & (number >= 0)]
        between = np.linalg.norm(found.poses.centres[views][:, None] - others[None], axis=-1)
        to_first = None if each == 0 or mean is None or first is None else _std(found, mean - first)
        parts.append(
            Part(
                names=tuple(found.poses.names[view] for view in views),
                listed=_runs(found.poses.names, views),
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
    told = [f"{len(part.names)} ({part.listed})" for part in parts]
    known = [part.to_first_std_m for part in parts if part.to_first_std_m is not None]
    by = f", which determine their relative height to {length(max(known))} (1 sigma)" if known else ""
    return [
        f"the photographs fall into {len(parts)} parts without common points, of {_listed(told)} photographs: only "
        f"positions, control and water connect them{by}; where they should be one block, fly more overlap between them"
    ]


def _only(found: Adjustment, keep: np.ndarray) -> Adjustment:
    """An adjustment with only the tie points of views (V,) bool; the covariance stays."""
    is_tie = found.residuals.point < len(found.points) - len(found.control)
    mine = is_tie & keep[found.residuals.view]
    kept, point = np.unique(found.residuals.point[mine], return_inverse=True)
    residuals = Residuals(found.residuals.view[mine], found.residuals.px[mine], found.residuals.at_px[mine], point)
    return replace(found, residuals=residuals, points=found.points[kept])


def _runs(names: tuple[str, ...], views: np.ndarray) -> str:
    """Names of views (K,), ascending, those of neighbours as their first and last."""
    runs = np.split(views, np.flatnonzero(np.diff(views) > 1) + 1)
    spans = [names[run[0]] if len(run) == 1 else f"{names[run[0]]} to {names[run[-1]]}" for run in runs]
    more = f" and {len(spans) - _MOST_RUNS} more" if len(spans) > _MOST_RUNS else ""
    return ", ".join(spans[:_MOST_RUNS]) + more


def _std(found: Adjustment, moves: np.ndarray) -> float:
    return math.sqrt(max(float(moves @ found.covariance.matrix @ moves), 0.0))


def _listed(texts: list[str]) -> str:
    return f"{', '.join(texts[:-1])} and {texts[-1]}"
