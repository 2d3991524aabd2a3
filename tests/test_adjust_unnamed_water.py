"""Water that nobody named, by blocks of tie points that are adjusted as if all ground were dry."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from slow_cases import slow

from survey.adjust.refine import adjust_survey
from survey.folder.survey import Survey
from tests.block_survey import survey_of
from tests.drawn_block import draw_block


def without_water(seed: int, **settings) -> Survey:
    block = draw_block(
        seed, num_points=250, num_views=16, nadir_only=False, num_control=0, pixel_std=0.3, height=25.0, **settings
    )
    survey = survey_of(block)
    return replace(survey, water=None, config=replace(survey.config, water=None))


def notes_of(survey: Survey) -> list[str]:
    return [text for text in adjust_survey(survey, use_windows=False).warnings if "show water" in text]


@pytest.mark.parametrize(("seed", "dry_share"), [(11, 0.4)])
def test_bent_rays_tell_of_water_over_a_part_of_the_ground(seed, dry_share):
    (text,) = notes_of(without_water(seed, dry_share=dry_share, depth=4.0))
    wet, total = (int(number) for number in re.search(r"(\d+) of (\d+) tie points fit better", text).groups())
    assert wet / total == pytest.approx(1.0 - dry_share, abs=0.2)
    before, after = (float(v) for v in re.search(r"\(([\d.]+) px on straight ones, ([\d.]+) px", text).groups())
    assert before >= after


@pytest.mark.parametrize("seed", [11, slow(12)])
def test_dry_ground_shows_no_water(seed):
    assert notes_of(without_water(seed, dry_share=1.0, depth=4.0)) == []
