"""Blocks of all kinds: few photographs, single strips, shallow and deep water, low and high flights."""

from __future__ import annotations

import numpy as np
import pytest

from survey.adjust.block.bundle import NotConvergedError
from survey.adjust.block.roll import rolls_of
from survey.adjust.observability import name_open_roll
from survey.adjust.refine import adjust_survey
from survey.errors import SurveyError
from tests.block_survey import pose_errors, rms, survey_of
from tests.drawn_block import draw_block

# Some with photographs that have nearly no matches, for which there was no solution once.
SEEDS = (4, 14, 22, 31, 47)
# Photographs in one line over level water, with neither control nor attitudes.
ONE_LINE = 26


def random_block(seed: int):
    rng = np.random.default_rng([seed, 77])
    num_views, nadir_only = int(rng.integers(6, 61)), bool(rng.random() < 0.5)
    height = float(rng.uniform(8.0, 60.0))
    depth = float(np.exp(rng.uniform(np.log(0.3), np.log(min(10.0, 0.5 * height)))))
    strip = bool(rng.random() < 0.4)
    return draw_block(
        seed, num_points=120, num_views=num_views, nadir_only=nadir_only, height=height, depth=depth, strip=strip
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_a_random_block_is_off_by_what_it_states_and_never_without_a_number(seed):
    block = random_block(seed)
    found = adjust_survey(survey_of(block), use_windows=False)
    for values in (
        found.poses.centres,
        found.poses.rotations,
        found.covariance.matrix,
        found.points,
        found.residuals.px,
    ):
        assert np.isfinite(values).all()
    positions, rotations = pose_errors(block, found.poses.centres, found.poses.rotations)
    # Errors of a block go together; the rms of 100 blocks over what is stated is 1.7 at most.
    assert rms(positions / found.poses.position_std) < 2.0
    assert rms(np.degrees(rotations) / found.poses.rotation_std_deg) < 2.5


def test_a_strip_whose_roll_level_water_alone_would_tell_is_refused_by_name():
    with pytest.raises(SurveyError, match=r"lie on one line, and neither control nor attitudes hold the roll about it"):
        adjust_survey(survey_of(random_block(ONE_LINE)), use_windows=False)


def test_where_a_strip_does_not_converge_the_line_is_named():
    rolls = rolls_of(survey_of(random_block(ONE_LINE)))
    assert rolls
    with (
        pytest.raises(NotConvergedError, match=r"lie on one line, .* \(no step\): give a control point"),
        name_open_roll(rolls),
    ):
        raise NotConvergedError("no step")
    with pytest.raises(NotConvergedError, match=r"^no step$"), name_open_roll(()):
        raise NotConvergedError("no step")
