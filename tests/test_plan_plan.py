"""What a plan says, which parts follow from its options, and between which heights a bed is looked for."""

import pytest
from small_survey import TOML, small_survey

from survey.errors import SurveyError
from survey.folder.survey import load_survey
from survey.plan.area import limits
from survey.plan.choices import RECIPES, Choices, required_views
from survey.plan.plan import make_plan

FLYING_M = 20.0


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


@pytest.mark.parametrize(
    ("white", "expected"),
    [
        ((), (4, 1)),
        # A few white pixels ask for no more; half of all for twice as many.
        ((0.0, 0.1), (4, 1)),
        ((0.4, 0.6), (8, 2)),
        ((1.0, 1.0), (40, 10)),
    ],
)
def test_photographs_that_are_partly_white_ask_for_as_many_more(white, expected):
    assert required_views(white, RECIPES["draft"].times_seen) == expected


def test_a_bed_deeper_than_the_cameras_fly_high_is_looked_for_and_a_bank_nearly_as_high_as_them(tmp_path):
    low, high = limits(load_survey(small_survey(tmp_path / "s")))
    assert low < -1.2 * FLYING_M
    assert 0.75 * FLYING_M < high < FLYING_M


def test_dry_ground_is_looked_for_below_the_cameras(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s", toml=TOML[: TOML.index("[water]")]))
    low, high = limits(survey)
    assert low < high < survey.views[0].camera.centre[2]


def test_limits_are_heights_over_a_plane_wherever_its_point_lies(tmp_path):
    near = limits(load_survey(small_survey(tmp_path / "a")))
    moved = TOML.replace("level_at = [589012", "level_at = [589112")
    far = limits(load_survey(small_survey(tmp_path / "b", toml=moved)))
    # 100 m of level water fall 0.8 mm.
    assert far == pytest.approx(near, abs=2e-3)
