"""Whether photographs contradict poses that are given as exact: a sample of windows, with nothing adjusted but points.

Poses, lens and water that are exact leave residuals with no mean over a photograph. Errors of a pose move all that its
photograph shows in one direction; what points can follow of them does no harm to the bed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from survey.adjust.bundle import Problem, solve
from survey.adjust.far_poses import Search
from survey.adjust.observed import KINDS, MATCH, WINDOW, observed, rows_taken
from survey.adjust.prediction import relief_sides
from survey.adjust.priors import HELD, known_of, priors_for
from survey.adjust.windows_of_survey import measure_windows
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.photos.tie_points import TiePoints
from survey.plan.plan import make_plan

# So many photographs in the middle of the block are looked at; with fewer in all there is nothing to sample.
SAMPLE = 10
# Fewest windows of a photograph whose mean counts.
_FEWEST = 10


def pose_misfit(
    survey: Survey, *, device: str = "auto", advance: Callable[[float], None], search: Search | None = None
) -> float | None:
    """By how much photographs miss each other under the given poses, lens and water [px], per coordinate.

    The root mean square over photographs of the mean residual of their windows, less what the scatter of the windows
    explains. Where no windows match, as under poses that are off by more than a few pixels, it is that of the
    features of all photographs, found by ``search``. None where too little matches to tell.
    """
    sample = replace(survey, views=_middle(survey), ties=None)
    found = _under_given(sample, WINDOW, lambda: measure_windows(sample, device=device, advance=advance))
    if found is None and search is not None:
        found = _under_given(replace(survey, ties=None), MATCH, lambda: search(survey).ties)
    return found


def _under_given(survey: Survey, kind: int, measure: Callable[[], TiePoints]) -> float | None:
    """See `pose_misfit`, by tie points of a kind; None where there are none."""
    try:
        ties = measure()
    except SurveyError:
        return None
    if not len(ties):
        return None
    known = known_of(survey, make_plan(survey).gsd_m)
    seen = observed([(kind, ties)], None, survey, known)
    held = replace(known, std=np.full_like(known.std, HELD))
    state = replace(known.state, points=seen.ties.start)
    priors, sides = priors_for(held, seen.ties), relief_sides(state, seen.ties)
    rows = rows_taken(seen.ties, known.lenses, known.layout.lens_of)
    problem = Problem(known.layout, seen.ties, seen.kind, priors, np.full(len(KINDS), np.nan), sides, rows)
    return misfit(solve(problem, state).residuals, seen.ties.view)


def misfit(residuals: np.ndarray, view: np.ndarray) -> float | None:
    """See `pose_misfit`: of residuals (N, 2) [px] of observations in photographs (N,)."""
    squares = []
    for number in np.unique(view):
        mine = residuals[(view == number) & np.isfinite(residuals).all(axis=1)]
        if len(mine) < _FEWEST:
            continue
        middle = np.median(mine, axis=0)
        # The variance of a median is pi / 2 times that of a mean.
        noise = np.square(1.4826 * np.median(np.abs(mine - middle), axis=0)) * (0.5 * np.pi / len(mine))
        squares.append(middle**2 - noise)
    return float(np.sqrt(max(float(np.mean(squares)), 0.0))) if squares else None


def _middle(survey: Survey) -> tuple:
    """The views nearest to the middle of the block, in their order."""
    centres = np.array([view.camera.centre[:2] for view in survey.views])
    away = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    return tuple(survey.views[i] for i in np.sort(np.argsort(away, kind="stable")[:SAMPLE]))
