"""Tests of given water and lens against the photographs, under poses that they confirm.

Points follow a wrong level, and photographs agree under it as well as under the true one, to some thousandths of a
pixel in the mean. What is left in the residuals of windows that many photographs show tells it all the same. One step
of the adjustment is taken from what is given, in which points and one parameter are free: level, index, focal length or
radial distortion. The others are as good as stated, or as those of an adjusted block; poses are as good as photographs
bear them out. Where the given value is true the step is small, so that the test does not hang on how far the equations
are linear. The one that is contradicted the most is the one that is wrong: errors of the others leave other residuals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from survey.adjust.bundle import Problem, System, inverse, std_of_kinds, system_at
from survey.adjust.clusters import inflation
from survey.adjust.contradiction import MOST_OF_FOUR
from survey.adjust.free_water import FEWEST_WET
from survey.adjust.priors import Known, is_held, known_of, priors_for
from survey.adjust.state import LENS_NAMES, WATER, Layout, State
from survey.adjust.verdicts import MOST_STD_INDEX
from survey.adjust.water_settings import WATER_PARAMETERS
from survey.folder.contradiction import Contradiction
from survey.folder.survey import Survey

# What is asked: of the water, and of each lens.
LEVEL, _INDEX = 0, WATER - 1
LEVEL_NAME, _INDEX_NAME = WATER_PARAMETERS[LEVEL], WATER_PARAMETERS[_INDEX]
_OF_LENS = tuple(LENS_NAMES.index(name) for name in ("f", "k1"))
# A focal length counts as wrong only beyond this share of it: small errors of poses look like one (docs/adjustment.md).
_FOCAL_SHARE = 0.001
# A rough bed looks as if the index were off by about so much (docs/adjustment.md).
_ROUGH_INDEX = 0.01
# Errors of poses [px]: a multiple of the misfit, as points follow a part of them; and the least.
_OF_MISFIT, _LEAST_PX = 2.0, 0.01


def most_contradicted(told: Sequence[Contradiction]) -> Contradiction | None:
    """The parameter that photographs contradict the most, if any; ``told`` as `told_of_given` has it."""
    worst = max(told, key=lambda each: each.sigmas, default=None)
    return worst if worst is not None and worst.sigmas > MOST_OF_FOUR else None


def told_of_given(
    survey: Survey, problem: Problem, state: State, misfit_px: float, gsd: float, *, fewest_wet: int = FEWEST_WET
) -> list[Contradiction]:
    """What photographs say of level, index and lenses, whether they contradict it or not.

    Without what they do not tell: of water that little lies under, of an index that is of no use.

    Parameters
    ----------
    survey : Survey
        Of the photographs that were measured.
    problem : Problem
        Of their windows, with everything held but points.
    state : State
        Its solution.
    misfit_px : [px]
        See `survey.adjust.misfit.misfit`.
    gsd : [m]
        Ground sampling distance.
    fewest_wet : int
        Windows under water, with which level and index are asked for.
    """
    known = known_of(survey, gsd, free_water=True)
    std = known.std.copy()
    std[:WATER] = known_of(survey, gsd).std[:WATER]
    std[known.layout.first_pose :] = _pose_std(known.layout, state, misfit_px, gsd)
    asked = _asked(known, state, fewest_wet)
    given = {number: float(std[number]) for number in asked}
    focals = known.layout.first_lens + np.arange(len(known.lenses)) * len(LENS_NAMES)
    least = dict(zip(focals.tolist(), _FOCAL_SHARE * state.lenses[:, 0], strict=True))
    std[asked] = np.inf
    problem = replace(problem, priors=replace(priors_for(known, problem.ties), state=state, std=std))
    std_px = std_of_kinds(problem, problem.residuals(state), 0.0)
    system = system_at(problem, state, std_px)
    sizes = [(view.lens.width, view.lens.height) for view in survey.views]
    told = []
    for number in asked:
        name, value = _name_and_value(survey, known, number)
        given_std = max(given[number], least.get(number, 0.0))
        told.append(Contradiction(name, value, given_std, *_told(problem, state, system, std_px, given, number, sizes)))
    return [each for each in told if each.name != _INDEX_NAME or each.std <= np.hypot(MOST_STD_INDEX, _ROUGH_INDEX)]


def _asked(known: Known, state: State, fewest_wet: int) -> list[int]:
    """Numbers of the parameters that photographs are asked for."""
    is_wet = state.water is not None and int((state.water.depth(state.points) > 0.0).sum()) >= fewest_wet
    starts = [known.layout.lens(number).start for number, lens in enumerate(known.lenses) if not is_held(lens)]
    return [*((LEVEL, _INDEX) if is_wet else ()), *(start + each for start in starts for each in _OF_LENS)]


def _told(
    problem: Problem,
    state: State,
    system: System,
    std_px: np.ndarray,
    given: Mapping[int, float],
    number: int,
    sizes: list[tuple[int, int]],
) -> tuple[float, float]:
    """Difference to what is given and standard deviation that a step finds for one parameter, all others as given."""
    std = problem.priors.std.copy()
    others = [each for each in given if each != number]
    std[others] = [given[each] for each in others]
    strength = np.zeros(len(std))
    strength[others] = std[others] ** -2.0
    covariance = inverse(system.normal + np.diag(strength))
    step = covariance @ system.right
    # The scatter is that about what was found: a wrong level is no noise.
    left = problem.residuals(state.moved(problem.layout, step, system.point_steps(step)))
    taken = float(np.sum(1.0 - np.diag(covariance) / std**2))
    after = std_of_kinds(problem, left, taken)
    shared = inflation(problem.ties, left, after, problem.kind, sizes)
    factor = float(np.max(shared * (after / std_px)[problem.kind] ** 2))
    variance = factor * float(covariance[number, number]) + (_ROUGH_INDEX**2 if number == _INDEX else 0.0)
    return float(step[number]), float(np.sqrt(variance))


def _pose_std(layout: Layout, state: State, misfit_px: float, gsd: float) -> np.ndarray:
    """Standard deviations (6 V,) of poses: errors that move what photographs show by about as much as they miss."""
    error_px = max(_OF_MISFIT * misfit_px, _LEAST_PX)
    turn = error_px / state.lenses[layout.lens_of, 0]
    return np.column_stack([np.full((len(turn), 3), error_px * gsd), *[turn] * 3]).ravel()


def _name_and_value(survey: Survey, known: Known, number: int) -> tuple[str, float]:
    """Of a parameter, as the survey gives it."""
    if number < WATER:
        name = WATER_PARAMETERS[number]
        return name, float(getattr(survey.require_water()[1], name))
    lens, parameter = divmod(number - known.layout.first_lens, len(LENS_NAMES))
    return f"camera{lens}.{LENS_NAMES[parameter]}", float(known.state.lenses[lens, parameter])
