"""How good poses of a file are, where nobody says so: as the block shows it, positions and rotations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from slow_cases import slow

from survey.adjust.block.observed import MATCH, observed
from survey.adjust.block.priors import prior_of
from survey.adjust.refine import adjust_survey
from survey.adjust.rounds import adjust
from survey.folder.pose_priors import BY_POSES, PosePrior
from tests.block_survey import pose_errors, rms, survey_of
from tests.changed_survey import changed
from tests.drawn_block import DrawnBlock, draw_block

NUM_VIEWS = 18


def wet_block(seed: int) -> DrawnBlock:
    """Nothing but the bend of its rays, and the poses, tells how it lies."""
    return draw_block(
        seed, num_points=150, num_views=NUM_VIEWS, dry_share=0.0, num_control=0, height=20.0, depth=2.0, pixel_std=0.1
    )


def by_file(block: DrawnBlock, std_m: float, std_deg: float, tool: str | None = None):
    """The survey with poses of a file that are off by so much, and the lens that was calibrated."""
    rng, survey = np.random.default_rng([block.seed, 40]), survey_of(block)
    views = []
    for view, true in zip(survey.views, block.cameras, strict=True):
        turn = Rotation.from_rotvec(np.radians(std_deg) * rng.standard_normal(3)).as_matrix()
        centre = true.centre + std_m * rng.standard_normal(3)
        views.append(replace(view, lens=block.lens, camera=block.lens.camera(centre, true.cam_from_local @ turn)))
    priors = {view.name: PosePrior(view.camera.centre, None, None, BY_POSES) for view in views}
    return changed(survey, views=tuple(views), priors=priors, tool=tool)


def stds_of(survey) -> np.ndarray:
    """Standard deviations (V, 6) [m, rad] of its poses as the adjustment used them."""
    prior = prior_of(survey, 0.02)
    done = adjust(prior, observed([(MATCH, survey.observations.ties)], None, survey, prior))
    return done.prior.std[done.prior.layout.first_pose :].reshape(-1, 6)


@pytest.mark.parametrize(("std_m", "std_deg"), [(0.005, 0.3), slow(0.02, 0.02), slow(0.2, 1.0)])
def test_unstated_poses_count_as_good_as_they_are(std_m, std_deg):
    found = np.array([stds_of(by_file(wet_block(seed), std_m, std_deg))[0] for seed in range(3)])
    # Of three blocks of 18 views; one of the heights (18 numbers, 12 or so free) is good to a fifth.
    np.testing.assert_allclose(np.sqrt(np.mean(found[:, :3] ** 2, axis=0)), std_m, rtol=0.4)
    np.testing.assert_allclose(np.degrees(np.sqrt(np.mean(found[:, 3:] ** 2, axis=0))), std_deg, rtol=0.4)


def test_exact_poses_that_are_adjusted_stay_exact():
    block = wet_block(1)
    found = adjust_survey(by_file(block, 0.0, 0.0), use_windows=False)
    positions, rotations = pose_errors(block, found.poses.centres, found.poses.rotations)
    # A tenth of a pixel at 20 m is 2 mm.
    assert rms(positions) < 0.002
    assert np.degrees(rms(rotations)) < 0.005


@pytest.mark.slow
def test_the_tilt_of_a_block_is_held_by_unstated_rotations_and_lies_within_what_it_states():
    scaled, turned = [], {None: [], "a program": []}
    for seed in range(6):
        block = wet_block(seed)
        for tool, errors in turned.items():
            found = adjust_survey(by_file(block, 0.1, 0.05, tool), use_windows=False)
            _, rotations = pose_errors(block, found.poses.centres, found.poses.rotations)
            # Turns about the axes of cam, as those of local.
            whole = np.einsum("vji,vj->vi", found.poses.rotations, rotations).mean(axis=0)[:2]
            errors.append(whole)
            if tool is None:
                scaled.append(whole / std_of_whole(found))
    # 0.05 degrees over the root of 18 views is 0.2 mrad.
    assert rms(np.array(turned[None])) < 0.4e-3
    # What a program found from the same photographs counts for nothing: the water alone tells the tilt.
    assert rms(np.array(turned["a program"])) > 2.0 * rms(np.array(turned[None]))
    assert 0.5 < rms(np.array(scaled)) < 1.7


def std_of_whole(found) -> np.ndarray:
    """Standard deviations (2,) of the mean turn of the cameras about the level axes of local."""
    first, count = found.layout.first_pose - 3, len(found.poses.names)
    moves = np.zeros((3, len(found.covariance.matrix)))
    for view, rotation in enumerate(found.poses.rotations):
        moves[:, first + 6 * view + 3 : first + 6 * view + 6] = rotation.T / count
    return np.sqrt(np.diag(moves @ found.covariance.matrix @ moves.T))[:2]


def test_a_rotation_that_the_block_contradicts_is_named_and_not_used():
    block = wet_block(2)
    survey = by_file(block, 0.02, 0.02)
    wrong = survey.views[5]
    turn = Rotation.from_rotvec([0.03, 0.0, 0.0]).as_matrix()
    camera = replace(wrong.camera, cam_from_local=turn @ wrong.camera.cam_from_local)
    views = tuple(replace(view, camera=camera) if view is wrong else view for view in survey.views)
    found = adjust_survey(replace(survey, views=views), use_windows=False)
    assert [text for text in found.warnings if text.startswith("rotations")] == [
        f"rotations that the block contradicts are not used: {wrong.name}"
    ]
    _, rotations = pose_errors(block, found.poses.centres, found.poses.rotations)
    assert np.degrees(rms(rotations[5])) < 0.05
