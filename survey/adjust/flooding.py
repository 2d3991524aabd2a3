"""Whether photographs show the bed under water where the level that is given leaves all of it dry.

A level in another vertical datum may be tens of metres too low. Where all rays are straight, no derivative tells of
water any more; so the water is raised over the windows, and the adjustment, with poses and lens as given, may bring it
back to the dry bed or find it in between.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from refract import FlatWater
from survey.adjust.bundle import NotConvergedError, Problem, solve
from survey.adjust.contradiction import MOST
from survey.adjust.given_check import LEVEL, told_of_given
from survey.adjust.misfit import misfit
from survey.adjust.state import State
from survey.folder.doubt import Doubt
from survey.folder.survey import Survey
from survey.plan.poses import MOST_MISFIT_PX

# The water is raised over most of the windows, and on by this share of the distance to the cameras.
_COVERED, _SHARE = 0.95, 0.1
# Windows, each in many photographs; there are few of them where the level is far below the bed, as a pixel seems to
# cover more of it.
_FEWEST = 10


def level_over(survey: Survey, problem: Problem, state: State, gsd: float) -> Doubt | None:
    """The level that photographs ask for, in place of one under which all is dry; None where they do not.

    Parameters
    ----------
    survey : Survey
        Of the photographs that were measured.
    problem : Problem
        Of their windows, with everything held but points.
    state : State
        Its solution.
    gsd : [m]
        Ground sampling distance.
    """
    if state.water is None or (state.water.depth(state.points) > 0.0).any():
        return None
    over = -state.water.depth(state.points)
    distance = float(np.median(state.centres[:, 2]) - np.median(state.points[:, 2]))
    step, std = np.zeros(len(problem.priors.std)), problem.priors.std.copy()
    step[LEVEL], std[LEVEL] = np.quantile(over, _COVERED) + _SHARE * distance, np.inf
    raised = state.moved(problem.layout, step, np.zeros_like(state.points))
    with suppress(NotConvergedError):
        found = solve(replace(problem, holds_parameters=False, priors=replace(problem.priors, std=std)), raised)
        missed = misfit(found.residuals, problem.ties.view)
        if missed is None or missed > MOST_MISFIT_PX:
            return None
        for each in told_of_given(survey, problem, found.state, missed, gsd, fewest_wet=_FEWEST):
            depth = np.median(_water(found.state).depth(found.state.points)) + each.difference
            if each.number == LEVEL and depth > MOST * each.std:
                given = survey.require_water()[1].known_level_m
                raised_by = float(_water(found.state).point[2] - state.water.point[2]) + each.difference
                return Doubt("level_m", given, each.given_std, given + raised_by, each.std)
    return None


def _water(state: State) -> FlatWater:
    assert state.water is not None
    return state.water
