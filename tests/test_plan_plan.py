"""What a plan says, and which parts follow from its options."""

from __future__ import annotations

import pytest
from small_survey import small_survey

from survey.errors import SurveyError
from survey.folder.survey import load_survey
from survey.plan.choices import Choices
from survey.plan.plan import make_plan


def test_a_draft_leaves_the_solver_out(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s"))
    usual, draft = (make_plan(survey, Choices(device="cpu", quality=quality)) for quality in ("standard", "draft"))
    assert (usual.solves, draft.solves) == (True, False)


def test_images_are_worked_on_at_the_scale_that_is_asked_for_if_it_is_halvings(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s"))
    whole, half = (make_plan(survey, Choices(device="cpu", image_scale=scale)) for scale in (None, 0.5))
    assert (whole.image_scale, half.image_scale) == (1.0, 0.5)
    assert half.gsd_m == pytest.approx(2.0 * whole.gsd_m)
    assert "set by --image-scale" in next(d.reason for d in half.decisions if d.name == "image scale")
    with pytest.raises(SurveyError, match=r"image-scale is 0.3, expected one of 1, 0.5, 0.25"):
        make_plan(survey, Choices(device="cpu", image_scale=0.3))


@pytest.mark.parametrize(
    ("options", "boxes", "said"),
    [
        ({}, True, "beside depth steps with holes"),
        ({"field": "boxes"}, True, "beside depth steps with holes"),
        ({"field": "boxes", "quality": "draft"}, True, "beside depth steps with holes"),
        ({"field": "solver"}, False, None),
        ({"field": "off"}, False, None),
        ({"quality": "draft"}, False, None),
    ],
)
def test_boxes_come_with_the_solver_unless_it_is_set(tmp_path, options, boxes, said):
    plan = make_plan(load_survey(small_survey(tmp_path / "s")), Choices(device="cpu", **options))
    assert plan.boxes == boxes
    assert plan.field == "solver" or not boxes
    assert {d.name: d.choice for d in plan.decisions}.get("boxes") == said
