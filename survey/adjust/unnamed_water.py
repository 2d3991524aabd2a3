"""Test for water that survey.toml does not name: whether bent rays fit the tie points better.

The block is adjusted with straight rays, and again over a water plane that was not given: its level is free, its index
that of water. Where the bed lies dry the second adjustment gains nothing. Where it lies under water the squares of
residuals fall: a tie point that photographs see from several sides has no one place on straight rays. Lens and poses
are free in both, so that what they can take of the bend does not count.

Colour, glint and smooth areas of the photographs are not evidence. Shade on a dry road is bluer than the lake beside it
(8.7 against 0.7 % of a photograph, at most), a dry street has more saturated pixels (0.7 against 0.04 %), and dry dunes
larger areas without texture (47 against 19 %).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from refract import FlatWater
from survey.adjust.block.bundle import NotConvergedError, cost, levenberg_marquardt, with_points
from survey.adjust.block.priors import priors_for
from survey.adjust.observability import FEWEST_WET
from survey.adjust.rounds import RobustSolution, std_over_points
from survey.folder.local_frame import over_points

# Fresh water and the sea, in the light of photographs, and how far they differ; what a river falls [m/m].
_INDEX, _INDEX_STD, _SLOPE_STD = 1.338, 0.004, 0.005
# Of a level that nobody knows [m].
_LEVEL_STD_M = 1000.0
# The gain in units of variances that is not chance: five standard deviations, of one more parameter and two starts.
_LEAST_GAIN = 30.0
# Least relative decrease of the residuals under water: real lenses and ground leave small systematic errors, too.
_LEAST_FALL = 0.03
# A mean depth is significant from so many standard deviations on.
_SURE = 3.0


def unnamed_water_warning(done: RobustSolution) -> str | None:
    """Warning of water that a block adjusted without any shows; None where it shows none, or is not decisive."""
    dry = done.solution.state
    if dry.water is not None or len(done.used.ties) < FEWEST_WET:
        return None
    for level in (over_points(dry.points, dry.centres), float(np.median(dry.points[:, 2]))):
        with suppress(NotConvergedError):
            found = _water_at(done, level)
            if found is not None:
                return found
    return None


def _water_at(done: RobustSolution, level: float) -> str | None:
    """Warning of water found from a level; None where bent rays gain too little, or too little of it is sure."""
    prior, seen, dry = done.prior, done.used, done.solution.state
    std_px, shared = done.problem.given_std_px, done.variance_factor
    x, y = dry.centres[:, :2].mean(axis=0).tolist()
    water, std = FlatWater((x, y, level), n_water=_INDEX), prior.std.copy()
    std[:4] = [_LEVEL_STD_M, _SLOPE_STD, _SLOPE_STD, _INDEX_STD]
    under = replace(prior, std=std, mean=replace(prior.mean, water=water))
    problem = replace(done.problem, priors=priors_for(under, seen.ties, seen.point_std))
    below = cost(done.problem, dry, std_px, shared) - _LEAST_GAIN
    start, _ = with_points(problem, replace(dry, water=water), dry.points, std_px, shared)
    wet, system = levenberg_marquardt(problem, start, std_px, shared, below=below)
    depth = wet.require_water().depth(wet.points)
    is_wet = depth > 0.0
    if is_wet.sum() < FEWEST_WET or cost(problem, wet, std_px, shared) > below:
        return None
    is_wet_tie = is_wet[seen.ties.point]
    before, after = (
        float(np.sqrt(np.mean(each[is_wet_tie] ** 2))) for each in (done.solution.residuals, problem.residuals(wet))
    )
    # The scatter about the block under water.
    of_depth = std_over_points(system) * after / before
    mean = float(depth[is_wet].mean())
    if mean < _SURE * of_depth or after > (1.0 - _LEAST_FALL) * before:
        return None
    return (
        f"the photographs show water: {int(is_wet.sum()):,} of {len(depth):,} tie points fit better on bent rays "
        f"({before:.2f} px on straight ones, {after:.2f} px on bent ones), {mean:.1f} +- {of_depth:.1g} m under its "
        "surface; give [water]"
    )
