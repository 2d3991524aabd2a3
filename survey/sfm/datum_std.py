"""What the way of positions and poses into the crs of a survey adds to their accuracy: PROJ states it.

An error of a transformation of datums is the same at all places of a survey. Where control holds the block it widens
the positions, and counts for nothing; else the whole block lies off by it. A way that is worse than the positions, for
want of a grid, is refused where nothing else places the block: a grid can be had.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from geo.transformation import Transformation
from survey.errors import FILE_NAME

# Positions that are better than this are those of a receiver with corrections, or of an adjusted block.
WELL_KNOWN_M = 0.1
# So many control points place a block.
_PLACING = 3


@dataclass(frozen=True)
class DatumStd:
    """Standard deviations [m] that a transformation of datums adds, alike at all places: in plan and in height."""

    plan: float = 0.0
    up: float = 0.0

    def onto(self, std: np.ndarray) -> np.ndarray:
        """Standard deviations (3,) [m] of a place after the transformation."""
        return np.hypot(std, [self.plan, self.plan, self.up])


EXACT = DatumStd()


def plan_std(way: Transformation) -> float:
    """Standard deviation [m] of places in plan by a transformation; 0 where PROJ does not know it."""
    return way.accuracy_m or 0.0


def require_as_good(way: Transformation, plan_std_m: float, said: str, num_control: int) -> None:
    """Raise where a grid is missing, and the way without it is worse than the places that take it.

    Parameters
    ----------
    way : Transformation
    plan_std_m : [m]
        Of the places in plan, before.
    said : str
        What they are, e.g. "GPS positions".
    num_control : int
        Control points that place the block all the same.

    Raises
    ------
    MissingGrid
    """
    if not way.missing or plan_std_m > WELL_KNOWN_M or num_control >= _PLACING:
        return
    if way.accuracy_m is not None and way.accuracy_m <= plan_std_m:
        return
    known = "an unknown accuracy" if way.accuracy_m is None else f"{way.accuracy_m:.2g} m"
    as_good = "taken as exact" if plan_std_m == 0.0 else f"good to {plan_std_m:.2g} m"
    way.require_best(
        f"{said} are {as_good}, and what PROJ can do without a grid has {known}",
        f"or put it into the folder geoid of the survey; or give {_PLACING} control points or more in crs, which then "
        f"place the block, or position_std_m of {way.accuracy_m or 10.0:.2g} and more in [cameras] in {FILE_NAME}: the "
        "survey may then lie off by as much",
    )


def least(stds: Collection[DatumStd]) -> DatumStd:
    """What all of several have in common: the smallest; nothing of none."""
    return DatumStd(*(min((getattr(each, name) for each in stds), default=0.0) for name in ("plan", "up")))
