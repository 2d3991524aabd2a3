"""What an adjusted block that lies askew or beside its place does to heights, over slopes and level ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjusted_block import drawn_adjustment
from block_survey import survey_of

from survey.adjust.std_of_block import std_of_block

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


def test_a_block_far_beside_its_place_shows_heights_that_have_nothing_to_do_with_those_there():
    x, y = np.meshgrid(np.linspace(-4.0, 4.0, 161), np.linspace(-4.0, 4.0, 161))
    wave = 0.05 * np.sin(np.pi * x)
    std = std_by({"x": 1.0}, np.stack([x, y, -2.0 + wave], axis=-1).reshape(-1, 3)).reshape(x.shape)
    # Slopes would have it 0.16 m halfway up and nothing on top. The difference to a wave of any phase is its own square
    # and the mean one. Cells of 0.1 m flatten the wave by 1 %, and show it up to 0.05 m beside a point: by an
    # eighth of its height at most.
    expected = np.sqrt(wave**2 + 0.5 * 0.05**2)
    inside = (np.abs(x) < 1.0) & (np.abs(y) < 2.0)
    np.testing.assert_allclose(std[inside], expected[inside], atol=0.15 * 0.05)
