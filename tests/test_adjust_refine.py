"""Lenses of an adjustment: several cameras, fisheyes, square pixels, and verdicts."""

from dataclasses import replace

import numpy as np
import pytest

from refract.lens import Lens, affine_from_brown, distorted
from survey.adjust import refine
from survey.adjust.applied import apply_adjustment
from survey.adjust.block.observed import thinned
from survey.adjust.focal_lengths import with_square_pixels
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import Estimate, Status, with_verdict
from survey.folder.pose_priors import BY_POSES, PosePrior
from survey.photos.poses import TiePoints
from tests.block_survey import pose_errors, rms, survey_of
from tests.changed_survey import changed
from tests.drawn_block import draw_block

SMALL = {"num_points": 150, "num_views": 18, "nadir_only": False, "dry_share": 0.3}


def with_lenses(survey, lenses):
    """The survey with photograph i taken with lens i modulo their number."""
    views = tuple(
        replace(view, lens=lens, camera=lens.pinhole(view.camera.centre, view.camera.cam_from_local))
        for view, lens in zip(survey.views, lenses, strict=True)
    )
    return replace(survey, views=views)


def test_two_cameras_in_one_flight_get_two_lenses():
    block = draw_block(3, **SMALL)
    survey, lens = survey_of(block), block.stated_lens
    # Of the second camera the photographs are a tenth larger about their first pixel: another focal length.
    other = Lens(lens.model, tuple(1.1 * v for v in lens.params[:4]) + lens.params[4:], lens.width * 2, lens.height * 2)
    second = np.arange(len(survey.views)) % 2 == 1
    factor = np.where(second, 1.1, 1.0)
    survey = with_lenses(survey, [other if each else lens for each in second])
    number = {view.name: i for i, view in enumerate(survey.views)}
    marks = tuple(
        replace(mark, pixel=tuple(factor[number[mark.view]] * np.array(mark.pixel)))
        for mark in survey.observations.control.marks
    )
    ties = replace(
        survey.observations.ties, pixel=survey.observations.ties.pixel * factor[survey.observations.ties.view, None]
    )
    survey = changed(survey, ties=ties, control=replace(survey.observations.control, marks=marks))
    found = adjust_survey(survey, use_windows=False)
    focal = block.lens.focal[0]
    for camera, true in enumerate((focal, 1.1 * focal)):
        row = found.parameter(f"camera{camera}.f")
        assert row.status == Status.FREE
        assert abs(row.value - true) < 4.0 * row.std
    assert found.poses.lens_of.tolist() == second.astype(int).tolist()
    assert abs(found.parameter("camera1.f").value / found.parameter("camera0.f").value - 1.1) < 0.01


def test_the_parameters_of_a_fisheye_lens_do_not_move():
    block = draw_block(3, **SMALL)
    survey, lens = survey_of(block), block.lens
    fisheye = Lens("OPENCV_FISHEYE", (*lens.params[:4], 0.01, -0.002, 0.0, 0.0), lens.width, lens.height)
    cameras = [fisheye] * len(survey.views)
    # What this lens would have shown of the same rays.
    pixels = np.empty_like(survey.observations.ties.pixel)
    points = block.points[np.unique(block.point[~np.isin(block.point, block.control)])]
    for view, camera in enumerate(block.cameras):
        mine = survey.observations.ties.view == view
        pinhole = camera.project(points[survey.observations.ties.point[mine]], survey.water)
        pixels[mine] = distorted(fisheye, pinhole)
    survey = with_lenses(changed(survey, ties=replace(survey.observations.ties, pixel=pixels), control=None), cameras)
    found = adjust_survey(survey, use_windows=False)
    assert found.lenses == (fisheye,)
    assert not [row.name for row in found.parameters if row.name.startswith("camera")]
    assert apply_adjustment(survey, found).views[0].lens == fisheye
    positions, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
    assert rms(positions) < 0.1


def test_browns_part_of_an_affine_lens_is_adjusted_and_its_two_terms_stay():
    block = draw_block(3, **SMALL)
    survey, stated = survey_of(block), block.stated_lens
    size, k4, skew = (stated.width, stated.height), 0.02, 0.004
    true = Lens("BROWN_AFFINE", (*block.lens.params, 0.0, k4, skew), *size)
    given = Lens("BROWN_AFFINE", (*stated.focal, stated["cx"], stated["cy"], *[0.0] * 5, k4, skew), *size)
    pixels = affine_from_brown(true, survey.observations.ties.pixel)
    assert np.abs(pixels - survey.observations.ties.pixel).max() > 1.0
    survey = changed(survey, ties=replace(survey.observations.ties, pixel=pixels), control=None)
    found = adjust_survey(with_lenses(survey, [given] * len(survey.views)), use_windows=False)
    (lens,) = found.lenses
    assert (lens.model, lens["k4"], lens["skew"]) == ("BROWN_AFFINE", k4, skew)
    row = found.parameter("camera0.f")
    assert abs(row.value - true.focal[0]) < 4.0 * row.std
    positions, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
    assert rms(positions) < 0.1


def test_the_adjusted_survey_has_poses_lenses_and_water_of_the_adjustment():
    block = draw_block(3, **SMALL)
    survey = survey_of(block)
    found = adjust_survey(survey, use_windows=False)
    applied = apply_adjustment(survey, found)
    assert applied.provenance.is_adjusted
    assert applied.observations.ties is None
    assert applied.config.water == found.water
    assert applied.config.water.level_m == found.parameter("level_m").value
    for view, centre, rotation in zip(applied.views, found.poses.centres, found.poses.rotations, strict=True):
        np.testing.assert_array_equal(view.camera.centre, centre)
        np.testing.assert_array_equal(view.camera.cam_from_local, rotation)
        assert view.lens.focal[0] == view.camera.fx == pytest.approx(found.parameter("camera0.f").value)
        assert view.lens["k1"] == found.parameter("camera0.k1").value
    # The true points, through the adjusted cameras, lie where they were seen.
    shown = apply_adjustment(survey, found).views[4]
    mine = block.view == 4
    pixel = shown.camera.project(block.points[block.point[mine]], applied.water)
    assert np.median(np.linalg.norm(pixel - block.pixel[mine], axis=1)) < 3.0 * block.pixel_std


def test_thinning_keeps_every_photograph_tied_and_long_tracks_first():
    block = draw_block(5, num_points=800, num_views=20)
    ties = TiePoints(block.start, block.point, block.view, block.pixel)
    sizes = [(block.lens.width, block.lens.height)] * 20
    kept = thinned(ties, sizes, 6, 2)
    assert (np.diff(kept) > 0).all()
    of_kept = np.isin(ties.point, kept)
    assert len(kept) < 0.6 * len(ties)
    before, after = (np.bincount(ties.view[rows], minlength=20) for rows in (slice(None), of_kept))
    # A photograph has 6 by 5 cells of 2 points each; some at its edge have none.
    assert (after >= np.minimum(before, 30)).all()
    length = np.bincount(ties.point, minlength=len(ties))
    assert length[kept].mean() > length.mean()


@pytest.mark.parametrize(
    ("std", "given_std", "limit", "status", "value"),
    [
        (0.01, 0.04, 0.05, Status.FREE, 2.0),
        (0.01, np.inf, 0.05, Status.FREE, 2.0),
        (0.039, 0.04, 0.05, Status.HELD, 2.0),
        (0.06, 0.5, 0.05, Status.UNKNOWN, 1.0),
        (0.05, 0.05, 0.04, Status.UNKNOWN, 1.0),
        # What was given is of use, though the photographs add nothing.
        (0.05, 0.05, 0.05, Status.HELD, 2.0),
    ],
)
def test_a_verdict_weighs_what_is_found_what_was_given_and_what_is_of_use(std, given_std, limit, status, value):
    row = with_verdict("level_m", Estimate(2.0, std), Estimate(1.0, given_std), limit, " m")
    assert (row.status, row.value) == (status, value)
    assert row.verdict.startswith(
        {Status.FREE: "found: 2", Status.HELD: "held: 2", Status.UNKNOWN: "not observable: "}[status]
    )
    assert (" m is kept" in row.verdict) == (status == Status.UNKNOWN)


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


@pytest.mark.parametrize(("wave_px", "times"), [(0.4, 2), (0.0, 1)])
def test_windows_are_measured_again_on_the_adjusted_block_over_waves_alone(monkeypatch, wave_px, times):
    block = draw_block(1, num_points=200, num_views=18, pixel_std=0.05, shared=wave_px / 0.05, dry_share=0.2)
    survey, measured = survey_of(block), []

    def measure(given, **_kwargs):
        measured.append(np.array([view.camera.centre for view in given.views]))
        return survey.observations.ties

    monkeypatch.setattr(refine, "measure_windows", measure)
    found = adjust_survey(changed(survey, ties=None))
    assert len(measured) == times
    # Where the same windows are found again, the block stays where it is, to a part of its standard deviation.
    assert (np.abs(measured[-1] - found.poses.centres) < 0.1 * found.poses.position_std).all() == (times == 2)
