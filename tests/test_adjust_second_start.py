"""Two photographs placed by control are adjusted from a level start, too, and the better solution is used."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from survey.adjust.block.priors import prior_of
from survey.adjust.starts import better_of_two_starts
from tests.block_survey import drawn_adjustment, survey_of
from tests.changed_survey import changed

TURN = Rotation.from_euler("xyz", (17.0, 6.0, 0.0), degrees=True).as_matrix()


@pytest.fixture
def pair():
    """A survey of two photographs that are turned aside, what is known of it, and its adjustment."""
    block, found = drawn_adjustment(3, num_views=16, num_points=300, num_control=6, dry_share=0.4)
    survey = survey_of(block)
    views = tuple(
        replace(v, camera=replace(v.camera, cam_from_local=v.camera.cam_from_local @ TURN.T)) for v in survey.views[:2]
    )
    ties = replace(survey.observations.ties, least=2)
    survey = changed(survey, views=views, ties=ties.only(ties.view < 2))
    names = [point.name for point in survey.observations.control.points]
    control = tuple(replace(found.control[0], name=name) for name in names[:2])
    rotations, std = np.array([view.camera.cam_from_local for view in views]), np.full((2, 3), 1.0)
    poses = replace(found.poses, centres=found.poses.centres[:2], rotations=rotations, rotation_std_deg=std)
    found = replace(found, control=control, poses=poses)
    return survey, prior_of(survey, 0.02), found


def fits(found, ratio: float):
    """The adjustment with other residuals of its windows."""
    std_px = {name: ratio * std if name == "windows" else std for name, std in found.statistics.std_px.items()}
    return replace(found, statistics=replace(found.statistics, std_px=std_px))


def seconds(found, ratio: float, starts: list):
    def adjusted(survey, prior):
        starts.append((survey, prior))
        again = fits(found, ratio)
        return replace(again, poses=replace(again.poses, rotations=prior.state.rotations))

    return adjusted


@pytest.mark.parametrize(
    ("ratio", "is_second", "is_said"), [(0.8, True, False), (1.2, False, False), (0.999, True, True)]
)
def test_the_solution_that_fits_better_is_used_and_one_that_fits_as_well_is_said(pair, ratio, is_second, is_said):
    survey, prior, first = pair
    starts: list = []
    found = better_of_two_starts(survey, prior, first, seconds(first, ratio, starts))
    ((level, start),) = starts
    down = start.state.rotations[:, 2].mean(axis=0)
    np.testing.assert_allclose(down / np.linalg.norm(down), [0.0, 0.0, -1.0], atol=1e-9)
    # The block is turned as a whole: what each camera sees of the points stays.
    for before, after in zip(survey.views, level.views, strict=True):
        seen = [
            (ties.start - view.camera.centre) @ view.camera.cam_from_local.T
            for view, ties in ((before, survey.observations.ties), (after, level.observations.ties))
        ]
        np.testing.assert_allclose(*seen, atol=1e-9)
    assert np.array_equal(found.poses.rotations, start.state.rotations) == is_second
    assert any("another solution" in text for text in found.warnings) == is_said


def test_the_same_solution_from_both_starts_is_the_first(pair):
    survey, prior, first = pair
    assert better_of_two_starts(survey, prior, first, lambda *_start: fits(first, 0.5)) is first


def test_level_photographs_and_those_without_control_have_one_start(pair):
    survey, prior, first = pair
    alone = changed(survey, control=None)
    level = replace(prior, state=replace(prior.state, rotations=prior.state.rotations @ TURN))
    for other, start in ((alone, prior), (survey, level)):
        assert better_of_two_starts(other, start, first, pytest.fail) is first
