"""Vertical datums: heights that cannot belong together, what would explain it, and grids of geoids beside the data."""

import gzip
import shutil
from dataclasses import replace

import numpy as np
import pytest
from pyproj import datadir
from small_survey import LEVEL, camera_lines, replaced, small_survey, unposed, write_poses

from geo.compatibility import approximate_undulation_m
from geo.crs import parse_crs
from geo.transformation import use_grids
from survey.errors import ConfigError
from survey.folder.found import find_survey
from survey.folder.heights import exif_height_warnings, explanation, xmp_height_warnings
from survey.folder.survey import load_survey
from survey.photos.exif import Exif
from survey.plan.check import require_processable
from survey.sfm.gps import gps_positions

CRS = parse_crs("EPSG:25832+5778")
ALPS = (46.9, 10.17)
# What the rough table has there; EGM96 has 49.
UNDULATION = approximate_undulation_m(*ALPS)
HEAD = Exif((64, 48), None, None, 1, "", None)


def test_the_rough_geoid_is_near_known_places():
    # EGM96 at the Alps, in Minnesota, south of India, and on both sides of the date line.
    assert pytest.approx(49.0, abs=8.0) == UNDULATION
    assert approximate_undulation_m(46.84, -91.99) == pytest.approx(-31.0, abs=8.0)
    assert approximate_undulation_m(4.7, 78.8) == pytest.approx(-106.0, abs=8.0)
    assert approximate_undulation_m(0.0, 180.0) == approximate_undulation_m(0.0, -180.0)
    assert approximate_undulation_m(90.0, 77.0) == approximate_undulation_m(90.0, 0.0)


def test_ellipsoidal_cameras_over_a_level_above_the_sea_are_explained():
    why = explanation(20.0 + 49.0, LEVEL, ALPS, CRS, 20.0)
    assert f"the geoid lies about {UNDULATION:.0f} m over the ellipsoid here" in why
    assert "heights of the cameras above the ellipsoid with a level above the sea would explain it" in why
    assert "and a level above the ellipsoid" not in why


def test_the_other_way_round_is_told_from_it():
    why = explanation(20.0 - 49.0, LEVEL, ALPS, CRS, 20.0)
    assert "a level above the ellipsoid with heights of the cameras above the sea would explain it" in why
    assert "heights of the cameras above the ellipsoid" not in why


def test_heights_over_the_start_and_in_feet_are_recognised():
    assert "heights of the cameras over the take-off point instead" in explanation(40.0 - LEVEL, LEVEL, ALPS, CRS, 40.5)
    cameras = (LEVEL + 30.0) / 0.3048
    assert "heights of the cameras in feet would explain it: the cameras would be 30 m" in (
        explanation(cameras - LEVEL, LEVEL, ALPS, CRS, None)
    )
    feet = parse_crs("EPSG:6344+6360")
    # 100 ft, given as if metres, under cameras at 50 m.
    assert "a level in the unit of crs instead of metres" in explanation(-50.0, 100.0, (45.0, -93.0), feet, None)


def test_nothing_is_explained_where_nothing_would():
    assert explanation(900.0, LEVEL, ALPS, CRS, 40.0) == ""


def test_a_level_above_the_ellipsoid_is_refused_with_the_reason(tmp_path):
    folder = small_survey(tmp_path / "s", toml=replaced((f"level_m = {LEVEL}", f"level_m = {LEVEL + 49.0}")))
    with pytest.raises(ConfigError, match=r"all of them under the water; .* a level above the ellipsoid with heights"):
        load_survey(folder)


def test_without_poses_exif_is_held_against_the_level_too(tmp_path):
    folder = unposed(tmp_path / "s", (f"level_m = {LEVEL}", f"level_m = {LEVEL + 49.0}"))
    with pytest.raises(ConfigError, match=r"EXIF has the cameras .* a level above the ellipsoid with heights"):
        require_processable(folder)


def test_cameras_nearly_on_the_water_are_doubtful(tmp_path):
    folder = small_survey(tmp_path / "s", num=12)
    lines = [line.replace(f"{LEVEL + 20:.3f}", f"{LEVEL + 1.5:.3f}") for line in camera_lines(12)]
    write_poses(folder, [line.replace(",0,0,", ",0.0,0.0,") for line in lines])
    (folder / "survey.toml").write_text(replaced(("focal_px = 100.0", "focal_px = 20.0")))
    warnings = load_survey(folder).findings.warnings
    assert any("the cameras are only 1.50 m over the water (median)" in text for text in warnings)
    assert not any("only" in text for text in load_survey(small_survey(tmp_path / "b")).findings.warnings)


def heads_at(height: float, **changes) -> dict[str, Exif]:
    return {f"{i}.jpg": replace(HEAD, lat_lon_height=(*ALPS, height), **changes) for i in range(3)}


def test_poses_that_differ_from_exif_by_the_undulation_are_doubtful():
    heights = dict.fromkeys(("0.jpg", "1.jpg", "2.jpg"), LEVEL + 69.0)
    (warning,) = exif_height_warnings(heights, heads_at(LEVEL + 20.0))
    assert warning.startswith("the poses lie 49 m above the heights in EXIF, about as much as the geoid differs")
    assert exif_height_warnings(heights, heads_at(LEVEL + 66.0)) == []
    assert exif_height_warnings(heights, heads_at(LEVEL + 20.0, above_start_m=20.0)) == []
    assert exif_height_warnings(heights, {"0.jpg": HEAD}) == []


def test_what_xmp_says_of_heights_is_held_against_the_settings(tmp_path):
    (warning,) = xmp_height_warnings("crs", CRS, heads_at(100.0, height_datum="ellipsoidal"))
    assert warning.startswith("XMP says that the heights of 3 of 3 images count from the ellipsoid")
    assert 'write gps_height = "ellipsoidal" in [cameras]' in warning
    assert xmp_height_warnings("ellipsoidal", CRS, heads_at(100.0, height_datum="ellipsoidal")) == []
    (warning,) = xmp_height_warnings("ellipsoidal", CRS, heads_at(100.0, height_datum="EGM96"))
    assert "count from EGM96" in warning
    assert xmp_height_warnings("crs", CRS, heads_at(100.0, height_datum="EGM96")) == []
    assert xmp_height_warnings("crs", parse_crs("EPSG:4979"), heads_at(100.0, height_datum="ellipsoidal")) == []


@pytest.fixture
def own_grids():
    """PROJ's folders as they were, after the test."""
    before = datadir.get_data_dir()
    yield
    datadir.set_data_dir(before)


def test_a_grid_beside_the_data_takes_ellipsoidal_heights_to_the_sea(tmp_path, data_dir, own_grids):
    folder = unposed(
        tmp_path / "s",
        ("EPSG:25832+5778", "EPSG:25832+5773"),
        ("[water]", "[water]\nlevel_std_m = 0.05"),
        ("focal_px", 'gps_height = "ellipsoidal"\nfocal_px'),
    )
    found = find_survey(folder)
    with pytest.raises(ConfigError, match=r"us_nga_egm96_15\.tif is not installed; .* the folder geoid of the survey"):
        gps_positions(found.headers, found.crs, "ellipsoidal")
    (folder / "geoid").mkdir()
    packed = data_dir / "real" / "geoid" / "egm96_15.gtx.gz"
    with gzip.open(packed) as grid, (folder / "geoid" / "egm96_15.gtx").open("wb") as file:
        shutil.copyfileobj(grid, file)
    found = find_survey(folder)
    gps = gps_positions(found.headers, found.crs, "ellipsoidal")
    heights = gps.frame.crs_from_local(np.array(list(gps.local.values())))[:, 2]
    # EGM96 lies 49.2 to 49.8 m over the ellipsoid about 46.9 N, 10.17 E.
    np.testing.assert_allclose(heights, LEVEL + 20.0 - 49.5, atol=1.0)


def test_grids_are_named_once_and_other_files_are_none(tmp_path, own_grids):
    assert use_grids(tmp_path / "none") == []
    (tmp_path / "notes.txt").write_text("")
    before = datadir.get_data_dir()
    assert use_grids(tmp_path) == []
    assert datadir.get_data_dir() == before
    (tmp_path / "a.gtx").write_bytes(b"")
    assert [path.name for path in use_grids(tmp_path)] == ["a.gtx"]
    use_grids(tmp_path)
    assert datadir.get_data_dir().count(str(tmp_path.resolve())) == 1
