"""Covariance of a block with a free level, where points near it may be wet or dry.

What a level does to the rays of a point begins at the surface: the derivative jumps. Points that lie just above a level
that was found have none, and tell the level against the wet ones all the better; were it a little higher, they would
tell nothing. Over a bed that is wet all over, photographs may tell the level to no better than a metre, and the
adjustment ends where the first points come dry, with a standard deviation of centimetres. So the normal equations are
taken with the water raised by two standard deviations, until these no longer grow.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from survey.adjust.bundle import Problem, Solution, System, inverse, system_with
from survey.adjust.state import with_parameters

_RAISED, _MOST_STEPS = 2.0, 6
# The level is as uncertain as it was, to this share.
_STEADY = 0.1


def covariance_over_shore(problem: Problem, solution: Solution) -> np.ndarray:
    """Covariance (P, P) of the parameters, that of the solution where no point is near the surface.

    Parameters
    ----------
    problem : Problem
    solution : Solution
        Of the problem; its weights are kept.
    """
    system, covariance, state = solution.system, solution.covariance, solution.state
    std = std_over_points(system, covariance)
    for _ in range(_MOST_STEPS):
        parameters = state.water_parameters()
        parameters[0] += _RAISED * std
        raised = replace(state, water=with_parameters(state.water, parameters))
        system = system_with(problem, raised, solution.weights)
        again = inverse(system.normal)
        before, std = std, std_over_points(system, again)
        if std <= (1.0 + _STEADY) * before:
            break
        covariance = again
    return covariance


def std_over_points(system: System, covariance: np.ndarray) -> float:
    """Standard deviation [m] of the height of the water over the points, in the mean."""
    depth = -system.heights_by_parameters()
    depth[0] += 1.0
    return float(np.sqrt(depth @ covariance @ depth))
