"""What an adjusted block that lies askew or beside its place does to heights, over slopes and level ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjusted_block import drawn_adjustment
from block_survey import survey_of

from survey.adjust.std_of_block import slopes_of, std_of_block

GSD = 0.05


def plane(slope_x: float) -> np.ndarray:
    """Points of a sloped bed under the middle of a drawn block."""
    x, y = np.meshgrid(np.linspace(-4.0, 4.0, 81), np.linspace(-4.0, 4.0, 81))
    return np.stack([x, y, -2.0 + slope_x * x], axis=-1).reshape(-1, 3)


def std_by(step: dict[str, float], bed: np.ndarray) -> np.ndarray:
    """Std of a bed where only this change of parameters, by their last names, is uncertain."""
    block, found = drawn_adjustment(dry_share=0.0)
    change = np.array([step.get(name.rpartition(".")[2], 0.0) for name in found.covariance_names])
    survey = replace(survey_of(block), ties=None)
    return std_of_block(bed, survey, replace(found, covariance=np.outer(change, change)), GSD)


def test_what_lifts_all_heights_alike_is_no_part_of_it():
    assert std_by({"z": 0.025, "height_m": 0.025}, plane(0.2)).max() < 1e-4


@pytest.mark.parametrize("slope", [0.0, 0.2, -0.5])
def test_a_block_beside_its_place_shows_other_heights_where_the_bed_slopes(slope):
    std = std_by({"x": 0.1}, plane(slope))
    # The water of the block is level but for a rise of some millimetres per metre.
    np.testing.assert_allclose(std, 0.1 * abs(slope), atol=1e-3)


def test_slopes_are_those_of_the_bed_and_noise_of_single_heights_averages_out(rng):
    bed = plane(0.3)
    bed[:, 2] += 0.02 * rng.standard_normal(len(bed))
    slopes = slopes_of(bed, 1.0)
    # The fewest are 121 heights of 2 cm at a corner, in 1 m x 1 m: 6 mm per metre; five of these.
    np.testing.assert_allclose(slopes, np.tile([0.3, 0.0], (len(bed), 1)), atol=0.03)
    far = np.concatenate([bed, [[1e4, 1e4, 0.0]]])
    assert np.isfinite(slopes_of(far, 0.1)).all()
