"""Poses of a file that are too far off for windows: found anew, and brought to where the file says that they are."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from survey.adjust.refine import adjust_survey
from survey.adjust.starts import RecoveredPoses, _align, recover_poses, windows_or_recovered_poses
from survey.errors import SurveyError
from survey.folder.survey import load_survey
from survey.photos.poses import TiePoints
from survey.simulate.drawn import DrawnScene, draw_survey
from tests.changed_survey import changed

VIEWS = SimpleNamespace(views=range(10))
ANEW = RecoveredPoses(None, None, None)


def windows_in(views: int) -> TiePoints:
    """Eight windows in each of the first views."""
    view = np.repeat(np.arange(views), 8)
    return TiePoints(np.zeros((len(view), 3)), np.arange(len(view)), view, np.zeros((len(view), 2)))


def raising(text):
    def fail(*_):
        raise SurveyError(text)

    return fail


def test_windows_in_nine_of_ten_photographs_are_taken_and_nothing_is_sought():
    windows = windows_in(9)
    assert windows_or_recovered_poses(VIEWS, lambda: windows, raising("sought")) is windows


@pytest.mark.parametrize("measure", [lambda: windows_in(8), raising("only 3 thumbnail pixels match")])
def test_photographs_without_windows_are_sought_anew(measure):
    found = windows_or_recovered_poses(VIEWS, measure, lambda _survey: ANEW)
    assert isinstance(found, RecoveredPoses)
    assert "off by more than a few pixels" in found.warning
    assert "8 of 10 photographs" in found.warning or "3 thumbnail pixels" in found.warning


def test_windows_in_most_photographs_do_where_the_search_fails_and_in_few_the_poses_are_refused():
    windows = windows_in(6)
    assert windows_or_recovered_poses(VIEWS, lambda: windows, raising("no overlap")) is windows
    refused = r"in 5 of 10 photographs only, and structure from motion.*no overlap.*--poses fixed"
    with pytest.raises(SurveyError, match=refused):
        windows_or_recovered_poses(VIEWS, lambda: windows_in(5), raising("no overlap"))


def test_without_a_search_windows_are_what_they_are():
    windows = windows_in(2)
    assert windows_or_recovered_poses(VIEWS, lambda: windows, None) is windows


def test_a_strip_of_poses_is_turned_scaled_and_shifted_to_given_ones(rng):
    centres = np.column_stack([np.arange(12.0), np.zeros(12), np.zeros(12)])
    rotations = Rotation.from_rotvec(rng.normal(0.0, 0.3, (12, 3))).as_matrix()
    turn, scale, shift = Rotation.from_rotvec([0.4, -0.9, 0.2]).as_matrix(), 3.0, np.array([5.0, -2.0, 40.0])
    given = scale * centres @ turn.T + shift
    given[4] += (0.0, 30.0, 0.0)
    wrong = Rotation.from_rotvec(rng.normal(0.0, 0.01, (12, 3))).as_matrix()
    found = _align(centres, rotations, given, wrong @ rotations @ turn.T)
    # Twelve turns of 0.01 rad average to 0.003 each way; one wrong position of twelve shifts a median little.
    assert Rotation.from_matrix(found.rotation @ turn.T).magnitude() < 0.015
    assert found.scale == pytest.approx(scale, rel=0.5)
    assert np.linalg.norm(found(centres)[5:7].mean(axis=0) - given[5:7].mean(axis=0)) < 0.5


@pytest.mark.slow
def test_poses_off_by_several_pixels_are_found_within_what_is_stated(tmp_path, rng):
    scene = DrawnScene(
        size_m=(3.6, 3.0), depth_m=1.2, num_views=12, image_px=(320, 240), focal_px=500.0, flying_m=8.0, noise=1.0
    )
    draw_survey(tmp_path / "s", scene)
    true = load_survey(tmp_path / "s")
    # Fifteen pixels by position, nine by rotation.
    std_m, std_rad = 0.25, 0.018
    views, priors = [], {}
    for view in true.views:
        centre = view.camera.centre + std_m * rng.standard_normal(3)
        turn = Rotation.from_rotvec(std_rad * rng.standard_normal(3)).as_matrix()
        camera = replace(view.camera, centre=centre, cam_from_local=turn @ view.camera.cam_from_local)
        views.append(replace(view, camera=camera))
        stds = {"position_std": np.full(3, std_m), "rotation_std_deg": np.full(3, np.degrees(std_rad))}
        priors[view.name] = replace(true.observations.priors[view.name], position=centre, source="survey.toml", **stds)
    off = changed(true, views=tuple(views), priors=priors)

    found = adjust_survey(
        off, device="cpu", search=lambda survey: recover_poses(survey, tmp_path / "sfm", lambda _: None)
    )
    assert "Structure from motion has estimated them again" in found.warnings[0]
    # What is left is an error of the block as a whole: by as much as twelve poses leave, three standard deviations.
    left = 3.0 * np.sqrt(3.0 / 12.0)
    whole = np.array([view.camera.centre for view in true.views]) - found.poses.centres
    assert np.linalg.norm(whole.mean(axis=0)) < left * std_m
    true_rotations = np.array([view.camera.cam_from_local for view in true.views])
    turns = Rotation.from_matrix(true_rotations.transpose(0, 2, 1) @ found.poses.rotations)
    assert turns.magnitude().max() < left * std_rad
