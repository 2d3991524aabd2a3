"""What a plan leaves out where a scene does not need it: kernels with and without it give the same heights."""

from __future__ import annotations

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, match, ring
from small_survey import small_survey

from fields.skips import NOTHING, SKIPS
from fields.sweep.kernels.stack import ViewStack
from refract import FlatWater
from survey.errors import SurveyError
from survey.folder.survey import load_survey
from survey.plan.choices import Choices
from survey.plan.plan import make_plan

BEDS = {
    "wet": PlaneBed(TILTED, -2.0),
    "dry": PlaneBed(None, -2.0),
    "index one": PlaneBed(FlatWater((0.0, 0.0, 0.0), n_water=1.0), -2.0),
}


@pytest.mark.parametrize("bed", BEDS.values(), ids=BEDS.keys())
def test_heights_are_the_same_with_terms_that_the_scene_does_not_need(device, bed):
    cameras, step, count = ring(6), 0.04, 9
    images = [bed.photograph(camera) for camera in cameras]
    start = (bed.true_height(cameras[0]) - step * (count // 2)).astype(np.float32)
    found = []
    for skips in (SKIPS, NOTHING):
        stack = ViewStack.build(device, cameras, images, bed.water, skips)
        found.append(match(stack, [1, 2, 3, 4, 5, 6], start, step, count, 2))
    near = np.abs(found[0][0] - found[1][0]) < 0.05 * step
    assert near.mean() > 0.98
    assert np.abs(found[0][1] - found[1][1])[near].max() < 0.01


def test_rays_stay_straight_in_water_of_index_one_unless_all_is_asked_for(device):
    bed, cameras = BEDS["index one"], ring(2)
    images = [bed.photograph(camera) for camera in cameras]
    indices = [
        ViewStack.build(device, cameras, images, bed.water, skips).kernel_water.n_water for skips in (SKIPS, NOTHING)
    ]
    assert indices == [None, 1.0]


def test_the_plan_says_what_is_left_out(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s"))
    usual, draft = (make_plan(survey, Choices(device="cpu", quality=quality)) for quality in ("standard", "draft"))
    assert usual.skips == SKIPS
    choices = {each.name: each.choice for each in usual.decisions}
    assert (choices["terms of the lens"], choices["finer passes"]) == ("none", "pixels that become points")
    assert (usual.refines_points_only, draft.refines_points_only) == (True, False)


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
