"""An adjustment finds the water: level, slopes and index, and the rate at which the level rises."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from small_survey import small_survey

from refract import PinholeCamera
from refract.lens import Lens
from survey.adjust import refine, waterline
from survey.adjust.applied import apply_adjustment
from survey.adjust.block.bundle import NotConvergedError
from survey.adjust.block.prediction import apparent_rise_design, predict
from survey.adjust.block.priors import EXACT_STD_DEG, EXACT_STD_M
from survey.adjust.block.state import WATER_PARAMETERS, settings_of
from survey.adjust.observability import dry_or_within_bounds, within_bounds
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import read_adjustment, write_adjustment
from survey.adjust.result.parts import common_error
from survey.adjust.waterline import calibrate_water
from survey.errors import SurveyError
from survey.folder.local_frame import water_plane
from survey.folder.pose_priors import PosePrior
from survey.folder.survey import load_survey
from survey.photos.cameras import View
from survey.photos.poses import TiePoints
from survey.plan.plan import pose_choice
from survey.water.tides import Tide
from tests.block_survey import state_of, survey_of, with_water
from tests.changed_survey import changed
from tests.drawn_block import FOCAL, SIZE, TRUTH, DrawnBlock, convergent, draw_block, nadir, tie_points

STD_PX = 0.05
NONE = TiePoints(np.zeros((0, 3)), np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros((0, 2)))


def survey_with(tmp_path, cameras, *, level=0.3, index=1.335):
    """A survey with other cameras and water, level given in local."""
    survey = load_survey(small_survey(tmp_path / "s"))
    lens = Lens("SIMPLE_PINHOLE", (FOCAL, SIZE[0] / 2, SIZE[1] / 2), *SIZE)
    views = tuple(View(f"{i}", survey.views[0].path, camera, lens) for i, camera in enumerate(cameras))
    priors = {view.name: PosePrior(view.camera.centre, None, None, "poses file") for view in views}
    easting, northing, height = survey.frame.origin
    given = replace(
        survey.config.water, level_m=height + level, level_at=(easting, northing), refractive_index=index,
        slope_east=0.0, slope_north=0.0,
    )  # fmt: skip
    config = replace(survey.config, water=given)
    return changed(survey, views=views, priors=priors, config=config, water=water_plane(survey.frame, given))


@pytest.fixture
def measuring(monkeypatch):
    """Gives the windows that are measured in the photographs."""

    def give(ties: TiePoints) -> None:
        monkeypatch.setattr(refine, "measure_windows", lambda *_arguments, **_options: ties)

    return give


def errors(survey, found) -> np.ndarray:
    """Estimates less the truth, (4,)."""
    truth = TRUTH + np.array([survey.frame.origin[2], 0.0, 0.0, 0.0])
    # Grid and local axes differ by the convergence of meridians, a degree: 2e-5 of slope, a tenth of its sigma.
    return np.array([row.value for row in found.estimates]) - truth


def test_a_convergent_block_tells_its_water_and_a_verdict_for_each_parameter(tmp_path, rng, measuring):
    cameras = convergent()
    survey = survey_with(tmp_path, cameras, level=0.8, index=1.30)
    measuring(tie_points(cameras, rng, std_px=STD_PX))
    found = calibrate_water(survey)
    assert [e.name for e in found.estimates] == list(WATER_PARAMETERS)
    assert all(e.is_observable and e.verdict.startswith("found: ") for e in found.estimates)
    std = np.array([e.std for e in found.estimates])
    assert (np.abs(errors(survey, found)) < 3.5 * std).all()
    assert std[0] < 0.05
    assert found.water.level_m == found.estimates[0].value
    assert found.num_dry == 0
    # What nothing was known of is not compared with what was given.
    assert "(given" not in found.estimates[0].verdict


@pytest.mark.slow
def test_errors_are_as_large_as_the_covariance_says_with_poses_that_are_wrong(tmp_path, measuring):
    cameras = convergent()
    squares = []
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        measuring(tie_points(cameras, rng, count=60))
        survey = survey_with(tmp_path, [spoilt(camera, rng) for camera in cameras], level=0.8, index=1.30)
        found = calibrate_water(survey)
        error = errors(survey, found)
        squares.append(error @ np.linalg.solve(found.covariance, error))
    low, high = chi2.ppf([0.001, 0.999], 4 * len(squares))
    assert low < sum(squares) < high


def spoilt(camera: PinholeCamera, rng) -> PinholeCamera:
    """A camera whose pose is wrong by what is assumed of poses of a file."""
    turn = Rotation.from_rotvec(np.radians(EXACT_STD_DEG) * rng.normal(size=3)).as_matrix()
    centre = camera.centre + EXACT_STD_M * rng.normal(size=3)
    return replace(camera, centre=centre, cam_from_local=turn @ camera.cam_from_local)


def test_wrong_measurements_hardly_move_it(tmp_path, measuring):
    cameras = convergent()
    survey = survey_with(tmp_path, cameras, level=0.8, index=1.30)
    measuring(tie_points(cameras, np.random.default_rng(3), count=150, wrong=0.05))
    found = calibrate_water(survey)
    # One in twenty is up to 200 standard deviations off.
    assert (np.abs(errors(survey, found)) < 3.5 * np.array([e.std for e in found.estimates])).all()


def test_wet_measurements_are_no_outliers_where_waves_displace_them_more_than_dry_ones(tmp_path, rng, measuring):
    cameras = convergent()
    survey = survey_with(tmp_path, cameras)
    dry = tie_points(cameras, rng, count=90, std_px=0.02, low=1.5, high=4.0)
    ties = joined(tie_points(cameras, rng, count=60, std_px=0.2, low=-5.0, high=-2.0), dry)
    measuring(ties)
    found = refine.adjust_survey(survey, free_water=True)
    # Beyond four standard deviations lie 0.03 % of a two-dimensional normal distribution.
    assert found.statistics.num_left_out < 0.005 * len(ties.view)


def test_a_block_from_above_says_that_it_cannot_know_and_keeps_what_was_given(tmp_path, rng, measuring):
    cameras = nadir()
    survey = survey_with(tmp_path, cameras, level=0.8, index=1.30)
    measuring(tie_points(cameras, rng, std_px=STD_PX))
    found = calibrate_water(survey)
    assert not found.is_observable
    assert found.estimates[0].verdict.startswith("not observable: 1 sigma is")
    assert found.estimates[0].std > 0.05
    np.testing.assert_array_equal(settings_of(found.water), settings_of(survey.config.water))
    # A standard deviation is named only where it is too large.
    reasons = [re.search(r"1 sigma is (\S+?)(?: m)?, at most (\S+?)(?: m)? would", e.verdict) for e in found.estimates]
    assert all(float(reason[1]) > float(reason[2]) for reason in reasons if reason)
    for estimate, reason in zip(found.estimates, reasons, strict=True):
        words = f"not observable: the level is not, and {estimate.name} cannot be separated from it; "
        assert reason or estimate.verdict.startswith(words)


@pytest.mark.parametrize("num_wet", [0, 12])
def test_too_few_tie_points_under_water_make_every_parameter_not_observable(tmp_path, rng, measuring, num_wet):
    cameras = convergent()
    survey = survey_with(tmp_path, cameras)
    ties = tie_points(cameras, rng, count=100, std_px=STD_PX, low=0.8 + 1.0, high=4.0)
    if num_wet:
        ties = joined(ties, tie_points(cameras, rng, count=num_wet, std_px=STD_PX, low=-5.0, high=-2.0))
    measuring(ties)
    found = calibrate_water(survey)
    assert not found.is_observable
    np.testing.assert_array_equal(settings_of(found.water), settings_of(survey.config.water))
    level, *others = (estimate.verdict for estimate in found.estimates)
    under = f"{num_wet} of {len(ties)} tie points lie under water, expected at least 30"
    assert level.startswith(f"not observable: {under}; ")
    assert all(verdict.startswith("not observable: the level is not; ") for verdict in others)
    assert found.num_dry >= 100


def test_no_tie_points_at_all_are_a_verdict_too(tmp_path, measuring):
    measuring(NONE)
    found = calibrate_water(survey_with(tmp_path, convergent()))
    assert "no tie point" in found.estimates[0].verdict
    assert json.loads(found.to_json())["rms_px"] is None


def test_an_adjustment_that_does_not_converge_is_a_verdict_with_its_reason(tmp_path, monkeypatch):
    def fail(*_arguments, **_options):
        raise NotConvergedError("it swings to and fro")

    monkeypatch.setattr(waterline, "adjust_survey", fail)
    survey = survey_with(tmp_path, convergent())
    found = calibrate_water(survey)
    assert found.estimates[0].verdict.startswith("not observable: it swings to and fro; ")
    assert found.water == survey.config.water
    record = json.loads(found.to_json())
    assert [row["is_observable"] for row in record["estimates"]] == [False] * 4


def test_views_from_above_of_a_shore_are_not_observable_instead_of_an_error(tmp_path, rng, measuring):
    """Points near the water line are wet at one level and dry at the next."""
    cameras = nadir()
    survey = survey_with(tmp_path, cameras)
    measuring(tie_points(cameras, rng, std_px=STD_PX, low=-0.5, high=1.0))
    found = calibrate_water(survey)
    assert not found.is_observable
    assert all("not observable" in e.verdict and e.verdict.endswith("is kept") for e in found.estimates)


def test_tie_points_beyond_the_bounds_are_not_used(tmp_path, rng):
    cameras = convergent()
    survey = survey_with(tmp_path, cameras)
    ties = tie_points(cameras, rng)
    easting, northing, _ = survey.frame.origin
    bounds = (easting - 4.0, northing - 3.0, easting + 2.0, northing + 5.0)
    kept = within_bounds(changed(survey, bounds=bounds), ties)
    assert 0 < len(kept) < len(ties)
    assert inside(survey, bounds, kept).all()
    assert within_bounds(survey, ties) is ties


def test_matches_beyond_the_bounds_are_used_on_dry_ground_alone(tmp_path, rng):
    cameras = convergent()
    survey = survey_with(tmp_path, cameras)
    dry = tie_points(cameras, rng, count=50, low=1.5, high=3.0)
    ties = joined(tie_points(cameras, rng, low=-5.0, high=-2.0), dry)
    easting, northing, _ = survey.frame.origin
    bounds = (easting - 4.0, northing - 3.0, easting + 2.0, northing + 5.0)
    kept = dry_or_within_bounds(changed(survey, bounds=bounds), ties)
    is_dry = survey.water.depth(kept.start) < 0.0
    assert is_dry.sum() == len(dry)
    assert not inside(survey, bounds, kept)[is_dry].all()
    assert inside(survey, bounds, kept)[~is_dry].all()


def inside(survey, bounds, ties: TiePoints) -> np.ndarray:
    east, north, _ = survey.frame.crs_from_local(ties.start).T
    return (bounds[0] <= east) & (east <= bounds[2]) & (bounds[1] <= north) & (north <= bounds[3])


def joined(a: TiePoints, b: TiePoints) -> TiePoints:
    return TiePoints(
        np.concatenate([a.start, b.start]),
        np.concatenate([a.point, b.point + len(a)]),
        np.concatenate([a.view, b.view]),
        np.concatenate([a.pixel, b.pixel]),
    )


def test_all_of_it_goes_into_json(tmp_path, rng, measuring):
    cameras = convergent()
    measuring(tie_points(cameras, rng, count=100, std_px=STD_PX))
    found = calibrate_water(survey_with(tmp_path, cameras))
    record = json.loads(found.to_json())
    level = record["estimates"][0]
    assert level["name"] == "level_m"
    assert {"value", "std", "given", "is_observable", "verdict"} <= set(level)
    assert [row["name"] for row in record["parameters"][:5]] == [*WATER_PARAMETERS, "camera0.f"]
    assert np.allclose(np.diag(record["correlation"]), 1.0)
    np.testing.assert_allclose(np.sqrt(np.diag(record["covariance"])), [row["std"] for row in record["estimates"]])


def test_poses_of_a_run_that_is_named_are_used_and_a_run_without_poses_is_refused(tmp_path, monkeypatch):
    asked = []

    def load(folder, *, workspace, report):
        asked.append(workspace)
        raise SurveyError("seen enough")

    monkeypatch.setattr(waterline, "load_survey", load)
    run = tmp_path / "run"
    with pytest.raises(SurveyError, match=r"has no poses by structure from motion .*leave --run out"):
        waterline.estimate_water(tmp_path, run_folder=run)
    (run / "sfm").mkdir(parents=True)
    for named in (run, None):
        with pytest.raises(SurveyError, match="seen enough"):
            waterline.estimate_water(tmp_path, run_folder=named)
    assert asked == [run / "sfm", None]


def test_a_dry_survey_is_refused(tmp_path):
    survey = survey_with(tmp_path, convergent())
    with pytest.raises(SurveyError, match="is a dry survey, expected one with water; give"):
        calibrate_water(replace(survey, water=None))


@pytest.mark.slow
def test_wreck_under_water_gives_its_level_and_index_from_a_wrong_start(data_dir):
    survey = load_survey(data_dir / "wreck_water")
    truth = survey.config.water
    wrong = with_water(survey, level_m=truth.level_m + 0.5, refractive_index=1.30)
    level, _, _, index = calibrate_water(wrong).estimates
    # The truth within two standard deviations, and those small enough to be of use.
    assert abs(level.value - truth.level_m) < 2.0 * level.std < 0.05
    assert abs(index.value - truth.refractive_index) < 2.0 * index.std < 0.01


def test_water_is_not_found_with_poses_that_are_to_be_kept(tmp_path):
    survey = survey_with(tmp_path, convergent())
    assert pose_choice(survey, "auto", free_water=True)[0] == "refine"
    with pytest.raises(SurveyError, match="leave out --poses fixed"):
        pose_choice(survey, "fixed", free_water=True)


# The water rises by 0.3 m in the hour of the flight.
RATE, STD = 0.3, 1.0


def risen(block: DrawnBlock, hours: np.ndarray) -> DrawnBlock:
    """The block as it is seen through water that rises."""
    layout, state, ties = state_of(block)
    rise_design = np.zeros_like(apparent_rise_design(state, ties))
    moved, still = (predict(replace(layout, tides=tides), state, ties, rise_design) for tides in (RATE * hours, None))
    return replace(block, pixel=block.pixel + moved - still)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """A survey of rising water of which nearly nothing is given, and its adjustment."""
    block = draw_block(5, num_points=250, num_views=20, nadir_only=False, dry_share=0.2, num_control=6)
    hours = np.linspace(-0.5, 0.5, len(block.cameras))
    survey = survey_of(risen(block, hours))
    names = [view.name for view in survey.views]
    water = replace(survey.config.water, level_rate_m_per_h=0.0, level_rate_std_m_per_h=STD)
    tide = Tide("level_rate_m_per_h", dict.fromkeys(names, 0.0), dict(zip(names, hours.tolist(), strict=True)))
    survey = changed(survey, config=replace(survey.config, water=water), tide=tide)
    folder = tmp_path_factory.mktemp("adjustment")
    write_adjustment(folder, adjust_survey(survey, use_windows=False))
    return survey, read_adjustment(folder)


def test_the_rate_is_found_within_what_is_stated(found):
    _, adjusted = found
    rate = adjusted.parameter("level_rate_m_per_h")
    assert rate.std < 0.2 * RATE
    assert abs(rate.value - RATE) < 3.0 * rate.std
    assert rate.verdict.startswith("found: 0.")
    assert "m/h (given 0.0" in rate.verdict
    assert adjusted.covariance.matrix.shape == (len(adjusted.covariance.names),) * 2
    assert adjusted.covariance.names.count("level_rate_m_per_h") == 1


def test_the_survey_goes_on_with_the_levels_that_were_found(found):
    survey, adjusted = found
    again = apply_adjustment(survey, adjusted)
    tides = np.array([view.camera.tide for view in again.views])
    np.testing.assert_allclose(tides, adjusted.parameter("level_rate_m_per_h").value * adjusted.poses.hours, atol=1e-12)
    assert again.observations.tide.moves_m == pytest.approx(np.ptp(tides))
    assert again.observations.tide.matters
    assert common_error(adjusted, again.water).typical < 0.2
