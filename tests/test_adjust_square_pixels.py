"""Focal lengths of two sides that a program found with straight rays: pixels are square, whatever it took them for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from refract.lens import Lens
from survey.adjust.focal_lengths import with_square_pixels
from survey.adjust.refine import adjust_survey
from survey.folder.pose_priors import BY_POSES, PosePrior
from tests.block_survey import survey_of
from tests.changed_survey import changed
from tests.drawn_block import draw_block

RATIO, PIXEL_STD = 1.005, 0.1


def stretched(survey, ratio: float, tool: str | None):
    """The survey with exact poses of a file and focal lengths whose ratio is off."""
    views = []
    for view in survey.views:
        f, lens = view.camera.fx, view.lens
        params = (f, ratio * f, lens["cx"], lens["cy"], *(lens[name] for name in ("k1", "k2", "p1", "p2")))
        other = Lens("OPENCV", params, lens.width, lens.height)
        views.append(replace(view, lens=other, camera=replace(view.camera, fx=f, fy=ratio * f)))
    priors = {view.name: PosePrior(view.camera.centre, np.full(3, 0.02), None, BY_POSES) for view in views}
    return changed(survey, views=tuple(views), priors=priors, tool=tool)


@pytest.fixture(scope="module")
def block():
    return draw_block(3, num_points=200, num_views=18, num_control=0, height=20.0, depth=2.0, pixel_std=PIXEL_STD)


def test_two_focal_lengths_of_straight_rays_become_one(block):
    found, note = with_square_pixels(stretched(survey_of(block), RATIO, "a program"))
    for view in found.views:
        assert view.lens.focal[0] == view.lens.focal[1] == view.camera.fx == view.camera.fy
        assert view.lens.focal[0] == pytest.approx(0.5 * (1.0 + RATIO) * survey_of(block).views[0].camera.fx)
    assert note is not None
    assert note.startswith("pixels are taken as square: a program found focal lengths of ")


@pytest.mark.parametrize(("ratio", "tool", "wet"), [(RATIO, None, True), (RATIO, "a program", False),
                                                    (1.0, "a program", True), (1.5, "a program", True)])  # fmt: skip
def test_stated_lenses_dry_surveys_and_pixels_of_another_shape_stay(block, ratio, tool, wet):
    survey = stretched(survey_of(block), ratio, tool)
    survey = survey if wet else replace(survey, water=None)
    assert with_square_pixels(survey) == (survey, None)


def test_photographs_agree_whatever_ratio_straight_rays_had(block):
    found = adjust_survey(stretched(survey_of(block), RATIO, "a program"), use_windows=False)
    held = adjust_survey(stretched(survey_of(block), RATIO, None), use_windows=False)
    focal = found.parameter("camera0.f")
    # Four standard deviations: one draw in 16,000 is further off.
    assert abs(focal.value - block.lens.focal[0]) < 4.0 * focal.std
    assert found.statistics.std_px["matches"] == pytest.approx(PIXEL_STD, rel=0.2)
    # The ratio moves a pixel at the edge of the photograph by 1.5; what of it no pose and lens takes is over the noise.
    assert held.statistics.std_px["matches"] > 1.5 * PIXEL_STD
    assert any(text.startswith("pixels are taken as square") for text in found.notes)
