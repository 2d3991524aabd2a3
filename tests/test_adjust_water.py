"""The self-calibration end to end: verdicts on a block that can tell and one that cannot, and windows that match."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from refract.lens import Lens
from survey.adjust import calibration
from survey.adjust.calibration import calibrate_water, nadir_views, within_bounds
from survey.adjust.water import water_from_ties
from survey.adjust.water_estimate import PARAMETERS
from survey.errors import SurveyError
from survey.folder.place import water_plane
from survey.folder.survey import load_survey
from survey.photos.cameras import View
from survey.photos.tie_points import TiePoints
from tests.small_survey import small_survey
from tests.small_water_block import FOCAL, SIZE, convergent, nadir, tie_points

# The water of `small_water_block` at the origin of the local frame of `small_survey`.
STD_PX = 0.05


def survey_with(tmp_path, cameras, *, level=0.3, index=1.335):
    """A survey with other cameras and water, level given in local."""
    survey = load_survey(small_survey(tmp_path / "s"))
    lens = Lens("SIMPLE_PINHOLE", (FOCAL, SIZE[0] / 2, SIZE[1] / 2), *SIZE)
    views = tuple(View(f"{i}", survey.views[0].path, camera, lens) for i, camera in enumerate(cameras))
    easting, northing, height = survey.frame.origin
    given = replace(
        survey.config.water, level_m=height + level, level_at=(easting, northing), refractive_index=index,
        slope_east=0.0, slope_north=0.0,
    )  # fmt: skip
    config = replace(survey.config, water=given)
    return replace(survey, views=views, config=config, water=water_plane(survey.frame, given))


def test_a_convergent_block_tells_its_water_and_a_verdict_for_each_parameter(tmp_path, rng):
    cameras = convergent()
    survey = survey_with(tmp_path, cameras, level=0.8, index=1.30)
    found = water_from_ties(survey, tie_points(cameras, rng, count=600, std_px=STD_PX))
    assert [e.name for e in found.estimates] == list(PARAMETERS)
    assert all(e.is_observable and e.verdict.startswith("estimated") for e in found.estimates)
    level, _, _, index = found.estimates
    assert abs(level.value - survey.frame.origin[2] - 0.3) < 3.0 * level.std
    assert abs(index.value - 1.335) < 3.0 * index.std
    assert level.std < 0.05
    assert found.water.level_m == level.value
    assert found.num_dry == 0


def test_a_block_from_above_says_that_it_cannot_know_and_keeps_what_was_given(tmp_path, rng):
    cameras = nadir()
    survey = survey_with(tmp_path, cameras, level=0.8, index=1.30)
    found = water_from_ties(survey, tie_points(cameras, rng, count=600, std_px=STD_PX))
    assert not found.is_observable
    assert found.estimates[0].verdict.startswith("not observable: 1 sigma is")
    assert found.estimates[0].std > 0.05
    assert found.water == survey.config.water


def test_a_verdict_names_a_standard_deviation_only_where_it_is_too_large(tmp_path, rng):
    cameras = nadir()
    survey = survey_with(tmp_path, cameras, level=0.8, index=1.30)
    found = water_from_ties(survey, tie_points(cameras, rng, count=600, std_px=STD_PX))
    reasons = [re.search(r"1 sigma is (\S+?)(?: m)?, at most (\S+?)(?: m)? would", e.verdict) for e in found.estimates]
    assert all(float(reason[1]) > float(reason[2]) for reason in reasons if reason)
    others = [e for e, reason in zip(found.estimates, reasons, strict=True) if not reason]
    assert "slope_east" in [e.name for e in others]
    for estimate in others:
        words = f"not observable: the level is not, and {estimate.name} cannot be separated from it; "
        assert estimate.verdict.startswith(words)


@pytest.mark.parametrize("num_wet", [0, 12])
def test_too_few_tie_points_under_water_make_every_parameter_not_observable(tmp_path, rng, num_wet):
    cameras = convergent()
    survey = survey_with(tmp_path, cameras)
    ties = tie_points(cameras, rng, count=200, std_px=STD_PX, low=0.8, high=3.0)
    if num_wet:
        ties = joined(ties, tie_points(cameras, rng, count=num_wet, std_px=STD_PX))
    found = water_from_ties(survey, ties)
    assert not found.is_observable
    assert found.water == survey.config.water
    level, *others = (estimate.verdict for estimate in found.estimates)
    assert level.startswith(f"not observable: {num_wet} of {len(ties)} tie points lie under water")
    assert all(verdict.startswith("not observable: the level is not; ") for verdict in others)
    assert found.num_dry == len(ties) - num_wet


def test_no_tie_points_at_all_are_a_verdict_too(tmp_path):
    survey = survey_with(tmp_path, convergent())
    none = TiePoints(np.zeros((0, 3)), np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros((0, 2)))
    found = water_from_ties(survey, none)
    assert "0 of 0 tie points lie under water" in found.estimates[0].verdict
    assert json.loads(found.to_json())["rms_px"] is None


def test_views_from_above_of_a_shore_are_not_observable_instead_of_an_error(tmp_path, rng):
    """Points near the water line are wet at one level and dry at the next: the least squares swing to and fro."""
    cameras = nadir()
    survey = survey_with(tmp_path, cameras)
    found = water_from_ties(survey, tie_points(cameras, rng, count=300, std_px=STD_PX, low=-0.5, high=1.0))
    assert not found.is_observable
    assert all("not observable" in e.verdict and "kept as given" in e.verdict for e in found.estimates)
    assert found.water == survey.config.water


def test_tie_points_beyond_the_bounds_are_not_used(tmp_path, rng):
    cameras = convergent()
    survey = survey_with(tmp_path, cameras)
    ties = tie_points(cameras, rng)
    easting, northing, _ = survey.frame.origin
    bounds = (easting - 4.0, northing - 3.0, easting + 2.0, northing + 5.0)
    kept = within_bounds(replace(survey, bounds=bounds), ties)
    east, north, _ = survey.frame.crs_from_local(kept.start).T
    assert 0 < len(kept) < len(ties)
    assert (bounds[0] <= east).all()
    assert (east <= bounds[2]).all()
    assert (bounds[1] <= north).all()
    assert (north <= bounds[3]).all()
    assert within_bounds(survey, ties) is ties


def joined(a: TiePoints, b: TiePoints) -> TiePoints:
    return TiePoints(
        np.concatenate([a.start, b.start]),
        np.concatenate([a.point, b.point + len(a)]),
        np.concatenate([a.view, b.view]),
        np.concatenate([a.pixel, b.pixel]),
    )


def test_all_of_it_goes_into_json(tmp_path, rng):
    cameras = convergent()
    found = water_from_ties(survey_with(tmp_path, cameras), tie_points(cameras, rng, std_px=STD_PX))
    record = json.loads(found.to_json())
    assert record["estimates"][0]["name"] == "level_m"
    assert np.allclose(np.diag(record["correlation"]), 1.0)
    assert np.array(record["covariance"]).shape == (4, 4)


def test_a_covariance_that_is_not_known_is_null_in_json(tmp_path, rng):
    cameras = convergent()
    found = water_from_ties(survey_with(tmp_path, cameras), tie_points(cameras, rng, std_px=STD_PX))
    text = replace(found, covariance=((math.nan,) * 4,) * 4).to_json()
    assert "NaN" not in text
    assert json.loads(text)["covariance"] == [[None] * 4] * 4


def test_poses_of_a_run_that_is_named_are_used_and_a_run_without_poses_is_refused(tmp_path, monkeypatch):
    asked = []

    def load(folder, *, workspace, report):
        asked.append(workspace)
        raise SurveyError("seen enough")

    monkeypatch.setattr(calibration, "load_survey", load)
    run = tmp_path / "run"
    with pytest.raises(SurveyError, match=r"has no poses by structure from motion .*leave --run out"):
        calibration.estimate_water(tmp_path, run_folder=run)
    (run / "sfm").mkdir(parents=True)
    for named in (run, None):
        with pytest.raises(SurveyError, match="seen enough"):
            calibration.estimate_water(tmp_path, run_folder=named)
    assert asked == [run / "sfm", None]


def test_nadir_views_are_those_that_look_down(tmp_path):
    survey = survey_with(tmp_path, convergent())
    assert len(nadir_views(survey).views) == 5


@pytest.mark.slow
def test_wreck_under_water_gives_its_level_and_index_from_a_wrong_start(data_dir):
    survey = load_survey(data_dir / "wreck_water")
    truth = survey.config.water
    start = replace(truth, level_m=truth.level_m + 0.5, refractive_index=1.30)
    wrong = replace(survey, config=replace(survey.config, water=start), water=water_plane(survey.frame, start))
    level, _, _, index = calibrate_water(wrong).estimates
    # The truth within two standard deviations, and those small enough to be of use.
    assert abs(level.value - truth.level_m) < 2.0 * level.std < 0.05
    assert abs(index.value - truth.refractive_index) < 2.0 * index.std < 0.01
    assert not calibrate_water(nadir_views(wrong)).is_observable
