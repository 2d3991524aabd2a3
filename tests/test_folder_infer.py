"""A survey folder without survey.toml or without poses: what is inferred, what is handed to structure from motion."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from placed_by_gps import solved
from small_survey import LEVEL, camera_lines, replaced, small_survey, write_image, write_poses

from refract.lens import Lens
from survey.errors import ConfigError, ControlError, PosesError
from survey.folder.found import find_survey
from survey.folder.infer import NO_WATER, config_of_images
from survey.folder.survey import load_survey
from survey.photos.exif import Exif
from survey.settings.config import SurveyConfig
from survey.sfm.gps import gps_positions


def test_without_survey_toml_the_zone_comes_from_the_positions_and_it_says_what_it_assumed(tmp_path):
    folder = small_survey(tmp_path / "s", gps=True, toml=None)
    for i, line in enumerate(camera_lines()):
        e, n, h = (float(v) for v in line.split(",")[1:4])
        write_image(folder / "images" / f"{i:04d}.jpg", gps=(e, n, h), FocalLengthIn35mmFilm=50)
    survey = load_survey(folder)
    assert survey.config.crs == "EPSG:32632+5773"
    assert survey.water is None
    assert survey.views[0].camera.fx == pytest.approx(50.0 / 36.0 * 64.0)
    said = "\n".join(survey.findings.assumptions)
    for words in (
        "only poses found",
        'crs = "EPSG:32632+5773"',
        "from EXIF and not a calibration",
        "centre",
    ):
        assert words in said
    # Nobody said that all ground is dry: the verdict of a run is amber.
    assert NO_WATER in survey.findings.warnings


@pytest.mark.parametrize(
    ("toml", "is_wet", "is_doubted"),
    [
        ('name = "quarry"', False, True),
        ('crs = "EPSG:32632+5773"', False, True),
        ("dry = false", False, True),
        ("dry = true", False, False),
        ('crs = "EPSG:32632+5773"\ndry = true', False, False),
        ("[water]\nlevel_m = 2105.0", True, False),
        ("[water]\nlevel_m = 2105.0\nrefractive_index = 1.34\nlevel_std_m = 0.1", True, False),
    ],
)
def test_a_survey_without_water_is_in_doubt_unless_it_says_that_it_is_dry(tmp_path, toml, is_wet, is_doubted):
    folder = small_survey(tmp_path / "s", gps=True, toml=toml)
    for i, line in enumerate(camera_lines()):
        e, n, h = (float(v) for v in line.split(",")[1:4])
        write_image(folder / "images" / f"{i:04d}.jpg", gps=(e, n, h), FocalLengthIn35mmFilm=50)
    survey = load_survey(folder)
    assert survey.config.crs == "EPSG:32632+5773"
    assert (survey.water is not None, NO_WATER in survey.findings.warnings) == (is_wet, is_doubted)
    assert is_wet == any(
        "level of the water counts from mean sea level" in said for said in survey.findings.assumptions
    )


@pytest.mark.parametrize("place", ["level_at = [589012.0, 5194736.0]", "slope_north = 0.004"])
def test_water_that_has_a_place_needs_the_crs_of_it(tmp_path, place):
    folder = small_survey(tmp_path / "s", gps=True, toml=f"[water]\nlevel_m = 2105.0\n{place}\n")
    with pytest.raises(ConfigError, match="crs is missing"):
        load_survey(folder)


def test_dry_ground_has_no_water(tmp_path):
    folder = small_survey(tmp_path / "s", toml="dry = true\n[water]\nlevel_m = 2105.0\n")
    with pytest.raises(ConfigError, match="dry = true says that no ground is under water"):
        load_survey(folder)


def test_images_in_the_survey_folder_itself_are_found_and_those_of_a_run_are_not(tmp_path):
    folder = small_survey(tmp_path / "s", gps=True, toml=None)
    (folder / "cameras.csv").unlink()
    for image in list((folder / "images").iterdir()):
        image.rename(folder / image.name)
    (folder / "images").rmdir()
    write_image(folder / "bathynerf" / "depth.png")
    found = find_survey(folder)
    assert list(found.images) == ["0000.jpg", "0001.jpg", "0002.jpg", "0003.jpg"]
    assert found.poses_path is None


def test_without_survey_toml_poses_have_to_fit_the_positions(tmp_path):
    folder = small_survey(tmp_path / "s", gps=True, toml=None)
    write_poses(folder, [line.replace(",589", ",489") for line in camera_lines()])
    with pytest.raises(ConfigError, match="does not fit the GPS positions of the images in the UTM zone"):
        load_survey(folder)


def test_nothing_to_infer_a_survey_from_is_an_error_with_an_example(tmp_path):
    folder = small_survey(tmp_path / "a", toml=None)
    with pytest.raises(ConfigError, match=r"no survey\.toml and no image a GPS position.* crs = "):
        load_survey(folder)
    (tmp_path / "b").mkdir()
    with pytest.raises(ConfigError, match=r"no survey\.toml and no images to infer it from; put the photographs"):
        load_survey(tmp_path / "b")


def test_the_control_points_of_opendronemap_tell_the_crs_where_nothing_else_does(tmp_path):
    folder = small_survey(tmp_path / "s", toml=None)
    (folder / "cameras.csv").unlink()
    line = "676120.0 5311480.0 584.2 30.0 20.0 0000.jpg a"
    (folder / "gcp_list.txt").write_text(f"+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs\n{line}\n")
    found = find_survey(folder)
    assert found.config.crs == "EPSG:32632+5773"
    assert found.control is not None
    assert any("that of gcp_list.txt" in text for text in found.findings.assumptions)
    (folder / "gcp_list.txt").write_text("EPSG:4326\n10.1 47.9 584.2 30.0 20.0 0000.jpg a\n")
    with pytest.raises(ConfigError, match=r"not in a projected CRS .* \[control\] gcps"):
        find_survey(folder)


@pytest.mark.parametrize(
    ("header", "crs"),
    [
        ("EPSG:25832", "EPSG:25832+5773"),
        ("EPSG:25832+7837", "EPSG:25832+7837"),
        ("WGS84 UTM 32N", "EPSG:32632+5773"),
        ("+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs", "EPSG:32632+5773"),
    ],
)
def test_the_heights_of_control_points_are_those_of_their_crs_where_it_has_some(tmp_path, header, crs):
    folder = tmp_path / "s"
    write_image(folder / "images" / "0000.jpg")
    (folder / "gcp_list.txt").write_text(f"{header}\n676120 5311480 581 4 5 0000.jpg a\n")
    config, said = config_of_images(folder, SurveyConfig(), {}, None)
    assert config.crs == crs
    assert ("taken as above mean sea level" in said.assumptions[0]) == crs.endswith("5773")
    (folder / "gcp_list.txt").write_text(f"{header}\n")
    with pytest.raises(ControlError, match="has no points after the line with its CRS; add them"):
        config_of_images(folder, SurveyConfig(), {}, None)


def test_without_poses_and_positions_there_is_nothing_to_start_from(tmp_path):
    folder = small_survey(tmp_path / "s", toml=replaced(('poses = "cameras.csv"', "")))
    (folder / "cameras.csv").unlink()
    with pytest.raises(PosesError, match="has no poses file, and 0 of 4 images have a GPS position"):
        load_survey(folder)
    (folder / "flight.nvm").write_text("NVM_V3\n")
    with pytest.raises(PosesError, match=r"flight.nvm is not read: export a COLMAP model instead"):
        load_survey(folder)


@pytest.mark.parametrize(
    ("exif", "missing"),
    [
        (
            {"gps_fault": "longitude's reference (E or W)"},
            r"as longitude's reference \(E or W\) is missing in 5 of the",
        ),
        ({"lat_lon_height": (46.9, 10.2, math.nan)}, "as the altitude is missing in 5 of the images"),
        ({}, "height, expected"),
    ],
)
def test_without_whole_positions_what_is_missing_is_said(exif, missing):
    headers = {f"{i}.jpg": replace(Exif((64, 48), None, None, 1, "", None), **exif) for i in range(5)}
    with pytest.raises(PosesError, match=missing):
        gps_positions(headers, None, "crs")


def test_a_survey_without_poses_is_handed_to_structure_from_motion(tmp_path, monkeypatch):
    calls = solved(monkeypatch, ["0000.jpg", "0001.jpg", "0003.jpg"])
    folder = small_survey(tmp_path / "s", gps=True, toml=replaced(('poses = "cameras.csv"', "")))
    (folder / "cameras.csv").unlink()
    survey = load_survey(folder)
    ((paths, workspace, gps_height, size_px, focal_px),) = calls
    assert [path.name for path in paths] == ["0000.jpg", "0001.jpg", "0002.jpg", "0003.jpg"]
    assert workspace == folder / "bathynerf" / "sfm"
    assert (gps_height, size_px, focal_px) == ("crs", (64, 48), 100.0)
    assert survey.findings.assumptions == ("placed by GPS",)
    assert survey.findings.warnings == ("1 image without a pose, left out: 0002.jpg",)
    assert [view.path.name for view in survey.views] == ["0000.jpg", "0001.jpg", "0003.jpg"]


def test_clicks_tell_the_level_of_a_survey_without_poses_once_it_is_placed(tmp_path, monkeypatch):
    solved(monkeypatch, ["0000.jpg", "0001.jpg", "0002.jpg"])
    level = (f"level_m = {LEVEL}", 'clicks = "clicks.csv"')
    folder = small_survey(tmp_path / "s", gps=True, toml=replaced(('poses = "cameras.csv"', ""), level))
    (folder / "cameras.csv").unlink()
    lines = ["image,x,y,name"]
    lens = Lens("SIMPLE_RADIAL", (100.0, 32.0, 24.0, -0.01), 64, 48)
    for i in range(3):
        camera = lens.camera(np.array([3.0 * i, 0.0, 20.0]), np.diag([1.0, -1.0, -1.0]))
        for name, place in {"stone": (3.0, 1.0, 0.5), "post": (2.5, -2.0, 0.5)}.items():
            x, y = camera.project(np.array(place), None)
            lines.append(f"000{i}.jpg,{x:.5f},{y:.5f},{name}")
    (folder / "clicks.csv").write_text("\n".join(lines))
    survey = load_survey(folder)
    assert survey.provenance.is_level_known
    assert survey.config.water.level_m == pytest.approx(LEVEL + 0.5, abs=1e-4)
    assert len(survey.observations.levels) == 2


def test_structure_from_motion_that_finds_two_poses_is_an_error(tmp_path, monkeypatch):
    solved(monkeypatch, ["0000.jpg", "0001.jpg"])
    folder = small_survey(tmp_path / "s", gps=True, toml=replaced(('poses = "cameras.csv"', "")))
    (folder / "cameras.csv").unlink()
    with pytest.raises(PosesError, match="found the poses of 2 of 4 images, expected at least 3"):
        load_survey(folder)


def test_a_level_that_cannot_fit_the_heights_in_exif_stops_before_structure_from_motion(tmp_path, monkeypatch):
    calls = solved(monkeypatch, [])
    toml = replaced(('poses = "cameras.csv"', ""), (f"{LEVEL}", "2605.0"))
    folder = small_survey(tmp_path / "s", gps=True, toml=toml)
    (folder / "cameras.csv").unlink()
    with pytest.raises(ConfigError, match=r"EXIF has the cameras at 2125.0 to 2125.0 m, all of them under the water"):
        load_survey(folder)
    assert calls == []
