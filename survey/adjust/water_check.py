"""Whether photographs contradict the level or the index of water that is given, under poses that they bear out.

Heights follow a wrong level, and photographs agree under it as well as under the true one, to some thousandths of a
pixel in the mean. What is left in the residuals of windows that many photographs show tells it all the same. One step
of the adjustment is taken from what is given, in which points and level are free (or points and index, the level as
good as stated), poses as good as photographs bear them out, and the lens that of an adjusted block. Where the given
value is true the step is small, so that the test does not hang on how far the equations are linear.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from survey.adjust.bundle import Problem, System, inverse, std_of_kinds, system_at
from survey.adjust.clusters import inflation
from survey.adjust.contradiction import MOST, Contradiction
from survey.adjust.free_water import FEWEST_WET
from survey.adjust.priors import known_of, priors_for
from survey.adjust.state import WATER, Layout, State
from survey.adjust.water_settings import WATER_PARAMETERS
from survey.folder.survey import Survey
from survey.folder.water_doubt import WaterDoubt

# Level and index among the parameters of the water.
_ASKED = (0, WATER - 1)
# Errors of poses [px]: a multiple of the misfit, as points follow a part of them; and the least.
_OF_MISFIT, _LEAST_PX = 1.5, 0.01


def water_doubt(survey: Survey, told: list[Contradiction]) -> WaterDoubt | None:
    """The one of level and index that is contradicted the most, if any: a wrong level looks like a wrong index, too."""
    beyond = [(abs(each.difference) / np.hypot(each.std, each.given_std), each) for each in told]
    beyond = [(sigmas, each) for sigmas, each in beyond if sigmas > MOST]
    if not beyond:
        return None
    most = max(beyond, key=lambda pair: pair[0])[1]
    name = WATER_PARAMETERS[most.number]
    given = float(getattr(survey.require_water()[1], name))
    return WaterDoubt(name, given, most.given_std, given + most.difference, most.std)


def told_of_water(survey: Survey, problem: Problem, state: State, misfit_px: float, gsd: float) -> list[Contradiction]:
    """What photographs say of level and of index, whether they contradict it or not.

    Nothing where too little lies under water to tell.

    Parameters
    ----------
    survey : Survey
        Of the photographs that were measured.
    problem : Problem
        Of their windows, with everything held but points.
    state : State
        Its solution.
    misfit_px : [px]
        See `survey.adjust.pose_check.misfit`.
    gsd : [m]
        Ground sampling distance.
    """
    if state.water is None or int((state.water.depth(state.points) > 0.0).sum()) < FEWEST_WET:
        return []
    known = known_of(survey, gsd, free_water=True)
    std = known.std.copy()
    std[:WATER] = np.inf
    std[known.layout.first_pose :] = _pose_std(known.layout, state, misfit_px, gsd)
    problem = replace(problem, priors=replace(priors_for(known, problem.ties), state=state, std=std))
    std_px = std_of_kinds(problem, problem.residuals(state), 0.0)
    system = system_at(problem, state, std_px)
    sizes = [(view.lens.width, view.lens.height) for view in survey.views]
    given = known_of(survey, gsd).std[:WATER]
    return [_told(problem, state, system, std_px, number, given, sizes) for number in _ASKED]


def _told(
    problem: Problem, state: State, system: System, std_px: np.ndarray, number: int, given: np.ndarray, sizes
) -> Contradiction:
    """What a step says of one parameter of the water, the others as good as given (4,)."""
    std = problem.priors.std.copy()
    std[:WATER] = np.where(np.arange(WATER) == number, np.inf, given)
    strength = np.zeros(len(std))
    strength[:WATER] = std[:WATER] ** -2.0
    covariance = inverse(system.normal + np.diag(strength))
    step = covariance @ system.right
    # The scatter is that about what was found: a wrong level is no noise.
    left = problem.residuals(state.moved(problem.layout, step, system.point_steps(step)))
    taken = float(np.sum(1.0 - np.diag(covariance) / std**2))
    after = std_of_kinds(problem, left, taken)
    shared = inflation(problem.ties, left, after, problem.kind, sizes)
    factor = float(np.max(shared * (after / std_px)[problem.kind] ** 2))
    return Contradiction(
        number, float(step[number]), (factor * covariance[number, number]) ** 0.5, float(given[number])
    )


def _pose_std(layout: Layout, state: State, misfit_px: float, gsd: float) -> np.ndarray:
    """Standard deviations (6 V,) of poses: errors that move what photographs show by about as much as they miss."""
    error_px = max(_OF_MISFIT * misfit_px, _LEAST_PX)
    turn = error_px / state.lenses[layout.lens_of, 0]
    return np.column_stack([np.full((len(turn), 3), error_px * gsd), *[turn] * 3]).ravel()
