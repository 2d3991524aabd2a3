"""Runs with a target std or a time budget: the recipe of each round, and standard deviations by cells of the ground.

A run goes in rounds of sweep, solver and assessment (`survey.run.execution`). The first is cheap. Each later one goes
on from the heights before, so that a round in between costs a few percent of the one after it. What is assessed is the
random std of the points, which more processing reduces; std_common comes on top of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from survey.plan.aim import SHARE, Aim
from survey.plan.plan import Decision
from survey.plan.recipe import RECIPES, Recipe
from survey.plan.round_costs import FullSizeAmounts, RoundRates, samples
from survey.run.clock import Clock

if TYPE_CHECKING:
    from fields.sweep.bed import BedPoints

# Side of a cell in ground sampling distances.
_CELL_GSD = 10.0
# Places that fewer views see than this have too few heights to average.
_FEW_VIEWS = 4.0
# What may keep cells above, in words.
FEW, DEPTH, NOISE = "few photographs", "depth", "noise, texture and relief below the pixel"
# A point's own standard deviation with images of twice the side (docs/targets.md).
_FINER_STD = 0.55
# Least gain in the share of the ground that is worth a round.
_LEAST_GAIN = 0.01
# Foreseen times may be short by this share.
_SLACK = 0.1


@dataclass(frozen=True)
class CellStd:
    """Cells of the ground that have points; K of them, medians over their points."""

    xyz: np.ndarray  # (K, 3) [m], local: a point of each
    std: np.ndarray  # (K,) [m]
    num_views: np.ndarray  # (K,)
    depth: np.ndarray  # (K,) [m]: of water; NaN in a dry survey

    def __len__(self) -> int:
        return len(self.std)

    def reached(self, std_m: float, factor: float = 1.0) -> float:
        """Share of the cells within a standard deviation [m] with theirs scaled by a factor; 1 without cells."""
        return float((factor * self.std <= std_m).mean()) if len(self) else 1.0

    def limit(self, std_m: float) -> str:
        """Dominant part of the standard deviation of most cells above the target."""
        above = self.std > std_m
        few = above & (self.num_views < _FEW_VIEWS)
        if 2 * few.sum() > above.sum():
            return FEW
        within = self.depth[~above]
        if within.size and np.isfinite(within).any() and above.any():
            deeper = np.nanmedian(self.depth[above & ~few]) > np.nanquantile(within, 0.75)
            return DEPTH if deeper else NOISE
        return NOISE

    def in_words(self, std_m: float) -> str:
        """Share that was reached, in words."""
        if not len(self):
            return "no ground has points"
        most = 1e3 * float(np.quantile(self.std, SHARE))
        return (
            f"{100 * self.reached(std_m):.1f} % of the ground has a std of at most {1e3 * std_m:.1f} mm; "
            f"{100 * SHARE:g} % of it has at most {most:.1f} mm"
        )


def std_cells(bed: BedPoints, gsd: float) -> CellStd:
    """Cells of points of the bed; ``gsd`` [m] is the ground sampling distance."""
    use = np.isfinite(bed.std)
    place = np.floor(bed.xyz[use, :2] / (_CELL_GSD * gsd)).astype(np.int64)
    _, first, cell = np.unique(place, axis=0, return_index=True, return_inverse=True)
    columns = (_medians(cell.ravel(), each[use].astype(np.float64)) for each in (bed.std, bed.num_views, bed.depth))
    return CellStd(bed.xyz[use][first], *columns)


def _medians(cell: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The lower median of the values of each cell, numbered from zero."""
    order = np.lexsort((values, cell))
    ends = np.append(np.flatnonzero(np.diff(cell[order])) + 1, len(cell))
    starts = np.concatenate([[0], ends[:-1]])
    return values[order][(starts + ends - 1) // 2] if len(cell) else np.empty(0)


@dataclass
class AimedRun:
    """The aim of a run and its state."""

    aim: Aim
    recipes: tuple[Recipe, ...]  # From the least work to the most
    scales: tuple[float, ...]  # Of the images, for each recipe
    amounts: FullSizeAmounts
    clock: Clock | None  # Where a time is asked for
    number: int  # Of the recipe of the present round
    rates: RoundRates
    # Whether the first round has begun. Poses are tested before it, on images of the size of standard quality.
    has_begun: bool = False
    decisions: list[Decision] = field(default_factory=list)  # One for each round that is over
    following: int | None = None  # The recipe of the next round; None before a round is over and after the last

    @property
    def recipe(self) -> Recipe:
        """Recipe of the present round, or before the first."""
        return self.recipes[self.number] if self.has_begun else RECIPES["standard"]

    @property
    def scale(self) -> float:
        """Scale of the images in the present round."""
        return self.scales[self.number]

    def solves(self, number: int) -> bool:
        """Whether a recipe has the solver."""
        return self.recipes[number].field == "solver"

    def samples(self, scale: float, before: float | None) -> float:
        """Number of comparisons of a sweep at a scale that continues a smaller one, or starts anew."""
        return samples(self.amounts, scale, lowest=self.scales[0], before=before)

    @property
    def first_search(self) -> float:
        """Share of the size of the present round at which the whole bound is searched, if the round is the first."""
        return self.scales[0] / self.scale

    def end_round(self, following: int | None, why: str) -> Decision:
        """Decide on the next round; returns the decision in words, for the plan."""
        done = "with the solver" if self.solves(self.number) else "sweep alone"
        then = "the last" if following is None else f"then image scale {self.scales[following]:g}"
        name, choice = f"round {len(self.decisions) + 1}", f"image scale {self.scale:g}, {done}; {then}"
        self.decisions.append(Decision(name, choice, why))
        self.following = following
        if following is not None:
            self.number = following
        return self.decisions[-1]

    @property
    def tail_s(self) -> float:
        """Time [s] from the end of the present round to that of the run."""
        return self.rates.tail_s(self.amounts, self.scale)

    def round_s(self, number: int) -> float:
        """Duration of a next round by a recipe, with all that follows it [s]."""
        scale = self.scales[number]
        solver = self.rates.solver_s(self.amounts, scale) if self.solves(number) else 0.0
        sweep = (
            0.0
            if scale == self.scale
            else self.rates.sweep_s(self.amounts, scale, lowest=self.scales[0], before=self.scale)
        )
        return (sweep + solver) * (1.0 + _SLACK) + self.rates.tail_s(self.amounts, scale)

    def fits(self, number: int) -> bool:
        """Whether there is time for a next round by a recipe."""
        return self.clock is None or self.round_s(number) <= self.clock.left_s

    def next_recipe(self, cells: CellStd | None) -> tuple[int | None, str]:
        """Number of the recipe of the next round, None where this was the last, and why.

        ``cells`` are what this round reached, where a standard deviation is asked for.
        """
        later = range(self.number + 1, len(self.recipes))
        why = ""
        if cells is not None and self.aim.std_m is not None:
            why = cells.in_words(self.aim.std_m)
            if cells.reached(self.aim.std_m) >= SHARE:
                return None, why
            later = self._towards(cells, self.aim.std_m)
            why += (
                ""
                if later
                else f"; further rounds would not help, the rest is limited by {cells.limit(self.aim.std_m)}"
            )
        if not later:
            return None, why or "further rounds would not improve it"
        fitting = [number for number in later if self.fits(number)]
        if not fitting:
            return None, "; ".join([*([why] if why else []), f"the next round does not fit into the {self._left} left"])
        return fitting[-1], why or f"{self._left} are left"

    @property
    def _left(self) -> str:
        return f"{self.clock.left_s:.0f} s" if self.clock is not None else ""

    def _towards(self, cells: CellStd, std_m: float) -> range:
        """The later recipes up to the first that should reach a standard deviation, or all if that is worth it."""
        solving = [number for number in range(self.number + 1, len(self.recipes)) if self.solves(number)]
        foreseen = {
            number: cells.reached(std_m, _FINER_STD ** math.log2(self.scales[number] / self.scale))
            for number in solving
        }
        for number in solving:
            if foreseen[number] >= SHARE:
                return range(number, number + 1) if self.clock is None else range(self.number + 1, number + 1)
        if not solving or foreseen[solving[-1]] < cells.reached(std_m) + _LEAST_GAIN:
            return range(0)
        last = solving[-1]
        return range(last, last + 1) if self.clock is None else range(self.number + 1, last + 1)
