"""A survey folder with few settings or without poses: what is inferred, what is handed to structure from motion."""

import math
from dataclasses import replace

import numpy as np
import pytest
from placed_by_gps import solved
from small_survey import LEVEL, camera_lines, replaced, small_survey, unposed, write_image

from refract.lens import Lens
from survey.errors import ConfigError, PosesError
from survey.folder.found import NO_WATER, image_folder_of
from survey.folder.survey import load_survey
from survey.photos.exif import Exif
from survey.sfm.gps import gps_positions

CRS_ALONE = 'crs = "EPSG:32632+5773"\n'


def with_exif(folder, toml: str):
    """The small survey with a focal length in EXIF, loaded."""
    folder = small_survey(folder, gps=True, toml=toml)
    for i, line in enumerate(camera_lines()):
        e, n, h = (float(v) for v in line.split(",")[1:4])
        write_image(folder / "images" / f"{i:04d}.jpg", gps=(e, n, h), FocalLengthIn35mmFilm=50)
    return load_survey(folder)


def test_a_crs_alone_suffices_and_the_survey_says_what_it_assumed(tmp_path):
    survey = with_exif(tmp_path / "s", CRS_ALONE)
    assert survey.water is None
    assert survey.views[0].camera.fx == pytest.approx(50.0 / 36.0 * 64.0)
    said = "\n".join(survey.findings.assumptions)
    assert all(words in said for words in ("only poses found", "from EXIF and not a calibration", "centre"))
    # Nobody said that all ground is dry: the verdict of a run is amber.
    assert NO_WATER in survey.findings.warnings


@pytest.mark.parametrize(
    ("toml", "is_wet", "is_doubted"),
    [
        ("dry = false", False, True),
        ("dry = true", False, False),
        ("[water]\nlevel_m = 2105.0", True, False),
        ("[water]\nlevel_m = 2105.0\nrefractive_index = 1.34\nlevel_std_m = 0.1", True, False),
    ],
)
def test_a_survey_without_water_is_in_doubt_unless_it_says_that_it_is_dry(tmp_path, toml, is_wet, is_doubted):
    survey = with_exif(tmp_path / "s", CRS_ALONE + toml)
    assert (survey.water is not None, NO_WATER in survey.findings.warnings) == (is_wet, is_doubted)


@pytest.mark.parametrize("toml", ['name = "quarry"', "[water]\nlevel_m = 2105.0\n"])
def test_settings_need_a_crs_and_the_error_proposes_one(tmp_path, toml):
    folder = small_survey(tmp_path / "s", gps=True, toml=toml)
    with pytest.raises(ConfigError, match=r'crs is missing; .*crs = "EPSG:32632\+5773"'):
        load_survey(folder)


def test_dry_ground_has_no_water(tmp_path):
    folder = small_survey(tmp_path / "s", toml="dry = true\n[water]\nlevel_m = 2105.0\n")
    with pytest.raises(ConfigError, match="dry = true says that no ground is under water"):
        load_survey(folder)


def test_without_survey_toml_it_says_what_writes_it(tmp_path):
    with pytest.raises(ConfigError, match=r"bathynerf init \(bathynerf\.init in Python\) writes it"):
        load_survey(small_survey(tmp_path / "a", gps=True, toml=None))


@pytest.mark.parametrize(
    ("places", "folder"),
    [
        (("images", "100MEDIA"), "images"),
        ((".", "bathynerf"), "."),
        (("DCIM/100MEDIA",), "DCIM/100MEDIA"),
        (("DCIM/100MEDIA", "DCIM/101MEDIA", "bathynerf", "masks"), "DCIM"),
    ],
)
def test_photographs_are_found_where_a_card_has_them(tmp_path, places, folder):
    for place in places:
        write_image(tmp_path / place / "0000.jpg")
    assert image_folder_of(tmp_path) == folder


def test_photographs_in_several_folders_or_in_none_are_asked_for(tmp_path):
    with pytest.raises(ConfigError, match=r"has no photographs and no survey\.toml; put those of the survey into"):
        image_folder_of(tmp_path)
    for place in ("monday", "tuesday"):
        write_image(tmp_path / place / "0000.jpg")
    with pytest.raises(ConfigError, match="has photographs in monday, tuesday and no"):
        image_folder_of(tmp_path)


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
    folder = unposed(tmp_path / "s")
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
    folder = unposed(tmp_path / "s", (f"level_m = {LEVEL}", 'clicks = "clicks.csv"'))
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
    folder = unposed(tmp_path / "s")
    with pytest.raises(PosesError, match="found the poses of 2 of 4 images, expected at least 3"):
        load_survey(folder)


def test_a_level_that_cannot_fit_the_heights_in_exif_stops_before_structure_from_motion(tmp_path, monkeypatch):
    calls = solved(monkeypatch, [])
    folder = unposed(tmp_path / "s", (f"{LEVEL}", "2605.0"))
    with pytest.raises(ConfigError, match=r"EXIF has the cameras at 2125.0 to 2125.0 m, all of them under the water"):
        load_survey(folder)
    assert calls == []
