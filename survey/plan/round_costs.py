"""Durations of the rounds of a run with an aim: by stated rates, then by measured ones.

Stated rates are those of one core with AVX-512. The first round of a run is small and tells the machine's own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fields.sweep.passes import PASSES, passes_from
from survey import machine
from survey.folder.survey import Survey
from survey.plan.plan import Plan
from survey.plan.rates import FIRST_HYPOTHESES, STEPS_PER_CORE_S, poses_s
from survey.plan.workload import amounts_of

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

    # photographs_mpx, map_px: Of all photographs [Mpx], and of the views that get a height map [px]
    photographs_mpx: float
    map_px: float
    points: float  # One for each ground sampling distance squared that two views see
    poses: str  # "check", "refine" or "fixed": what is done with them first
    num_views: int

    @staticmethod
    def of(survey: Survey, plan: Plan) -> FullSizeAmounts:
        """Amounts of a survey whose poses are known, from its plan at another scale."""
        pixels, chosen, num_cells = amounts_of(survey, plan)
        per_scale = plan.image_scale**-2
        whole = sum(view.lens.width * view.lens.height for view in survey.views) / 1e6
        mapped = float(np.sum(pixels[chosen]))
        return FullSizeAmounts(whole, mapped * per_scale, num_cells * per_scale, plan.poses[0], len(survey.views))


def samples(amounts: FullSizeAmounts, scale: float, *, lowest: float, before: float | None = None) -> float:
    """Number of comparisons of a sweep at a scale: pixels x heights x neighbours.

    From the heights of a smaller scale, ``before``; or from nothing, with the whole bound searched at the ``lowest``.
    """
    if before is not None:
        passes = [p for p in PASSES if p.scale * scale > _FINER * before]
    else:
        passes = list(passes_from(lowest / scale))
    # The finer the first search, the more heights it tries.
    first = FIRST_HYPOTHESES / PASSES[0].scale
    steps = sum(p.scale**2 * (p.hypotheses or first * p.scale) * p.neighbours for p in passes)
    return steps * amounts.map_px * scale**2


@dataclass(frozen=True)
class RoundRates:
    """Time per unit of work on this machine."""

    sample_s: float  # Of the sweep [s]
    images_s: float  # Reading all photographs [s]
    slow: float  # How much longer the rest takes than on one core as stated
    point_s: float  # Of the solver [s]

    @staticmethod
    def stated(amounts: FullSizeAmounts, slow: float = 1.0) -> RoundRates:
        """Rates before the first measurement, on a machine that takes ``slow`` times as long as stated."""
        per_core = slow / machine.num_cores()
        images_s = slow * _DECODING_S * amounts.photographs_mpx
        return RoundRates(per_core / STEPS_PER_CORE_S, images_s, slow, _POINT_S * per_core)

    def after_sweep(self, seconds: float, num_samples: float, images_s: float) -> RoundRates:
        """Rates with the measured time [s] of a round's sweep and of reading its photographs."""
        sample_s = seconds / num_samples
        slow = max(self.slow * sample_s / self.sample_s, _FASTEST)
        return RoundRates(sample_s, images_s, slow, self.point_s * slow / self.slow)

    def after_solver(self, seconds: float, num_points: int) -> RoundRates:
        """Rates with the measured time [s] of the solver."""
        return replace(self, point_s=max(seconds - _SOLVER_S * self.slow, _OF_POINTS * seconds) / num_points)

    def sweep_s(self, amounts: FullSizeAmounts, scale: float, *, lowest: float, before: float | None = None) -> float:
        """Time [s] of a round's sweep and of reading its photographs; see `samples`."""
        return self.images_s + samples(amounts, scale, lowest=lowest, before=before) * self.sample_s

    def solver_s(self, amounts: FullSizeAmounts, scale: float) -> float:
        """Time [s] of the solver over all points."""
        return _SOLVER_S * self.slow + amounts.points * scale**2 * self.point_s

    def tail_s(self, amounts: FullSizeAmounts, scale: float) -> float:
        """Time [s] from the last round to the end of the run."""
        return (_TAIL_S[0] + _TAIL_S[1] * amounts.points * scale**2) * self.slow

    def least_s(self, amounts: FullSizeAmounts, scale: float, *, lowest: float) -> float:
        """Time [s] of a whole run whose only round is a sweep at a scale; see `samples`."""
        poses = poses_s(amounts.poses, amounts.photographs_mpx, amounts.num_views)
        before = (_START_S + poses + _RANGE_S) * self.slow
        return before + self.sweep_s(amounts, scale, lowest=lowest) + self.tail_s(amounts, scale)
