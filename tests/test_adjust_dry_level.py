"""Blocks with free poses whose level, of another datum, leaves all of the bed dry."""

from __future__ import annotations

import re

import numpy as np
import pytest

from survey.adjust.refine import adjust_survey
from survey.errors import SurveyError
from tests.block_survey import ORIGIN, survey_of, with_water
from tests.drawn_block import DrawnBlock, draw_block


def block(seed: int, dry_share: float) -> DrawnBlock:
    return draw_block(
        seed, num_points=200, num_views=16, nadir_only=False, dry_share=dry_share, num_control=0, pixel_std=0.15,
        height=25.0, depth=2.5,
    )  # fmt: skip


def lowered(drawn: DrawnBlock, down: float):
    return with_water(survey_of(drawn), level_m=ORIGIN[2] + float(drawn.water[0]) - down)


@pytest.mark.parametrize("down", [6.0, 45.0])
def test_the_level_that_photographs_show_is_named(down):
    missed = []
    for seed in range(2):
        drawn = block(seed, 0.3)
        with pytest.raises(SurveyError, match=r"leaves all of the bed dry.*or leave out \[water\] if") as error:
            adjust_survey(lowered(drawn, down), use_windows=False)
        found, std = map(float, re.search(r"level is ([\d.]+) \+- ([\d.]+) m", str(error.value)).groups())
        assert std < 0.3
        # The text has centimetres.
        missed.append((found - ORIGIN[2] - float(drawn.water[0])) / np.hypot(std, 0.005))
    assert np.abs(missed).max() < 4.5


def test_a_block_that_is_dry_stays_so():
    for seed in range(2):
        drawn = block(seed, 1.0)
        found = adjust_survey(lowered(drawn, 8.0), use_windows=False)
        assert found.parameter("level_m").value == pytest.approx(ORIGIN[2] + float(drawn.water[0]) - 8.0)
