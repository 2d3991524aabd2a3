"""Test for bed under water where the given level leaves the whole bed dry.

A level in another vertical datum may be tens of metres too low. Where all rays are straight, no derivative tells of
water any more; so the water is raised over the points, and the adjustment, with poses and lens as given or as uncertain
as they are, may bring it back to the dry bed or find it in between.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from refract import FlatWater
from survey.adjust.bundle import NotConvergedError, Problem, solve
from survey.adjust.common_height import water_start
from survey.adjust.contradiction import MOST
from survey.adjust.given_check import LEVEL, LEVEL_NAME, told_of_given
from survey.adjust.misfit import misfit
from survey.adjust.observed import Observed
from survey.adjust.priors import Known
from survey.adjust.rounds import Adjusted, adjust
from survey.adjust.shore_side import std_over_points
from survey.adjust.state import State
from survey.errors import SurveyError
from survey.folder.contradiction import Contradiction
from survey.folder.pose_priors import BAROMETER_STD_M
from survey.folder.survey import Survey
from survey.plan.poses import MOST_MISFIT_PX

# The water is raised over most of the windows, and on by this share of the distance to the cameras.
_COVERED, _SHARE = 0.95, 0.1
# Windows, each in many photographs; there are few of them where the level is far below the bed, as a pixel seems to
# cover more of it.
_FEWEST = 10


def level_over(survey: Survey, problem: Problem, state: State, gsd: float) -> Contradiction | None:
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
            if each.name == LEVEL_NAME and depth > MOST * each.std:
                given = survey.require_water()[1].known_level_m
                raised_by = float(_water(found.state).point[2] - state.water.point[2]) + each.difference
                return replace(each, given=given, difference=raised_by)
    return None


def dry_bed_error(level: Contradiction, way_out: str) -> SurveyError:
    """What ends a run whose level leaves dry what photographs show under water, with a way out beside mending it."""
    return SurveyError(
        f"[water] level_m is {level.given:.3f} m, which leaves all of the bed dry, and the photographs show it under "
        f"water whose level is {level.found:.2f} +- {level.std:.2g} m; correct level_m in survey.toml, whose vertical "
        "datum has to be that of the poses (heights over the ellipsoid and over the geoid differ by up to 100 m), or "
        f"{way_out}"
    )


def level_over_block(
    survey: Survey, known: Known, seen: Observed, done: Adjusted, marks_std_px: float
) -> Contradiction | None:
    """The level that an adjusted block asks for, in place of one under which all of it is dry; None where it does not.

    Parameters
    ----------
    survey : Survey
    known : Known
        What the block was adjusted with.
    seen : Observed
        All of it.
    done : Adjusted
        The block.
    marks_std_px : float
        As for `survey.adjust.rounds.adjust`.
    """
    dry = done.solution.state
    if dry.water is None or (dry.water.depth(dry.points) > 0.0).any():
        return None
    std = known.std.copy()
    std[0] = BAROMETER_STD_M
    free = replace(known, std=std, common_up_std=BAROMETER_STD_M)
    with suppress(NotConvergedError):
        start, points = water_start(free, seen, marks_std_px)
        wet = adjust(
            start, seen.at(points), [(view.lens.width, view.lens.height) for view in survey.views], marks_std_px
        )
        water, covariance = _water(wet.solution.state), wet.solution.covariance
        over = float(np.median(water.depth(wet.solution.state.points)))
        if over > MOST * std_over_points(wet.solution.system, covariance):
            given, level = survey.require_water()[1].known_level_m, float(np.sqrt(covariance[0, 0]))
            raised = float(water.point[2]) - float(known.mean.water_parameters()[0])
            return Contradiction(LEVEL_NAME, given, float(known.std[0]), raised, level)
    return None


def _water(state: State) -> FlatWater:
    assert state.water is not None
    return state.water
