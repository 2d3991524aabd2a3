"""Runs with a target std or a time budget: the recipe and duration of each round, and std by cells of the ground.

A run goes in rounds of sweep, solver and assessment (`survey.run.execution`). The first is cheap, and tells the rates
of this machine; before it those of one core with AVX-512 count. Each later one goes on from the heights before, so that
a round in between costs a few percent of the one after it. What is assessed is the random std of the points, which more
processing reduces; std_common comes on top of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from fields.sweep.passes import PASSES, passes_from
from survey import machine
from survey.folder.survey import Survey
from survey.plan.plan import Decision, Plan
from survey.plan.rates import FIRST_HYPOTHESES, SAMPLES_PER_CORE_S, poses_s
from survey.plan.recipe import RECIPES, STD_QUANTILE, Aim, Recipe
from survey.plan.workload import survey_amounts
from survey.run.clock import Clock

if TYPE_CHECKING:
    from fields.sweep.bed import BedPoints


# Imports, and hashes of program and photographs.
_START_S = 2.5
# Decoding a megapixel; the range of heights; the solver's learning, and its work on a point.
_DECODING_S, _RANGE_S, _SOLVER_S, _POINT_S = 0.02, 2.0, 2.0, 45e-6
# Bed, cloud and report: once, and per point.
_TAIL_S = (3.0, 12e-6)
# Of any run on any device.
ANY_RUN_S = _START_S + _TAIL_S[0]
# What a measurement may say at most: that a machine is so much faster than stated, or that the solver learned for all
# but this share of its time.
_FASTEST, _OF_POINTS = 0.5, 0.3
# A pass is left out where an earlier round had images so fine (fields.sweep.sweep).
_FINER = 1.2


@dataclass(frozen=True)
class FullSizeAmounts:
    """Amounts of work of a survey at full size."""

    photographs_mpx: float  # [Mpx]: of all photographs
    map_px: float  # [px]: of the views that get a height map
    points: float  # Of the bed: one in each cell of a ground sampling distance that two views see
    poses: str  # "check", "refine" or "fixed", as `Plan.pose_choice`
    num_views: int

    @staticmethod
    def of(survey: Survey, plan: Plan) -> FullSizeAmounts:
        """Amounts of a survey whose poses are known, from its plan at another scale."""
        at_scale = survey_amounts(survey, plan)
        per_scale = plan.image_scale**-2
        photographs_mpx = sum(view.lens.width * view.lens.height for view in survey.views) / 1e6
        mapped = float(np.sum(at_scale.view_pixels[at_scale.matched_views]))
        return FullSizeAmounts(
            photographs_mpx, mapped * per_scale, at_scale.num_cells * per_scale, plan.pose_choice, len(survey.views)
        )


def samples(
    amounts: FullSizeAmounts, scale: float, *, lowest_scale: float, earlier_scale: float | None = None
) -> float:
    """Number of comparisons of a sweep at a scale: pixels x heights x neighbours.

    It starts from the heights of ``earlier_scale``, or else searches the whole bound at ``lowest_scale``.
    """
    if earlier_scale is not None:
        passes = [p for p in PASSES if p.scale * scale > _FINER * earlier_scale]
    else:
        passes = list(passes_from(lowest_scale / scale))
    # The finer the first search, the more heights it tries.
    first = FIRST_HYPOTHESES / PASSES[0].scale
    steps = sum(p.scale**2 * (p.hypotheses or first * p.scale) * p.neighbours for p in passes)
    return steps * amounts.map_px * scale**2


@dataclass(frozen=True)
class RoundRates:
    """Time per unit of work on this machine."""

    sample_s: float  # Of the sweep [s]
    images_s: float  # Reading all photographs [s]
    slowdown: float  # Factor on the times of all else that are stated for one core
    point_s: float  # Of the solver [s]

    @staticmethod
    def stated(amounts: FullSizeAmounts, slowdown: float = 1.0) -> RoundRates:
        """Rates before the first measurement, on a machine that takes ``slowdown`` times as long as stated."""
        per_core = slowdown / machine.num_cores()
        images_s = slowdown * _DECODING_S * amounts.photographs_mpx
        return RoundRates(per_core / SAMPLES_PER_CORE_S, images_s, slowdown, _POINT_S * per_core)

    def after_sweep(self, seconds: float, num_samples: float, images_s: float) -> RoundRates:
        """Rates with the measured time [s] of a round's sweep and of reading its photographs."""
        sample_s = seconds / num_samples
        slowdown = max(self.slowdown * sample_s / self.sample_s, _FASTEST)
        return RoundRates(sample_s, images_s, slowdown, self.point_s * slowdown / self.slowdown)

    def after_solver(self, seconds: float, num_points: int) -> RoundRates:
        """Rates with the measured time [s] of the solver."""
        return replace(self, point_s=max(seconds - _SOLVER_S * self.slowdown, _OF_POINTS * seconds) / num_points)

    def sweep_s(
        self, amounts: FullSizeAmounts, scale: float, *, lowest_scale: float, earlier_scale: float | None = None
    ) -> float:
        """Time [s] of a round's sweep and of reading its photographs; see `samples`."""
        return (
            self.images_s
            + samples(amounts, scale, lowest_scale=lowest_scale, earlier_scale=earlier_scale) * self.sample_s
        )

    def solver_s(self, amounts: FullSizeAmounts, scale: float) -> float:
        """Time [s] of the solver over all points."""
        return _SOLVER_S * self.slowdown + amounts.points * scale**2 * self.point_s

    def tail_s(self, amounts: FullSizeAmounts, scale: float) -> float:
        """Time [s] from the last round to the end of the run."""
        return (_TAIL_S[0] + _TAIL_S[1] * amounts.points * scale**2) * self.slowdown

    def least_s(self, amounts: FullSizeAmounts, scale: float, *, lowest_scale: float) -> float:
        """Time [s] of a whole run whose only round is a sweep at a scale; see `samples`."""
        poses = poses_s(amounts.poses, amounts.photographs_mpx, amounts.num_views)
        before = (_START_S + poses + _RANGE_S) * self.slowdown
        return before + self.sweep_s(amounts, scale, lowest_scale=lowest_scale) + self.tail_s(amounts, scale)


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
        most = 1e3 * float(np.quantile(self.std, STD_QUANTILE))
        return (
            f"{100 * self.reached(std_m):.1f} % of the ground has a std of at most {1e3 * std_m:.1f} mm; "
            f"{100 * STD_QUANTILE:g} % of it has at most {most:.1f} mm"
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

    def samples(self, scale: float, earlier_scale: float | None) -> float:
        """Number of comparisons of a sweep at a scale that continues a smaller one, or starts anew."""
        return samples(self.amounts, scale, lowest_scale=self.scales[0], earlier_scale=earlier_scale)

    @property
    def first_search(self) -> float:
        """Share of the size of the present round at which the whole bound is searched, if the round is the first."""
        return self.scales[0] / self.scale

    def end_round(self, following: int | None, why: str) -> Decision:
        """Decide on the next round; returns the decision in words, for the plan."""
        done = "with the solver" if self.solves(self.number) else "sweep alone"
        next_round = "the last" if following is None else f"then image scale {self.scales[following]:g}"
        name, choice = f"round {len(self.decisions) + 1}", f"image scale {self.scale:g}, {done}; {next_round}"
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
            else self.rates.sweep_s(self.amounts, scale, lowest_scale=self.scales[0], earlier_scale=self.scale)
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
            if cells.reached(self.aim.std_m) >= STD_QUANTILE:
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
            if foreseen[number] >= STD_QUANTILE:
                return range(number, number + 1) if self.clock is None else range(self.number + 1, number + 1)
        if not solving or foreseen[solving[-1]] < cells.reached(std_m) + _LEAST_GAIN:
            return range(0)
        last = solving[-1]
        return range(last, last + 1) if self.clock is None else range(self.number + 1, last + 1)
