"""The level of the water from points of its surface and from a gauge: known planes, wrong points, refusals."""

import dataclasses
from datetime import UTC, datetime

import numpy as np
import pytest
from small_survey import E0, LEVEL, N0, TOML, replaced, rows_of, small_survey

from geo.crs import parse_crs
from survey.errors import ConfigError
from survey.folder.survey import load_survey
from survey.photos.exif import Exif
from survey.plan.check import check_survey
from survey.settings.config import parse_config
from survey.water.gauge_files import read_series
from survey.water.level import fit_surface, with_level
from survey.water.level_observation import points_of_surface

CRS = parse_crs("EPSG:25832+5778")
HEAD = Exif((64, 48), None, None, 1, "", None)


def plane_points(rng, *, count=40, east=0.0, north=0.0, std=0.01):
    points = np.column_stack([rng.uniform(-50.0, 50.0, (count, 2)), np.zeros(count)])
    points[:, 2] = 3.0 + east * points[:, 0] + north * points[:, 1] + std * rng.normal(size=count)
    return points


def test_a_tilted_surface_is_found_within_its_covariance(rng):
    fit = fit_surface(plane_points(rng, east=0.002, north=-0.004))
    level = 3.0 + 0.002 * fit.level_at[0] - 0.004 * fit.level_at[1]
    error = np.array([fit.level_m - level, fit.slope_east - 0.002, fit.slope_north + 0.004])
    # Four standard deviations of each: one in ten thousand.
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(fit.covariance))).all()
    assert fit.covariance[0, 0] ** 0.5 == pytest.approx(0.01 / 40**0.5, rel=0.5)


def test_level_water_stays_level(rng):
    fit = fit_surface(plane_points(rng))
    assert fit.slope_east == fit.slope_north == 0.0
    assert abs(fit.level_m - 3.0) < 4.0 * fit.covariance[0, 0] ** 0.5


def test_wrong_points_hardly_move_the_level(rng):
    points = plane_points(rng)
    points[:4, 2] += 5.0
    # Least squares would be 0.5 m off.
    assert abs(fit_surface(points).level_m - 3.0) < 0.01


def test_points_in_a_row_do_not_tilt_the_water(rng):
    points = plane_points(rng, east=0.01)
    points[:, 1] = points[:, 0]
    assert fit_surface(points).slope_north == 0.0


def test_two_points_are_refused():
    with pytest.raises(ConfigError, match="three or more"):
        fit_surface(np.zeros((2, 3)))


@pytest.mark.parametrize("key", ["shoreline", "gnss_points"])
def test_points_give_a_survey_its_level(tmp_path, key):
    folder = small_survey(tmp_path / "s", toml=replaced((f"level_m = {LEVEL}", f'{key} = "points.csv"')))
    rows = [f"{E0 + 5 * i},{N0 - 3 * i * i},{LEVEL + 0.25 + 0.001 * (i % 2)}" for i in range(5)]
    (folder / "points.csv").write_text("easting,northing,height\n" + "\n".join(rows) + "\n")
    survey = load_survey(folder)
    assert survey.config.water.level_m == pytest.approx(LEVEL + 0.25, abs=2e-3)
    assert f"+- {survey.config.water.level_std_m:.3f} from" in survey.findings.assumptions[0]
    assert any(key in text for text in survey.findings.assumptions)
    assert survey.config.water.level_files == {}


def gauge_config():
    return parse_config('[water]\ngauge = "gauge.csv"\n')


def heads_at(*minutes):
    return {f"{m}.jpg": dataclasses.replace(HEAD, taken=datetime(2024, 6, 1, 10, m, tzinfo=UTC)) for m in minutes}


def write_gauge(folder, *rows):
    (folder / "gauge.csv").write_text("\n".join(["time,level", *rows]) + "\n")


def test_a_gauge_is_interpolated_at_the_photographs(tmp_path):
    write_gauge(tmp_path, "2024-06-01T10:00:00Z,1.0", "2024-06-01T13:00:00+02:00,1.6")
    config, readings, tide, said = with_level(tmp_path, gauge_config(), heads_at(10, 20), CRS)
    assert [reading.level_m for reading in readings] == [1.0, 1.6]
    assert readings[1].time == datetime(2024, 6, 1, 11, tzinfo=UTC)
    # A reading and the zero of the gauge are known to 1 cm each; a tide of that rate bends by 0.3 m/h2 between the two.
    bend = 2.0 * np.pi / 12.42 * 0.6 * 0.5 * np.mean([1 / 6 * 5 / 6, 1 / 3 * 2 / 3])
    assert config.water.level_std_m == pytest.approx(np.hypot(2**0.5 * 0.01, bend))
    # A quarter of an hour into an hour that rises by 0.6 m.
    assert config.water.level_m == pytest.approx(1.15, abs=1e-9)
    assert config.water.gauge is None
    assert tide.over == pytest.approx({"10.jpg": -0.05, "20.jpg": 0.05})
    assert tide.hours == pytest.approx({"10.jpg": -1.0 / 12.0, "20.jpg": 1.0 / 12.0})
    assert "100 mm" in said.assumptions[0]


def test_images_without_a_time_are_refused(tmp_path):
    write_gauge(tmp_path, "2024-06-01T10:00:00Z,1.0", "2024-06-01T10:15:00Z,1.1")
    with pytest.raises(ConfigError, match="no image has its time in UTC"):
        with_level(tmp_path, gauge_config(), {"a.jpg": HEAD}, CRS)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (["2024-06-01T10:00:00,1.0", "2024-06-01T11:00:00,1.0"], "no time zone"),
        (["2024-06-01T11:00:00Z,1", "2024-06-01T10:00:00Z,1", "2024-06-01T12:00:00Z,1"], "line 3: .*sort the lines"),
        (["2024-06-01T10:00:00Z,1", "2024-06-01T10:00:00Z,2", "2024-06-01T11:00:00Z,1"], "line 3: .*keep one"),
        (["ten,1.0", "eleven,1.0"], "is not a time"),
        (["2024-06-01T10:00:00Z,high", "2024-06-01T11:00:00Z,1.0"], "finite number"),
        (["2024-06-01T10:00:00Z"], "1 values were found, expected 2"),
    ],
)
def test_a_damaged_gauge_is_named(tmp_path, rows, message):
    write_gauge(tmp_path, *rows)
    with pytest.raises(ConfigError, match=message):
        read_series(tmp_path / "gauge.csv")


def test_a_reading_that_overlapping_downloads_repeat_counts_once(tmp_path):
    rows = "2024-06-01T10:00:00Z,1.0", "2024-06-01T11:00:00Z,1.1", "2024-06-01T13:00:00+02:00,1.10"
    for some in (rows, rows[::-1]):
        write_gauge(tmp_path, *some)
        assert [reading.level_m for reading in read_series(tmp_path / "gauge.csv").readings] == [1.0, 1.1]


def test_a_survey_with_a_level_is_left_as_it_is(tmp_path):
    config = parse_config(TOML)
    same, (level,), tide, _ = with_level(tmp_path, config, {}, CRS)
    assert (same, tide) == (config, None)
    assert (level.level_m, level.std_m, level.place, level.source) == (LEVEL, 0.02, (E0, N0), "level_m")


def test_what_all_points_share_is_not_averaged_away(tmp_path):
    folder = small_survey(tmp_path / "s", toml=replaced((f"level_m = {LEVEL}", 'gnss_points = "points.csv"')))
    rows = [f"{E0 + 5 * i},{N0 - 3 * (i % 7)},{LEVEL + 0.002 * (i % 3)}" for i in range(100)]
    (folder / "points.csv").write_text("easting,northing,height\n" + "\n".join(rows) + "\n")
    survey = load_survey(folder)
    assert survey.config.water.level_std_m == pytest.approx(0.015, abs=2e-4)
    assert len(survey.observations.levels) == 100
    assert rows_of(check_survey(folder), "Found")["water"].endswith(
        "; known: level to 0.015 m (gnss_points, 100 measured)"
    )
    assert survey.observations.levels[1].place == (E0 + 5, N0 - 3)
    assert {(level.std_m, level.time, level.source) for level in survey.observations.levels} == {
        (0.02, None, "gnss_points")
    }


def test_points_count_as_much_as_they_are_sure(tmp_path):
    fit = fit_surface(np.array([[0.0, 0.0, 1.0], [9.0, 0.0, 1.0], [0.0, 9.0, 1.3]]), np.array([0.01, 0.01, 0.1]))
    # Weights of 1, 1 and 0.01, as far as the third is no outlier.
    assert fit.level_m == pytest.approx(1.0 + 0.3 * 0.01 / 2.01, abs=1e-3)
    assert fit.covariance[0, 0] ** 0.5 >= 0.01 / 2.01**0.5
    (tmp_path / "p.csv").write_text("easting,northing,height,std\n1,2,3,0.005\n1,2,3,\n")
    stds = [each.std_m for each in points_of_surface(tmp_path / "p.csv", "shoreline", CRS)[0]]
    assert stds == [0.005, 0.03]
    (tmp_path / "p.csv").write_text("easting,northing,height,std\n1,2,3,0\n")
    with pytest.raises(ConfigError, match="std is 0, expected above 0 and at most"):
        points_of_surface(tmp_path / "p.csv", "shoreline", CRS)


def test_heights_of_points_in_feet_become_metres(tmp_path):
    (tmp_path / "p.csv").write_text("easting,northing,height\n600000,4500000,100\n")
    feet = parse_crs("EPSG:6344+6360")  # NAD83(2011) UTM 15N, NAVD88 in US survey feet
    ((point,), _) = points_of_surface(tmp_path / "p.csv", "shoreline", feet)
    assert point.level_m == pytest.approx(30.48006)
