"""The benchmark of surveys drawn at random: a seed is a survey, and what it adds is in the drawing."""

from __future__ import annotations

from dataclasses import replace

import bench_random as bench
import numpy as np
import pytest

from survey.simulate.drawn import DrawnScene, stage_drawing


def test_a_seed_is_always_the_same_survey_and_another_seed_another():
    drawn = [str(bench.RandomSurvey.of(seed)) for seed in range(40)]
    assert drawn == [str(bench.RandomSurvey.of(seed)) for seed in range(40)]
    assert len(set(drawn)) == 40
    assert {word for word in bench.CHANGES for text in drawn if f"then {word}" in text} == set(bench.CHANGES)


def test_relief_goes_on_below_that_of_other_drawn_beds():
    random = bench.RandomSurvey(replace(DrawnScene.tiny(), cell_m=0.0125), 2.0, 0.0, None, 0.0)
    plain = stage_drawing(random.scene).renderer.ground.bed
    added = random._staged().renderer.ground.bed.heights - plain.heights
    # Spacings of 10, 5, 2.5 and 1.25 cm, each by a tenth of it.
    assert added.std() == pytest.approx(0.1 * np.hypot(np.hypot(0.1, 0.05), np.hypot(0.025, 0.0125)), rel=0.3)
