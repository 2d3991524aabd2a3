"""What neighbouring ground shares in all photographs: residuals of drawn blocks tell it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from survey.adjust.bundle import Problem, Solution, solve
from survey.adjust.ground_clusters import shared_by_ground
from survey.adjust.prediction import predict, relief_sides
from survey.adjust.priors import known_of, priors_for
from tests.block_survey import survey_of
from tests.drawn_block import draw_block

NOISE_PX = 0.1
# Side of the squares of ground whose errors are alike [m]; a photograph shows 20 m.
SIDE_M = 1.5


def adjusted(seed: int, slope: float) -> tuple[Problem, Solution, list]:
    """A block over water whose surface has a slope of its own over each square of ground, the same in all views."""
    block = draw_block(seed, num_points=600, num_views=16, dry_share=0.0, num_control=0, height=20.0, depth=2.0)
    survey = survey_of(block)
    known = known_of(survey, 0.02)
    ties, water = survey.ties, known.state.water
    start = replace(known.state, points=ties.start)
    sides = relief_sides(start, ties)
    rng = np.random.default_rng([seed, 41])
    still = predict(known.layout, start, ties, sides)
    sloping = predict(known.layout, replace(start, water=replace(water, slope_x=water.slope_x + 0.01)), ties, sides)
    _, square = np.unique(np.floor(ties.start[:, :2] / SIDE_M), axis=0, return_inverse=True)
    slopes = slope * rng.standard_normal(square.max() + 1)[square.ravel()][ties.point]
    pixel = still + (sloping - still) * slopes[:, None] / 0.01 + NOISE_PX * rng.standard_normal(still.shape)
    ties = replace(ties, pixel=pixel)
    kind, given = np.zeros(len(pixel), dtype=int), np.array([np.nan])
    problem = Problem(known.layout, ties, kind, priors_for(known, ties), given, sides)
    lens = survey.views[0].lens
    return problem, solve(problem, start), [(lens.width, lens.height)] * len(survey.views)


def factor_of(seed: int, slope: float) -> float:
    problem, solution, sizes = adjusted(seed, slope)
    return shared_by_ground(problem, solution, sizes, np.ones(len(problem.kind), dtype=bool))


@pytest.mark.parametrize("seed", [0, 1])
def test_independent_errors_are_counted_once(seed):
    # The largest of three estimates, of up to some hundred squares each.
    assert 0.7 < factor_of(seed, 0.0) < 1.6


@pytest.mark.parametrize("seed", [0, 1])
def test_what_ground_shares_is_found_where_it_exceeds_the_noise_of_single_observations(seed):
    # Points follow most of what a slope does; what is left is a part of the noise.
    assert factor_of(seed, 0.2) > 3.0


def test_too_little_ground_tells_nothing():
    problem, solution, sizes = adjusted(0, 0.0)
    wide = [(100 * width, 100 * height) for width, height in sizes]
    assert shared_by_ground(problem, solution, wide, np.ones(len(problem.kind), dtype=bool)) == 1.0
