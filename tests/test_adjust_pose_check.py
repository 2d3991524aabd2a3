"""Poses that are given as exact, held against a sample of photographs."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small_survey import replaced, small_survey

from refract import PinholeCamera
from survey.adjust.parameter_tests import misfit
from survey.adjust.pose_check import SAMPLE, _of_middle
from survey.errors import SurveyError
from survey.folder.survey import load_survey
from survey.photos.poses import TiePoints
from survey.plan.plan import MOST_MISFIT_PX, pose_choice
from survey.run.stage_start import MISFIT, use_misfit
from tests.changed_survey import changed


def ties_of(view: np.ndarray, pixel: np.ndarray | None = None) -> TiePoints:
    """Observations in photographs, at pixels, or all over them."""
    pixel = np.random.default_rng(3).uniform(0.0, 400.0, (len(view), 2)) if pixel is None else pixel
    return TiePoints(np.zeros((1, 3)), np.zeros(len(view), dtype=int), view, pixel)


def test_scatter_without_a_mean_over_a_photograph_is_no_misfit(rng):
    view = np.repeat(np.arange(10), 200)
    assert misfit(rng.normal(0.0, 0.3, (2000, 2)), ties_of(view)) < 0.03


def test_waves_as_long_as_a_photograph_are_no_misfit(rng):
    view, pixel = np.repeat(np.arange(40), 200), rng.uniform(0.0, 400.0, (8000, 2))
    shifts = 0.0
    for length in (300.0, 500.0, 700.0):
        turned = 2.0 * np.pi / length * pixel @ rng.normal(0.0, 1.0, (2, 1)) + rng.uniform(0.0, 7.0, (40, 1))[view]
        shifts = shifts + 0.3 * np.sin(turned)
    residuals = shifts + rng.normal(0.0, 0.1, (8000, 2))
    means = np.array([residuals[view == k].mean(axis=0) for k in range(40)])
    assert np.sqrt(np.mean(means**2)) > MOST_MISFIT_PX > misfit(residuals, ties_of(view, pixel))
    # A pose that is wrong by more than its waves is told.
    wrong = rng.normal(0.0, 0.7, (40, 2))[view]
    assert misfit(residuals + wrong, ties_of(view, pixel)) > 0.4
    # Nor does a wrong lens, which quarters of all photographs show alike, hide it.
    radial = (pixel - 200.0) * np.sum((pixel - 200.0) ** 2, axis=1, keepdims=True) / 2e7
    assert misfit(radial + rng.normal(0.0, 0.1, (8000, 2)) + wrong, ties_of(view, pixel)) > 0.6


def test_the_means_of_photographs_are_the_misfit_whatever_a_few_outliers_say(rng):
    view = np.repeat(np.arange(400), 50)
    residuals = rng.normal(0.0, 0.3, (400, 2))[view] + rng.normal(0.0, 0.1, (len(view), 2))
    residuals[::50] = 30.0
    # The root mean square of 800 deviates of 0.3 px is known to 2.5 %; five of these.
    assert misfit(residuals, ties_of(view)) == pytest.approx(0.3, rel=0.125)


def test_photographs_with_few_windows_tell_nothing():
    assert misfit(np.ones((9, 2)), ties_of(np.zeros(9, dtype=int))) is None


@pytest.mark.parametrize(
    ("found", "choice", "said"),
    [
        (None, "check", "unless photographs contradict them"),
        (-1.0, "fixed", "too few matches"),
        (0.5 * MOST_MISFIT_PX, "fixed", "they need no adjustment"),
        (2.0 * MOST_MISFIT_PX, "refine", "poses, lens and water are adjusted"),
    ],
)
def test_the_plan_follows_the_misfit(tmp_path, found, choice, said):
    survey = load_survey(small_survey(tmp_path / "s"))
    survey = changed(survey, views=survey.views * 4, pose_misfit_px=found)
    decided, reason = pose_choice(survey, "auto", free_water=False)
    assert (decided, said in reason) == (choice, True)


def test_few_views_are_taken_as_they_are(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s"))
    assert pose_choice(survey, "auto", free_water=False)[0] == "fixed"
    assert pose_choice(survey, "refine", free_water=False)[0] == "refine"


def test_a_readout_that_is_to_be_found_needs_an_adjustment(tmp_path):
    toml = replaced(("[water]", "rolling_shutter_s = 0.03\nrolling_shutter_std_s = 0.01\nspeed_m_s = 5\n[water]"))
    survey = load_survey(small_survey(tmp_path / "s", toml=toml))
    assert pose_choice(survey, "auto", free_water=False)[0] == "refine"
    assert pose_choice(survey, "fixed", free_water=False)[0] == "fixed"


def test_a_level_that_nobody_gave_cannot_be_kept(tmp_path):
    survey = changed(load_survey(small_survey(tmp_path / "s")), is_level_known=False)
    with pytest.raises(SurveyError, match="give level_m, or leave out --poses fixed"):
        pose_choice(survey, "fixed", free_water=False)


def test_photographs_that_look_at_the_middle_are_asked_wherever_they_stand(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s"))
    toward = np.linspace(0.0, 2.0 * np.pi, SAMPLE, endpoint=False)
    around = 20.0 * np.column_stack([np.cos(toward), np.sin(toward), np.ones(SAMPLE)])
    beside = np.array([[x, 0.0, 20.0] for x in (-7.0, -6.0, 6.0, 7.0)])
    cameras = [(at, -at) for at in around] + [(at, np.array([0.0, 0.0, -1.0])) for at in beside]
    views = tuple(replace(survey.views[0], camera=_looking(survey.views[0].camera, *each)) for each in cameras)
    assert _of_middle(replace(survey, views=views), 20.0) == list(range(SAMPLE))


def _looking(camera: PinholeCamera, centre: np.ndarray, ahead: np.ndarray) -> PinholeCamera:
    """The camera at another place, looking ahead."""
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, [0.3, 1.0, 0.0])
    right = right / np.linalg.norm(right)
    return replace(camera, centre=centre, cam_from_local=np.stack([right, np.cross(ahead, right), ahead]))


def test_a_level_under_which_all_is_dry_ends_the_run_where_photographs_show_water(tmp_path):
    flooded = {"name": "level_m", "given": 80.0, "given_std": 0.02, "difference": 4.213, "std": 0.03}
    found = {"misfit_px": 0.01, "contradictions": [], "flooded": flooded}
    (tmp_path / MISFIT).write_text(json.dumps(found), encoding="utf-8")
    with pytest.raises(SurveyError, match=r"level_m is 80\.000 m, which leaves all .* 84\.21 \+- 0\.03 m.*datum"):
        use_misfit(SimpleNamespace(), tmp_path)
