"""Tests of given values of water and lens against the photographs.

`check_given_values`
    Under poses that photographs confirm. Points follow a wrong level, and photographs agree under it as well as under
    the true one, to some thousandths of a pixel in the mean; the residuals of windows in many photographs reveal it.
    One Gauss-Newton step from the given values, with points and one parameter free: level, index, focal length or
    radial distortion. The others are as good as stated, or as those of an adjusted block. Where the given value is true
    the step is small, so that the test does not hang on how far the equations are linear. The one that is contradicted
    the most is the one that is wrong: errors of the others leave other residuals.
`worst_contradiction`
    Of the water, by an adjusted block.
`check_dry_bed`, `check_dry_block`
    Whether a given level leaves a bed dry that photographs show under water. A level in another vertical datum may be
    tens of metres too low. Where all rays are straight, no derivative tells of water any more; so the water is raised
    over the points, and the adjustment may bring it back to the dry bed or find it in between.
`unnamed_water_warning`
    Whether bent rays fit the tie points of a survey that names no water better. The block, adjusted with straight rays,
    is adjusted again over a plane of free level, with the index of water. Where the bed lies dry it gains nothing;
    where it lies under water the squares of residuals fall, as a tie point that photographs see from several sides has
    no one place on straight rays. Lens and poses are free in both. Colour, glint and smooth areas are not evidence:
    shade on a dry road is bluer than the lake beside it, dry dunes have larger areas without texture.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from evaluation.summary import std_by_median
from refract import FlatWater
from survey.adjust.block.bundle import NotConvergedError, Solution, cost, levenberg_marquardt, solve, with_points
from survey.adjust.block.normal_equations import huber_system
from survey.adjust.block.observed import Observed, sizes_of
from survey.adjust.block.priors import PriorKnowledge, prior_of, priors_for
from survey.adjust.block.problem import Problem, std_of_kinds
from survey.adjust.block.state import HELD_SHARE, LENS_NAMES, NUM_WATER, WATER_PARAMETERS, State, is_held
from survey.adjust.clusters import cluster_design_effect
from survey.adjust.common_height import water_start
from survey.adjust.observability import FEWEST_WET
from survey.adjust.result.adjustment import MOST_SIGMAS, MOST_SIGMAS_OF_FOUR, MOST_STD_INDEX
from survey.adjust.rounds import RobustSolution, adjust, std_over_points
from survey.errors import GivenValueTest, SurveyError
from survey.folder.local_frame import over_points
from survey.folder.pose_priors import BAROMETER_STD_M
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints
from survey.plan.plan import MOST_MISFIT_PX

# Tested parameters: of the water, and of each lens.
LEVEL, _INDEX = 0, NUM_WATER - 1
LEVEL_NAME, _INDEX_NAME = WATER_PARAMETERS[LEVEL], WATER_PARAMETERS[_INDEX]
_OF_LENS = tuple(LENS_NAMES.index(name) for name in ("f", "k1"))
# A focal length counts as wrong only beyond this share of it: small errors of poses look like one (docs/adjustment.md).
_FOCAL_SHARE = 0.001
# A rough bed looks as if the index were off by about so much (docs/adjustment.md).
_ROUGH_INDEX = 0.01
# Errors of poses [px]: a multiple of the misfit, as points follow a part of them; and the least.
_OF_MISFIT, _LEAST_PX = 2.0, 0.01
# With less of its own than this share of the knowledge beforehand, a block cannot contradict it.
_LEAST_OWN = 0.02
# Smaller standard deviations count as this one: beside 10 um of level, or 1e-5 of index, the step has no digits left.
_LEAST_STD = 1e-5
# Fewest windows of a photograph whose mean counts, and of a quarter of one.
_FEWEST_OF_VIEW, _FEWEST_OF_QUARTER = 10, 3
# Windows, each in many photographs; there are few of them where the level is far below the bed, as a pixel seems to
# cover more of it.
_FEWEST_WINDOWS = 10
# Fresh water and the sea, in the light of photographs, and how far they differ; what a river falls [m/m]; a level [m]
# that nobody knows.
_WATER_INDEX, _UNNAMED_STD = 1.338, (1000.0, 0.005, 0.005, 0.004)
# The gain in units of variances that is not chance: five standard deviations, of one more parameter and two starts.
_LEAST_GAIN = 30.0
# Least relative decrease of the residuals under water: real lenses and ground leave small systematic errors, too.
_LEAST_FALL = 0.03


def without_prior(number: int, prior_std: float, step: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Step (P,) and column (P,) of the covariance of a parameter, as they would be without its own prior.

    Of an adjustment with covariance C, leaving out a prior of standard deviation p adds ``c c' / (p^2 - C_kk)`` to C,
    with c the column of the parameter k (Sherman and Morrison 1950). The step is from the mean of that prior.
    """
    # Rounding leaves nothing smaller.
    share = max(1.0 - float(column[number]) / prior_std**2, float(np.finfo(np.float64).eps))
    return step + column * (step[number] / (share * prior_std**2)), column / share


def most_contradicted(tests: Sequence[GivenValueTest]) -> GivenValueTest | None:
    """The test with the largest difference in standard deviations, where that is beyond the bound."""
    worst = max(tests, key=lambda each: each.sigmas, default=None)
    return worst if worst is not None and worst.sigmas > MOST_SIGMAS_OF_FOUR else None


def check_given_values(
    survey: Survey, problem: Problem, state: State, misfit_px: float, gsd: float, *, fewest_wet: int = FEWEST_WET
) -> list[GivenValueTest]:
    """Tests of level, index and lenses of measured photographs, whose ``problem`` holds everything but points.

    Parameters that they do not determine are left out: of the water where fewer windows than ``fewest_wet`` are wet, or
    the index where its std exceeds the limit of use. ``state`` is the solution, ``misfit_px`` as of `misfit`, ``gsd``
    the ground sampling distance [m].
    """
    prior = prior_of(survey, gsd, free_water=True)
    std = prior.std.copy()
    std[:NUM_WATER] = prior_of(survey, gsd).std[:NUM_WATER]
    # Poses that explain the observed misfit.
    error_px = max(_OF_MISFIT * misfit_px, _LEAST_PX)
    turn = error_px / state.lenses[prior.layout.lens_of, 0]
    std[prior.layout.first_pose :] = np.column_stack([np.full((len(turn), 3), error_px * gsd), *[turn] * 3]).ravel()
    tested = _tested_parameters(prior, state, fewest_wet)
    focals = prior.layout.first_lens + np.arange(len(prior.lenses)) * len(LENS_NAMES)
    least = dict(zip(focals.tolist(), _FOCAL_SHARE * state.lenses[:, 0], strict=True))
    given, std[tested] = std.copy(), np.maximum(std[tested], _LEAST_STD)
    problem = replace(problem, priors=replace(priors_for(prior, problem.ties), state=state, std=std))
    std_px, sizes = std_of_kinds(problem, problem.residuals(state), 0.0), sizes_of(survey)
    system = huber_system(problem, state, std_px)
    factor = system.normal.factor()
    joint_step, joint_variance = factor.solve(system.right_side), factor.inverse_diagonal()
    tests = []
    for number in tested:
        unit = np.zeros(len(std))
        unit[number] = 1.0
        joint = factor.solve(unit)
        step, column = without_prior(number, float(std[number]), joint_step, joint)
        # Scatter about the estimate, since a wrong level is not noise.
        left = problem.residuals(state.moved(problem.layout, step, system.point_steps(step)))
        taken = np.delete(1.0 - (joint_variance + joint * column / std[number] ** 2) / std**2, number)
        after = std_of_kinds(problem, left, 1.0 + float(taken.sum()))
        shared = cluster_design_effect(problem.ties, left, after, problem.kind, sizes)
        variance = float(np.max(shared * (after / std_px)[problem.kind] ** 2)) * float(column[number])
        name, value = _name_and_value(survey, prior, number)
        given_std = max(float(given[number]), least.get(number, 0.0))
        own_std = math.hypot(variance**0.5, _ROUGH_INDEX if number == _INDEX else 0.0)
        tests.append(GivenValueTest(name, value, given_std, float(step[number]), own_std))
    return [each for each in tests if each.name != _INDEX_NAME or each.std <= np.hypot(MOST_STD_INDEX, _ROUGH_INDEX)]


def _tested_parameters(prior: PriorKnowledge, state: State, fewest_wet: int) -> list[int]:
    is_wet = state.water is not None and int((state.water.depth(state.points) > 0.0).sum()) >= fewest_wet
    starts = [prior.layout.lens(number).start for number, lens in enumerate(prior.lenses) if not is_held(lens)]
    return [*((LEVEL, _INDEX) if is_wet else ()), *(start + each for start in starts for each in _OF_LENS)]


def _name_and_value(survey: Survey, prior: PriorKnowledge, number: int) -> tuple[str, float]:
    if number < NUM_WATER:
        name = WATER_PARAMETERS[number]
        return name, float(getattr(survey.require_water()[1], name))
    lens, parameter = divmod(number - prior.layout.first_lens, len(LENS_NAMES))
    return f"camera{lens}.{LENS_NAMES[parameter]}", float(prior.state.lenses[lens, parameter])


def worst_contradiction(survey: Survey, done: RobustSolution) -> GivenValueTest | None:
    """The most contradicted of level, slopes and index, by standard deviations; None where none is.

    One that is wrong biases the others, so that only the worst is surely wrong: it is released, and the test repeated.
    """
    if survey.water is None:
        return None
    _, water = survey.require_water()
    tests, moved = [], done.solution.state.water_parameters() - done.prior.mean.water_parameters()
    for number, name in enumerate(WATER_PARAMETERS):
        prior_std, column = float(done.prior.std[number]), done.solution.covariance[:NUM_WATER, number]
        if prior_std > 10.0 * HELD_SHARE and prior_std**2 >= (1.0 + _LEAST_OWN) * column[number]:
            difference, own = (float(each[number]) for each in without_prior(number, prior_std, moved, column))
            tests.append(GivenValueTest(name, float(getattr(water, name)), prior_std, difference, own**0.5))
    return most_contradicted(tests)


def release(prior: PriorKnowledge, found: GivenValueTest) -> PriorKnowledge:
    """Priors with the contradicted value as uncertain as it proved to be."""
    std = prior.std.copy()
    std[WATER_PARAMETERS.index(found.name)] = max(abs(found.difference), found.given_std)
    return replace(prior, std=std)


def misfit(residuals: np.ndarray, ties: TiePoints) -> float | None:
    """Reprojection misfit under fixed poses [px], less its noise: see `PoseCheck`.

    ``residuals`` (N, 2) [px] are those of ties. Waves displace neighbours alike, those as long as a photograph all that
    it shows: the noise of a mean over a photograph is at least the variance of those over its quarters. What quarters
    have in common in all photographs is of the lens, not of waves.
    """
    squares, noises, quarters = [], [], []
    for number in np.unique(ties.view):
        chosen = (ties.view == number) & np.isfinite(residuals).all(axis=1)
        of_view, pixel = residuals[chosen], ties.pixel[chosen]
        if len(of_view) < _FEWEST_OF_VIEW:
            continue
        middle = np.median(of_view, axis=0)
        squares.append(middle**2)
        # The variance of a median is pi / 2 times that of a mean.
        noises.append(np.square(std_by_median(of_view - middle, axis=0)) * (0.5 * np.pi / len(of_view)))
        quarter = (pixel > np.median(pixel, axis=0)) @ (1, 2)
        if np.bincount(quarter, minlength=4).min() >= _FEWEST_OF_QUARTER:
            quarters.append([np.median(of_view[quarter == k], axis=0) for k in range(4)])
    if not squares:
        return None
    of_waves = 0.0
    if num := len(quarters):
        varied = np.array(quarters) - np.mean(quarters, axis=1, keepdims=True)
        common = varied.mean(axis=0) if num > 1 else 0.0
        of_waves = np.sum((varied - common) ** 2, axis=(0, 1)) / (3.0 * max(num - 1, 1))
    noise = np.maximum(noises, of_waves)
    return float(np.sqrt(max(float(np.mean(squares - noise)), 0.0)))


def check_dry_bed(survey: Survey, problem: Problem, state: State, gsd: float) -> GivenValueTest | None:
    """The level that photographs show where the given one leaves the bed dry; None where they show none.

    Parameters are those of `check_given_values`.
    """
    if not _is_dry(state):
        return None
    found = solve_with_level(problem, state.with_level(over_points(state.points, state.centres)), np.inf)
    missed = None if found is None else misfit(found.residuals, problem.ties)
    if found is None or missed is None or missed > MOST_MISFIT_PX:
        return None
    water = found.state.require_water()
    for each in check_given_values(survey, problem, found.state, missed, gsd, fewest_wet=_FEWEST_WINDOWS):
        depth = np.median(water.depth(found.state.points)) + each.difference
        if each.name == LEVEL_NAME and depth > MOST_SIGMAS * each.std:
            given = survey.require_water()[1].known_level_m
            raised_by = float(water.point[2] - state.require_water().point[2]) + each.difference
            return replace(each, given=given, difference=raised_by)
    return None


def solve_with_level(problem: Problem, start: State, level_std: float) -> Solution | None:
    """The solution with a level as free as its standard deviation [m] says; None where it does not converge."""
    std = problem.priors.std.copy()
    std[LEVEL] = level_std
    with suppress(NotConvergedError):
        return solve(replace(problem, priors=replace(problem.priors, std=std)), start)
    return None


def dry_bed_error(level: GivenValueTest, way_out: str) -> SurveyError:
    """Error of a level that leaves dry what photographs show under water, with a way out beside mending it."""
    return SurveyError(
        f"[water] level_m is {level.given:.3f} m, which leaves all of the bed dry, and the photographs show it under "
        f"water whose level is {level.found:.2f} +- {level.std:.2g} m; correct level_m in survey.toml, whose vertical "
        "datum has to be that of the poses (heights over the ellipsoid and over the geoid differ by up to 100 m), or "
        f"{way_out}"
    )


def check_dry_block(
    survey: Survey, prior: PriorKnowledge, seen: Observed, done: RobustSolution
) -> GivenValueTest | None:
    """The level that an adjusted block shows where the given one leaves all of it dry; None where it shows none.

    ``prior`` and ``seen``, all of it, are those that the block was adjusted with.
    """
    if not _is_dry(done.solution.state):
        return None
    std = prior.std.copy()
    std[LEVEL] = BAROMETER_STD_M
    free = replace(prior, std=std, common_up_std=BAROMETER_STD_M)
    with suppress(NotConvergedError):
        start, points = water_start(free, seen)
        wet = adjust(start, seen.at(points))
        water, covariance = wet.solution.state.require_water(), wet.solution.covariance
        over = float(np.median(water.depth(wet.solution.state.points)))
        if over > MOST_SIGMAS * std_over_points(wet.solution.system, covariance):
            given, level = survey.require_water()[1].known_level_m, float(np.sqrt(covariance[LEVEL, LEVEL]))
            raised = float(water.point[2]) - float(prior.mean.water_parameters()[LEVEL])
            return GivenValueTest(LEVEL_NAME, given, float(prior.std[LEVEL]), raised, level)
    return None


def _is_dry(state: State) -> bool:
    """Whether there is a water plane with no point below it."""
    return state.water is not None and not (state.water.depth(state.points) > 0.0).any()


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
    water, std = FlatWater((x, y, level), n_water=_WATER_INDEX), prior.std.copy()
    std[:NUM_WATER] = _UNNAMED_STD
    under = replace(prior, std=std, mean=replace(prior.mean, water=water))
    problem = replace(done.problem, priors=priors_for(under, seen.ties, seen.point_std))
    below = cost(done.problem, dry, std_px, shared) - _LEAST_GAIN
    start, _ = with_points(problem, replace(dry, water=water), dry.points, std_px, shared)
    wet, system = levenberg_marquardt(problem, start, std_px, shared, below=below)
    depth = wet.require_water().depth(wet.points)
    is_wet = depth > 0.0
    if is_wet.sum() < FEWEST_WET or cost(problem, wet, std_px, shared) > below:
        return None
    residuals = (each[is_wet[seen.ties.point]] for each in (done.solution.residuals, problem.residuals(wet)))
    before, after = (float(np.sqrt(np.mean(each**2))) for each in residuals)
    # The scatter about the block under water.
    of_depth = std_over_points(system) * after / before
    mean = float(depth[is_wet].mean())
    if mean < MOST_SIGMAS * of_depth or after > (1.0 - _LEAST_FALL) * before:
        return None
    return (
        f"the photographs show water: {int(is_wet.sum()):,} of {len(depth):,} tie points fit better on bent rays "
        f"({before:.2f} px on straight ones, {after:.2f} px on bent ones), {mean:.1f} +- {of_depth:.1g} m under its "
        "surface; give [water]"
    )
