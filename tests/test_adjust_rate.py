"""The rate at which the water rises, found with poses, lens and level from photographs of different times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from block_state import state_of
from block_survey import survey_of
from drawn_block import DrawnBlock, draw_block

from survey.adjust.applied import apply_adjustment
from survey.adjust.block.prediction import apparent_rise_design, predict
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import read_adjustment, write_adjustment
from survey.adjust.result.std_common import common_error
from survey.settings.water import LevelRate
from survey.water.tides import Tide
from tests.changed_survey import changed

# The water rises by 0.3 m in the hour of the flight.
RATE, STD = 0.3, 1.0


def risen(block: DrawnBlock, hours: np.ndarray) -> DrawnBlock:
    """The block as it is seen through water that rises."""
    layout, state, ties = state_of(block)
    rise_design = np.zeros_like(apparent_rise_design(state, ties))
    moved, still = (predict(replace(layout, tides=tides), state, ties, rise_design) for tides in (RATE * hours, None))
    return replace(block, pixel=block.pixel + moved - still)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """A survey of rising water of which nearly nothing is given, and its adjustment."""
    block = draw_block(5, num_points=250, num_views=20, nadir_only=False, dry_share=0.2, num_control=6)
    hours = np.linspace(-0.5, 0.5, len(block.cameras))
    survey = survey_of(risen(block, hours))
    names = [view.name for view in survey.views]
    water = replace(survey.config.water, rate=LevelRate(0.0, STD))
    tide = Tide("level_rate_m_per_h", dict.fromkeys(names, 0.0), dict(zip(names, hours.tolist(), strict=True)))
    survey = changed(survey, config=replace(survey.config, water=water), tide=tide)
    folder = tmp_path_factory.mktemp("adjustment")
    write_adjustment(folder, adjust_survey(survey, use_windows=False))
    return survey, read_adjustment(folder)


def test_the_rate_is_found_within_what_is_stated(found):
    _, adjusted = found
    rate = adjusted.parameter("level_rate_m_per_h")
    assert rate.std < 0.2 * RATE
    assert abs(rate.value - RATE) < 3.0 * rate.std
    assert rate.verdict.startswith("found: 0.")
    assert "m/h (given 0.0" in rate.verdict
    assert adjusted.covariance.matrix.shape == (len(adjusted.covariance.names),) * 2
    assert adjusted.covariance.names.count("level_rate_m_per_h") == 1


def test_the_survey_goes_on_with_the_levels_that_were_found(found):
    survey, adjusted = found
    again = apply_adjustment(survey, adjusted)
    tides = np.array([view.camera.tide for view in again.views])
    np.testing.assert_allclose(tides, adjusted.parameter("level_rate_m_per_h").value * adjusted.poses.hours, atol=1e-12)
    assert again.observations.tide.moves_m == pytest.approx(np.ptp(tides))
    assert again.observations.tide.matters
    assert common_error(adjusted, again.water).typical < 0.2
