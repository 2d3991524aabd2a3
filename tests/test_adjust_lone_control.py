"""One control point alone, held against the block that positions and water place without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from block_survey import survey_of
from drawn_block import draw_block

from survey.adjust.lone_control import is_lone
from survey.adjust.refine import adjust_survey
from survey.folder.pose_priors import PosePrior
from survey.folder.survey import Survey

SAID = "have another place for control: gcp0 by "


def with_one_point(seed: int, off=(0.0, 0.0, 0.0), num_marks: int | None = None) -> Survey:
    """A block with GPS good to 2 cm and one control point, its coordinates off by so much."""
    survey = survey_of(draw_block(seed, num_points=150, num_views=18, dry_share=0.35, num_control=1))
    (point,) = survey.control.points
    point = replace(point, local=point.local + np.array(off))
    return replace(survey, control=replace(survey.control, points=(point,), marks=survey.control.marks[:num_marks]))


@pytest.mark.parametrize("num_marks", [1, None])
def test_a_wrong_point_that_moves_the_block_is_named(num_marks):
    found = adjust_survey(with_one_point(3, (1.0, -0.5, 0.0), num_marks), use_windows=False)
    words = " ".join(found.warnings)
    # A point with marks enough to be judged is left out, and one with a single mark moves the block.
    assert SAID in words or "control point that the block contradicts, its coordinates left out: gcp0" in words
    if num_marks == 1:
        # Where the block has it, less its coordinates.
        assert f"{SAID}-1.0" in words or f"{SAID}-0.9" in words


def test_a_right_point_is_not():
    assert not any(SAID in warning for warning in adjust_survey(with_one_point(3), use_windows=False).warnings)


def test_only_control_that_cannot_check_itself_is_asked_about_and_only_where_positions_place_the_block():
    survey = with_one_point(3)
    assert is_lone(survey)
    assert not is_lone(replace(survey, control=None))
    nowhere = {view.name: PosePrior(None, None, None, "none") for view in survey.views}
    assert not is_lone(replace(survey, priors=nowhere))
    many = survey_of(draw_block(3, num_points=150, num_views=18, dry_share=0.35, num_control=3))
    assert not is_lone(many)
