"""Blocks whose positions have an error in height in common: the level of the water says how high they lie."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array
from slow_cases import slow

from survey.adjust.block.normal_matrix import NormalMatrix
from survey.adjust.block.observed import MATCH, observed
from survey.adjust.block.priors import prior_of
from survey.adjust.block.state import NUM_POSE
from survey.adjust.common_height import apply_level_datum
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import Status
from survey.adjust.result.parts import common_error
from survey.adjust.rounds import RobustSolution, adjust
from survey.folder.local_frame import water_plane
from survey.folder.pose_priors import PosePrior
from survey.folder.survey import Survey
from survey.water.level_observation import LevelObservation
from tests.block_survey import ORIGIN, height_error, survey_of, with_shift
from tests.changed_survey import changed
from tests.drawn_block import DrawnBlock, draw_block

# Of a receiver without corrections, from photograph to photograph.
POSITION_STD_M = (0.3, 0.3, 0.15)


def bank_block(seed: int) -> DrawnBlock:
    """Obliques, and a bank: the bend of rays tells where the water is."""
    return draw_block(
        seed, num_points=180, num_views=18, nadir_only=False, dry_share=0.3, num_control=0, pixel_std=0.15,
        position_std=POSITION_STD_M, height=25.0, depth=2.5,
    )  # fmt: skip


def lifted(block: DrawnBlock, shift, common_up_std: float = 80.0) -> Survey:
    """The block as structure from motion puts it to positions that are off by a shift (3,) [m] in common."""
    return with_shift(survey_of(block), shift, common_up_std)


@pytest.mark.parametrize("up", [slow(1.5), 30.0, slow(-30.0)])
def test_heights_are_those_of_the_level_however_far_positions_are_off(up):
    block = bank_block(1)
    found = adjust_survey(lifted(block, (1.0, -2.0, up)), use_windows=False)
    common = common_error(found, water_plane(survey_of(block).frame, found.water))
    # The level is given with an error of its own: 4 cm, one sigma.
    assert abs(height_error(block, found)) < 4.0 * common.mean
    assert common.mean < 0.15
    level = found.parameter("level_m")
    assert level.status == Status.HELD
    assert level.value == pytest.approx(level.given, abs=1e-3)
    assert level.given == pytest.approx(ORIGIN[2] + block.stated_water[0])
    (said,) = (text for text in (*found.notes, *found.warnings) if "places the block" in text)
    metres, side = re.search(r"heights of positions are ([\d.]+) m too (low|high) ", said).groups()
    assert float(metres) * (1.0 if side == "high" else -1.0) == pytest.approx(up, abs=1.0)
    # A barometer may be off by so much, a receiver is not.
    assert (said in found.warnings) == (abs(up) > 10.0)


def test_a_block_that_hardly_tells_its_water_says_how_little_is_known():
    block = draw_block(
        1, num_points=200, num_views=16, nadir_only=True, dry_share=0.0, num_control=0, position_std=POSITION_STD_M
    )
    found = adjust_survey(lifted(block, (0.0, 0.0, 2.0)), use_windows=False)
    common = common_error(found, water_plane(survey_of(block).frame, found.water))
    assert common.mean > 0.05
    assert [text for text in found.warnings if f"all heights together are known to {common.mean:.2g} m only" in text]


@pytest.mark.slow
def test_a_common_error_is_within_what_is_stated_of_heights():
    scaled = []
    for seed in range(2, 6):
        block, rng = bank_block(seed), np.random.default_rng([seed, 50])
        found = adjust_survey(lifted(block, rng.normal(0.0, (1.5, 1.5, 10.0))), use_windows=False)
        common = common_error(found, water_plane(survey_of(block).frame, found.water))
        scaled.append(height_error(block, found) / common.mean)
    # Four numbers of unit variance have a root mean square under 2.45 but once in 10,000 times.
    assert np.sqrt(np.mean(np.square(scaled))) < 2.45


def test_positions_that_share_nothing_hold_the_block_against_the_level():
    block = bank_block(1)
    found = adjust_survey(lifted(block, (0.0, 0.0, 1.5), common_up_std=0.0), use_windows=False)
    assert height_error(block, found) > 0.7


def inverse(matrix: np.ndarray) -> np.ndarray:
    """The inverse of a symmetric matrix whose rows have different units."""
    return NormalMatrix.of(csr_array(matrix)).inverse


def adjusted(survey: Survey) -> RobustSolution:
    prior = prior_of(survey, 0.02)
    return adjust(prior, observed([(MATCH, survey.observations.ties)], None, survey, prior))


@pytest.mark.parametrize("common_up_std", [80.0, 0.3])
def test_the_covariance_is_that_of_a_block_with_the_error_as_one_more_unknown(common_up_std):
    block = draw_block(3, num_points=120, num_views=10, dry_share=0.3, num_control=0, position_std=POSITION_STD_M)
    survey = lifted(block, (0.0, 0.0, 0.8), common_up_std)
    done = adjusted(survey)
    placed, common = apply_level_datum(done)
    size, of_level = len(done.prior.layout), prior_of(lifted(block, (0.0, 0.0, 0.8), 0.0), 0.02).std[0] ** 2
    of_error = common_up_std**2
    unit = np.zeros(size + 1)
    unit[0] = 1.0
    # All that is known but for the level, which is that of the block less the error, and the error itself.
    information = np.zeros((size + 1, size + 1))
    information[:size, :size] = inverse(done.solution.covariance)
    information -= np.outer(unit, unit) / (of_level + of_error)
    error = np.zeros(size + 1)
    error[-1] = 1.0
    information += np.outer(unit - error, unit - error) / of_level + np.outer(error, error) / of_error
    covariance = inverse(information)
    heights = np.zeros(size)
    heights[0], heights[done.prior.layout.first_pose + 2 :: NUM_POSE] = 1.0, 1.0
    lower = np.column_stack([np.eye(size), -heights])
    expected = lower @ covariance @ lower.T
    std = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        placed.solution.covariance / np.outer(std, std), expected / np.outer(std, std), atol=1e-5
    )
    assert common.std == pytest.approx(np.sqrt(covariance[-1, -1]), rel=1e-5)
    # Of the mean: the level that photographs see less the given one, by what each is known to.
    seen = done.solution.state.water_parameters()[0] - done.prior.mean.water_parameters()[0]
    assert common.error == pytest.approx(of_error / (of_error + of_level) * seen, rel=1e-9)
    assert placed.prior.std[0] ** 2 == pytest.approx(of_level)


def test_residuals_stay_when_a_block_is_lowered():
    block = bank_block(4)
    done = adjusted(lifted(block, (0.0, 0.0, 3.0)))
    placed, _ = apply_level_datum(done)
    before, after = done.solution.state, placed.solution.state
    assert np.ptp(before.points[:, 2] - after.points[:, 2]) < 1e-9
    np.testing.assert_allclose(after.water.depth(after.points), before.water.depth(before.points), atol=1e-9)
    np.testing.assert_allclose(
        after.centres - placed.prior.mean.centres, before.centres - done.prior.mean.centres, atol=1e-9
    )


def test_what_holds_the_heights_leaves_no_common_error():
    block = draw_block(1, num_points=150, num_views=16, dry_share=0.3, num_control=6)
    survey = lifted(block, (0.0, 0.0, 0.0))
    assert survey.observations.control is not None
    assert prior_of(survey, 0.02).common_up_std == 0.0
    free = changed(survey, control=None)
    assert prior_of(free, 0.02).common_up_std == 80.0
    assert prior_of(free, 0.02, free_water=True).common_up_std == 0.0
    assert prior_of(changed(free, is_level_known=False), 0.02).common_up_std == 0.0
    checks = tuple(replace(point, is_check=True) for point in survey.observations.control.points)
    only_checks = changed(survey, control=replace(survey.observations.control, points=checks))
    assert prior_of(only_checks, 0.02).common_up_std == 80.0
    name = survey.views[0].name
    fixed = {**free.observations.priors, name: replace(free.observations.priors[name], common_up_std=0.0)}
    assert prior_of(changed(free, priors=fixed), 0.02).common_up_std == 0.0
    clicks = (LevelObservation(100.0, 0.02, ORIGIN[:2], None, "clicks"),)
    assert prior_of(changed(free, levels=clicks), 0.02).common_up_std == 0.0


def test_single_positions_are_as_good_as_the_block_shows_however_large_their_common_error_is():
    survey = lifted(draw_block(1, num_points=150, num_views=16, dry_share=0.3, num_control=0), (0.0, 0.0, 0.0))
    stated = {
        name: replace(prior, position_std=np.array([3.0, 3.0, 80.0]))
        for name, prior in survey.observations.priors.items()
    }
    assert prior_of(changed(survey, priors=stated), 0.02).unknown_positions.all()
    assert not prior_of(changed(survey, priors=stated, is_level_known=False), 0.02).unknown_positions.any()


@pytest.mark.slow
def test_a_level_that_is_found_is_as_high_as_positions_that_may_be_off():
    survey = lifted(bank_block(2), (0.0, 0.0, 0.0))
    found = adjust_survey(survey, use_windows=False, free_water=True)
    assert [text for text in found.warnings if "which may have a common error of 80 m" in text]
    known = adjust_survey(survey, use_windows=False)
    assert not [text for text in known.warnings if "common error of" in text]
    exact = draw_block(2, num_points=200, num_views=16, dry_share=0.3, num_control=0)
    corrected = adjust_survey(lifted(exact, (0.0, 0.0, 0.0)), use_windows=False, free_water=True)
    assert not [text for text in corrected.warnings if "common error of" in text]


def test_positions_that_prove_good_hold_the_block_where_some_photographs_have_none():
    block = draw_block(5, num_points=150, num_views=18, dry_share=0.3, num_control=0, position_std=(0.02, 0.02, 0.03))
    survey = lifted(block, (0.0, 0.0, 0.0))
    name = survey.views[3].name
    survey = changed(survey, priors={**survey.observations.priors, name: PosePrior(None, None, None, "none")})
    found = adjust_survey(survey, use_windows=False)
    assert found.common_up_m is None
    # The level of the block, to centimetres, by positions.
    assert found.poses.position_std[3, 2] < 0.1


@pytest.mark.parametrize("up", [2.0, slow(30.0)])
def test_check_points_tell_the_error_of_a_block_that_positions_put_elsewhere(up):
    block = draw_block(
        1, num_points=180, num_views=18, nadir_only=False, dry_share=0.3, num_control=6, pixel_std=0.15,
        position_std=POSITION_STD_M, height=25.0, depth=2.5,
    )  # fmt: skip
    survey = lifted(block, (0.0, 0.0, up))
    checks = tuple(replace(point, is_check=True) for point in survey.observations.control.points)
    found = adjust_survey(
        changed(survey, control=replace(survey.observations.control, points=checks)), use_windows=False
    )
    assert len(found.control) == len(checks)
    common = common_error(found, water_plane(survey.frame, found.water))
    assert abs(height_error(block, found)) < 4.0 * common.mean
    assert abs(np.median([row.residual_m[2] for row in found.control])) < 4.0 * common.mean
