"""Focal lengths that differ between photographs: predictions, whether a block shows them, and what is kept of them."""

import re
from dataclasses import replace

import numpy as np
import pytest

from refract.lens import MODELS, Lens, distorted
from survey.adjust.applied import apply_adjustment, write_cameras
from survey.adjust.block.bundle import NotConvergedError
from survey.adjust.block.observed import MATCH, observed
from survey.adjust.block.prediction import predict
from survey.adjust.block.priors import prior_of
from survey.adjust.block.state import NUM_LENS, NUM_RELIEF, enlarged, lenses_of
from survey.adjust.focal_lengths import with_focals
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import read_adjustment, write_adjustment
from survey.adjust.result.std_common import place_jacobian, seen_places
from survey.adjust.rounds import adjust
from survey.pose_files.colmap import read_model
from tests.block_survey import assert_same, pose_errors, require_derivatives, rms, state_of, survey_of
from tests.drawn_block import DrawnBlock, draw_block

SHARE = 0.002


def focals_of(block: DrawnBlock, share: float) -> np.ndarray:
    """Focal lengths over that of the lens, less one."""
    return share * np.random.default_rng([block.seed, 77]).standard_normal(len(block.cameras))


def drifting(block: DrawnBlock, share: float = SHARE) -> DrawnBlock:
    """The block with the focal lengths of an autofocus, which enlarge photographs about their principal point."""
    middle = np.array([block.lens["cx"], block.lens["cy"]])
    return replace(block, pixel=middle + (block.pixel - middle) * (1.0 + focals_of(block, share)[block.view])[:, None])


def test_predictions_with_focal_lengths_and_their_derivatives():
    block = draw_block(2, num_points=30, num_views=8, pixel_std=1e-9)
    layout, state, ties = state_of(drifting(block))
    rise_design = np.zeros((len(ties.view), NUM_RELIEF))
    layout, state = replace(layout, finds_focals=True), replace(state, focals=focals_of(block, SHARE))
    assert len(layout) == 4 + NUM_RELIEF + 2 * NUM_LENS + 8 + 6 * 8
    np.testing.assert_allclose(predict(layout, state, ties, rise_design), ties.pixel, atol=1e-6)
    require_derivatives(layout, state, ties)


@pytest.fixture(scope="module")
def drifted():
    """A block whose focal lengths drift, its survey and its adjustment."""
    block = drifting(draw_block(2, num_points=300, num_views=16))
    survey = survey_of(block)
    return block, survey, adjust_survey(survey, use_windows=False)


def test_focal_lengths_that_differ_are_found_within_what_is_stated_and_said(drifted):
    block, _, found = drifted
    assert found.poses.focals is not None
    names = [f"{name}.focal" for name in found.poses.names]
    rows = [found.covariance.names.index(name) for name in names]
    std = np.sqrt(np.diag(found.covariance.matrix)[rows])
    # Their mean is part of the focal length of the lens.
    error = found.poses.focals - focals_of(block, SHARE)
    # Of 16 the root mean square of what has unit variance is below 1.5 in all but one of a thousand.
    assert rms((error - error.mean()) / std) < 1.5
    # Positions of 3 cm at 20 m tell it to 0.15 %.
    assert rms(std) < 0.7 * SHARE
    positions = pose_errors(block, found.poses.centres, found.poses.rotations)[0]
    assert rms(positions / found.poses.position_std) < 1.5
    said = [re.search(r"focal lengths differ between photographs by ([0-9.]+) %", text) for text in found.warnings]
    # The scatter of 16 is good to a sixth.
    assert float(next(filter(None, said))[1]) == pytest.approx(100.0 * SHARE, rel=0.5)


def test_each_photograph_has_its_own_lens_and_files_keep_it(drifted, tmp_path):
    _, survey, found = drifted
    moved = apply_adjustment(survey, found)
    for number, (view, change) in enumerate(zip(moved.views, found.poses.focals, strict=True)):
        lens = found.lenses[found.poses.lens_of[number]]
        assert view.lens.focal == pytest.approx(np.array(lens.focal) * (1.0 + change))
        mine = found.residuals.view == number
        points = found.points[found.residuals.point[mine]]
        pinhole = view.lens.pinhole(view.camera.centre, view.camera.cam_from_local)
        seen = distorted(view.lens, pinhole.project(points, moved.water)) + found.residuals.px[mine]
        # What a rough bed seems to rise by, some millimetres, is in the residuals alone.
        np.testing.assert_allclose(seen, found.residuals.at_px[mine], atol=0.5)
    write_adjustment(tmp_path, found)
    assert_same(read_adjustment(tmp_path), found)
    ties = seen_places(found.points[:3], moved)
    assert place_jacobian(found, moved.water, ties).shape == (3, 3, len(found.covariance.names))


def test_a_model_with_them_comes_back_as_one_lens(drifted, tmp_path):
    _, survey, found = drifted
    moved = apply_adjustment(survey, found)
    write_cameras(tmp_path, moved, found)
    poses = {pose.name: pose for pose in read_model(tmp_path / "sparse").poses}
    given = replace(survey, views=tuple(replace(view, lens=poses[view.name].lens) for view in moved.views))
    prior = prior_of(given, 0.02)
    assert len(prior.lenses) == 1
    assert prior.layout.finds_focals
    for view, share in zip(moved.views, prior.state.focals, strict=True):
        assert enlarged(prior.lenses[0], 1.0 + share).params == pytest.approx(view.lens.params, rel=1e-12)
    # The scatter of those that were found is the standard deviation of each.
    std = prior.std[prior.layout.first_focal : prior.layout.first_pose]
    assert std == pytest.approx(np.full(16, rms(prior.state.focals)))
    again = adjust_survey(given, use_windows=False)
    # 22 m over the ground, positions known to 3 cm: what is found is the same to a small part of that.
    np.testing.assert_allclose(again.poses.centres, found.poses.centres, atol=0.01)
    # But for single points of which one of both leaves out an observation at the bound of outliers.
    assert np.quantile(np.abs(again.points - found.points).max(axis=1), 0.98) < 0.005


def test_lenses_of_few_photographs_or_of_several_cameras_are_kept(drifted):
    _, survey, found = drifted
    views = apply_adjustment(survey, found).views
    lenses, lens_of, focals = lenses_of(views[:4])
    assert (len(lenses), lens_of.tolist(), len(focals)) == (4, [0, 1, 2, 3], 0)
    two = [replace(view, lens=views[number % 2].lens) for number, view in enumerate(views)]
    lenses, lens_of, focals = lenses_of(two)
    assert (len(lenses), lens_of.tolist(), len(focals)) == (2, 8 * [0, 1], 0)


def with_lenses(views, lenses):
    return tuple(replace(view, lens=lens) for view, lens in zip(views, lenses, strict=True))


@pytest.mark.parametrize(("decimals", "aspect"), [(None, 1.0), (2, 1.0), (1, 1.0), (6, 1.0003), (3, 1.0003)])
def test_lenses_with_rounded_focal_lengths_are_one(drifted, decimals, aspect):
    view, lens = drifted[1].views[0], drifted[1].views[0].lens
    at = [MODELS[lens.model][1].index(name) for name in ("fx", "fy")]
    # Each of two photographs, as where a focus stays.
    shares = np.tile(np.random.default_rng(3).normal(0.0, SHARE, 50), 2)
    written = []
    for share in shares.tolist():
        params = list(lens.params)
        params[at[0]], params[at[1]] = 3000.0 * (1.0 + share), 3000.0 * (1.0 + share) * aspect
        written.append(replace(lens, params=tuple(p if decimals is None else round(p, decimals) for p in params)))
    lenses, lens_of, focals = lenses_of([replace(view, lens=each) for each in written])
    assert (len(lenses), lens_of.tolist()) == (1, 100 * [0])
    given = np.array([each.focal for each in written])
    back = np.array([enlarged(lenses[0], 1.0 + share).focal for share in focals.tolist()])
    # Both focal lengths are wrong by no more than their ratio.
    np.testing.assert_allclose(back, given, rtol=1e-6)


def test_ratios_on_both_sides_of_a_rounding_boundary_are_one(drifted):
    view, lens = drifted[1].views[0], drifted[1].views[0].lens
    at = MODELS[lens.model][1].index("fy")
    views = []
    for number in range(12):
        own = enlarged(lens, 1.0 + 1e-3 * number)
        params = list(own.params)
        params[at] = own.focal[0] * (1.0000005 + (2e-7 if number % 2 else -2e-7))
        views.append(replace(view, lens=replace(lens, params=tuple(params))))
    assert len(lenses_of(views)[0]) == 1


def test_lenses_whose_two_focal_lengths_spread_are_not_one(drifted):
    view, lens = drifted[1].views[0], drifted[1].views[0].lens
    at = MODELS[lens.model][1].index("fy")
    views = []
    for number in range(12):
        params = list(enlarged(lens, 1.0 + 1e-3 * number).params)
        # Of three neighbours the ratio is the same to 1e-6.
        params[at] *= 1.0 + 4e-7 * number
        views.append(replace(view, lens=replace(lens, params=tuple(params))))
    assert len(lenses_of(views)[0]) == 12


def test_photographs_of_other_cameras_keep_their_lens(drifted):
    """Beside one camera with autofocus: one photograph of another size, and a camera of one focal length."""
    _, survey, found = drifted
    views = apply_adjustment(survey, found).views
    each = [view.lens for view in views]
    small = replace(each[0], width=each[0].width + 2)
    fixed = replace(each[0], height=each[0].height + 2)
    given = replace(survey, views=with_lenses(views, [small, *each[1:11], *5 * [fixed]]))
    lenses, lens_of, focals = lenses_of(given.views)
    assert lens_of.tolist() == [0, *10 * [1], *5 * [2]]
    assert (lenses[0], lenses[2]) == (small, fixed)
    assert focals[[0, *range(11, 16)]].tolist() == 6 * [0.0]
    focal = np.array([lens.focal[0] for lens in each[1:11]])
    assert lenses[1].focal[0] == pytest.approx(focal.mean())
    assert focals[1:11] == pytest.approx(focal / focal.mean() - 1.0)
    prior = prior_of(given, 0.02)
    std = prior.std[prior.layout.first_focal : prior.layout.first_pose]
    # Those of the other cameras are held: what differs is in their lenses.
    assert std[1:11] == pytest.approx(np.full(10, rms(focals[1:11])))
    assert std[[0, *range(11, 16)]].max() < 1e-9
    adjusted = replace(given, observations=replace(given.observations, ties=None))
    std = prior_of(adjusted, 0.02, free_water=True).std[prior.layout.first_focal : prior.layout.first_pose]
    assert std[1:11].min() > 1e-5
    assert std[[0, *range(11, 16)]].max() < 1e-9


def test_a_lens_is_not_compared_with_every_other(drifted, monkeypatch):
    lens, read = drifted[1].views[0].lens, []
    each = [replace(lens, width=lens.width + number) for number in range(400)]
    views = [replace(drifted[1].views[0], lens=mine) for mine in each]
    focal = Lens.focal.fget
    monkeypatch.setattr(Lens, "focal", property(lambda mine: read.append(1) or focal(mine)))
    assert len(lenses_of(views)[0]) == len(views)
    # All pairs would be 80,000.
    assert len(read) <= 10 * len(views)


def test_a_block_that_does_not_converge_with_them_keeps_one_focal_length(drifted):
    survey = drifted[1]
    prior = prior_of(survey, 0.02)
    seen = observed([(MATCH, survey.observations.ties)], survey.observations.control, survey, prior)
    alone = adjust(prior, seen)

    def adjusted(_known):
        raise NotConvergedError("")

    kept, drift = with_focals(prior, alone, adjusted)
    assert kept is alone
    assert drift is None


def test_where_focal_lengths_are_alike_none_is_found():
    found = adjust_survey(survey_of(draw_block(2, num_points=400, num_views=16)), use_windows=False)
    assert found.poses.focals is None
    assert not any("focal lengths differ" in text for text in found.warnings)
