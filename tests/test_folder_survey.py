"""A survey folder: cameras and water in the local frame, and every way in which a folder can be spoilt."""

import re

import numpy as np
import pytest
from PIL import Image
from pyproj import Transformer
from small_survey import CRS, E0, LEVEL, N0, TOML, camera_lines, replaced, small_survey, write_image, write_poses

from geo.errors import GeoError
from refract.media import converted_index
from survey.errors import ConfigError, ImageError, PosesError, SurveyError
from survey.folder.found import NO_WATER
from survey.folder.survey import load_survey
from survey.photos.images import LUMA, load_image
from survey.settings.config import dump_config, parse_config

# Over 30 m, grid metres and true ones differ by 0.0007 (scale and height) on a rise of 0.006 * 30 m, and level
# water leaves its plane by 0.07 mm.
SLOPE_TOLERANCE_M = 2e-4


def test_a_correct_survey_loads_without_an_assumption_or_a_warning(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s", gps=True))
    assert (survey.name, survey.findings.assumptions, survey.findings.warnings) == ("small", (), ())
    assert [view.name for view in survey.views] == ["0000.jpg", "0001.jpg", "0002.jpg", "0003.jpg"]
    assert survey.frame.origin == (round(E0 + 4.5), N0 - 3.0, LEVEL)
    assert load_image(survey.views[0]).shape == (48, 64, 3)
    heights = -survey.water.depth(np.array([view.camera.centre for view in survey.views]))
    # 7 m from level_at, water is level to 4 micrometres.
    assert heights == pytest.approx(20.0, abs=1e-5)


def test_a_camera_sees_a_point_of_the_crs_where_the_angles_say(tmp_path):
    # A level camera 20 m over a point sees 2 m of grid north of it 10 px up, but for the scale of the grid (7e-4).
    survey = load_survey(small_survey(tmp_path / "s"))
    below = survey.frame.local_from_crs([[E0, N0, LEVEL], [E0, N0 + 2.0, LEVEL], [E0 + 2.0, N0, LEVEL]])
    pixels = survey.views[0].camera.project(below, None)
    assert pixels == pytest.approx(np.array([[32.0, 24.0], [32.0, 14.0], [42.0, 24.0]]), abs=0.01)


def test_a_sloped_plane_stands_at_its_height_over_known_points_of_the_grid(tmp_path):
    toml = replaced(("refractive_index", "slope_east = -0.002\nslope_north = 0.006\nrefractive_index"))
    survey = load_survey(small_survey(tmp_path / "s", toml=toml))
    for east, north, height in [(0, 0, 0.0), (30, 0, -0.06), (0, 30, 0.18), (-20, -10, -0.02)]:
        point = survey.frame.local_from_crs([E0 + east, N0 + north, LEVEL + height])
        assert abs(float(survey.water.depth(point))) < SLOPE_TOLERANCE_M
        assert float(survey.water.height(point[0], point[1])) == pytest.approx(point[2], abs=SLOPE_TOLERANCE_M)


def test_the_plane_touches_under_the_middle_of_the_cameras_unless_level_at_says_otherwise(tmp_path):
    survey = load_survey(
        small_survey(tmp_path / "s", toml=replaced((f"level_at = [{E0}, {N0}]", "slope_north = 0.01")))
    )
    assert survey.config.water.level_at == pytest.approx((E0 + 4.5, N0 - 3.0), abs=1e-3)
    middle = survey.frame.local_from_crs([E0 + 4.5, N0 - 3.0, LEVEL])
    assert float(survey.water.depth(middle)) == pytest.approx(0.0, abs=1e-6)


def test_the_settings_that_took_effect_make_the_same_survey_again(tmp_path):
    toml = replaced((f"level_at = [{E0}, {N0}]\nrefractive_index = 1.333", "temperature_c = 12\nsalinity_psu = 7"))
    folder = small_survey(tmp_path / "s", toml=toml)
    first = load_survey(folder)
    assert first.config.water.temperature_c is None
    (folder / "survey.toml").write_text(dump_config(first.config))
    second = load_survey(folder)
    assert parse_config(dump_config(first.config)) == first.config == second.config
    assert second.water == first.water


def test_without_water_a_survey_is_dry(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s", toml=TOML[: TOML.index("[water]")]))
    assert survey.water is None
    assert survey.config.water is None
    with pytest.raises(SurveyError, match=r"small is a dry survey, expected one with water; give \[water\]"):
        survey.require_water()


def test_a_geographic_crs_with_ellipsoidal_heights_works_like_a_projected_one(tmp_path):
    folder = small_survey(tmp_path / "s")
    by_grid = load_survey(folder)
    centres = np.array([view.camera.centre for view in by_grid.views])
    places = _lonlat(by_grid.frame.crs_from_local(centres))
    write_poses(folder, [f"{i:04d}.jpg,{p[0]:.12f},{p[1]:.12f},{p[2]:.6f},0,0,0" for i, p in enumerate(places)])
    toml = replaced((CRS, "EPSG:4937"), (f"level_at = [{E0}, {N0}]", "slope_east = 0.001"))
    (folder / "survey.toml").write_text(toml)
    survey = load_survey(folder)
    # Both frames are true to scale, so cameras are as far apart; 1e-12 degrees are 1e-7 m.
    by_degrees = np.array([view.camera.centre for view in survey.views])
    apart, expected = (np.linalg.norm(c[:, None] - c[None], axis=-1) for c in (by_degrees, centres))
    assert apart == pytest.approx(expected, abs=1e-6)
    # Longitude runs east, so the water rises by 1 mm over each metre of local x.
    assert (survey.water.slope_x, survey.water.slope_y) == pytest.approx((1e-3, 0.0), abs=1e-6)


def _lonlat(points):
    to_lonlat = Transformer.from_crs("EPSG:25832", "EPSG:4258", always_xy=True)
    lon, lat = to_lonlat.transform(points[:, 0], points[:, 1])
    return np.column_stack([lon, lat, points[:, 2]])


def test_heights_in_feet_meet_a_level_in_metres(tmp_path):
    # EPSG:6318 + 6360: NAD83(2011) longitude and latitude with NAVD88 heights in US survey feet.
    folder = small_survey(tmp_path / "s")
    foot = 1200.0 / 3937.0
    lines = [f"{i:04d}.jpg,{-90.0 + 2e-5 * i:.8f},45.0,{(100.0 + 20.0) / foot:.6f},0,0,0" for i in range(4)]
    write_poses(folder, lines)
    toml = replaced((CRS, "EPSG:6318+6360"), (f"{LEVEL}", "100.0"), (f"level_at = [{E0}, {N0}]", ""))
    (folder / "survey.toml").write_text(toml)
    survey = load_survey(folder)
    heights = -survey.water.depth(np.array([view.camera.centre for view in survey.views]))
    # Heights are written to 3e-7 m; within 3 m of where it touches the plane leaves level water by 1e-6 m.
    assert heights == pytest.approx(20.0, abs=2e-6)


def spoilt(old, new, *, every=False):
    """Lines of poses, the second or all of them changed."""
    return [line.replace(old, new) if every or i == 1 else line for i, line in enumerate(camera_lines())]


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (
            spoilt(".jpg", "_corrected.tif", every=True),
            'only 0 of the 4 poses .* make the names .* those of the images .*"0000_corrected.tif" against "0000.jpg"',
        ),
        (camera_lines(1), "only 1 of the 1 poses .* expected at least 2; add photographs with poses"),
        (spoilt("2125.000", "2104.500"), r"camera of 0001\.jpg at 2104\.50 m lies 0\.50 m under the water"),
        (spoilt(",0,0,", ",180,0,", every=True), "4 of 4 cameras look up at the sky"),
        (
            ["0001.jpg,9.5,46.2,2125,0,0,0", *spoilt("0001", "gone")],
            r"camera of 0001\.jpg at 9\.5, 46\.\d+, 2125 lies .* km from the others",
        ),
        (
            [f"0001.jpg,1e11,{N0},2125,0,0,0", *spoilt("0001", "gone")],
            r"of 0001\.jpg in .*cameras\.csv is not on the map",
        ),
    ],
)
def test_poses_that_cannot_be_are_refused_by_name(tmp_path, lines, words):
    folder = small_survey(tmp_path / "s", num=1 if len(lines) == 1 else 4)
    write_poses(folder, lines)
    with pytest.raises(PosesError, match=words):
        load_survey(folder)


@pytest.mark.parametrize(
    ("old", "new"),
    # Other systems, and the archives that they pack, write an umlaut as a letter and a mark.
    [(".jpg", ""), (".jpg", ".JPG"), ("0001", "\u00fcfer")],
)
def test_names_match_without_their_ending_in_other_case_and_however_an_accent_is_written(tmp_path, old, new):
    folder = small_survey(tmp_path / "s")
    if old == "0001":
        (folder / "images" / "0001.jpg").rename(folder / "images" / "u\u0308fer.jpg")
    write_poses(folder, spoilt(old, new))
    assert len(load_survey(folder).views) == 4


def test_two_views_are_a_survey_whose_heights_no_third_one_checks(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s", num=2))
    assert any("no third view checks a height" in warning for warning in survey.findings.warnings)


def test_a_single_camera_far_over_the_water_is_doubted(tmp_path):
    folder = small_survey(tmp_path / "s")
    write_poses(folder, spoilt("2125.000", "3125.000"))
    assert load_survey(folder).findings.warnings == (
        "1 camera more than 300 m over the water: check that both count from one datum: 0001.jpg",
        "1 image far from the others by its pose height, which are at 2125.0 to 2125.0 m: 0001.jpg (3125.0 m)",
    )


@pytest.mark.parametrize(
    ("given", "index", "said"),
    [
        # White noise is no texture: 1.333 of the sodium line, for the weights of luma.
        ("", converted_index(1.333, 589.3, LUMA), ["refractive_index = .*, fresh water .the sea has 1.340.* 589.3 nm"]),
        # The mean of Quan and Fry at 610, 540 and 460 nm by the weights of luma.
        ("temperature_c = 20", 1.334465, ["salinity_psu = 0, fresh water", ".*, of water of 20 degrees .* of 547 nm"]),
        (
            "temperature_c = 33\nsalinity_psu = 40",
            1.340243,
            [".*although temperature_c is 33, outside the range 0 to 30 of Quan .* salinity_psu is 40, outside"],
        ),
        ("temperature_c = -3\nsalinity_psu = 35", None, r"survey\.toml: temperature_c is -3, but .* freezes at -1\.92"),
    ],
)
def test_what_is_not_given_of_the_water_is_said_to_be_assumed_and_ice_is_refused(tmp_path, given, index, said):
    folder = small_survey(tmp_path / "s", toml=replaced(("refractive_index = 1.333", given)))
    if index is None:
        with pytest.raises(ConfigError, match=said):
            load_survey(folder)
        return
    survey = load_survey(folder)
    assert survey.water.n_water == pytest.approx(index, abs=1e-6)
    assert (survey.config.water.index_std == 0.004) == (given == "")
    for text, words in zip(survey.findings.assumptions, said, strict=True):
        assert re.match(words, text)


def test_images_without_a_pose_and_poses_without_an_image_are_named_and_left_out(tmp_path):
    folder = small_survey(tmp_path / "s", num=5)
    lines = camera_lines(5)
    write_poses(folder, [*lines[:4], lines[4].replace("0004", "gone")])
    survey = load_survey(folder)
    assert len(survey.views) == 4
    assert survey.findings.warnings == (
        "1 image without a pose, left out: 0004.jpg",
        "1 pose without an image, left out: gone.jpg",
    )


@pytest.mark.parametrize(("height", "spacing", "is_refused"), [(500.0, 60.0, False), (5000.0, 60.0, True)])
def test_heights_of_aircraft_are_taken_where_the_overlap_of_photographs_allows_them(
    tmp_path, height, spacing, is_refused
):
    folder = small_survey(tmp_path / "s")
    lines = [f"000{i}.jpg,{E0 + i * spacing},{N0},{LEVEL + height},0,0,0" for i in range(4)]
    (folder / "cameras.csv").write_text("\n".join(["image,easting,northing,height,omega,phi,kappa", *lines]))
    if is_refused:
        with pytest.raises(ConfigError, match=r"all of them more than \d+ m over the water; give level_m"):
            load_survey(folder)
    else:
        assert any("more than 300 m over the water" in warning for warning in load_survey(folder).findings.warnings)


@pytest.mark.parametrize(
    ("pairs", "kind", "words"),
    [
        ([(CRS, "EPSG:25832")], GeoError, "has no vertical part; add a vertical CRS"),
        ([(CRS, "EPSG:9999999")], GeoError, "not a known coordinate reference system"),
        ([(f'crs = "{CRS}"', "")], ConfigError, "survey.toml: crs is missing; give that of all positions and heights"),
        ([(f"{LEVEL}", "2605.0")], ConfigError, "the cameras are at 2125.0 to 2125.0 m, all of them under the water"),
        ([(f"{LEVEL}", "1605.0")], ConfigError, "all of them more than 300 m over the water; give level_m"),
        (
            [(f"[{E0}, {N0}]", "[9e9, 9e9]")],
            ConfigError,
            "level_at has a place at 9000000000, 9000000000, which is not on",
        ),
        ([('"cameras.csv"', '"poses.csv"')], PosesError, "poses.csv do not exist; correct [cameras] poses"),
        ([("[64, 48]", "[64, 64]")], ImageError, "0000.jpg has 64 x 48 pixels, expected 64 x 64"),
        ([("focal_px = 100.0", "")], ConfigError, "focal_px is missing from [cameras]"),
        ([('"PINHOLE"', '"PINHOL"')], ConfigError, '[cameras] model is "PINHOL" in survey.toml, expected one of'),
        ([('"PINHOLE"', '"RADIAL"')], ConfigError, "distortion has 0 numbers in survey.toml, expected 2"),
        ([('"PINHOLE"', '"RADIAL"'), ("100.0", "[100, 99]")], ConfigError, "model RADIAL has one focal length"),
        ([("[cameras]", "[images]\nmasks = 'm'\n[cameras]")], ImageError, "mask folder"),
        ([("[water]", "[area]\nbounds = [0, 0, 9, 9]\n[water]")], ConfigError, "km from the nearest camera"),
        (
            [("[water]", "[area]\nbounds = [7e5, 5e6, 8e5, 6e6]\n[water]")],
            ConfigError,
            "from the nearest camera, which is at 589021, 5194730; give them in crs",
        ),
    ],
)
def test_a_spoilt_survey_toml_is_named_with_the_mend(tmp_path, pairs, kind, words):
    folder = small_survey(tmp_path / "s", toml=replaced(*pairs))
    with pytest.raises(kind) as error:
        load_survey(folder)
    assert words in str(error.value)


def test_a_damaged_image_and_missing_images_are_refused(tmp_path):
    folder = small_survey(tmp_path / "s")
    path = folder / "images" / "0002.jpg"
    path.write_bytes(path.read_bytes()[:1500])
    with pytest.raises(ImageError, match=r"0002\.jpg is damaged or cut off"):
        load_survey(folder)
    for image in (folder / "images").iterdir():
        image.unlink()
    with pytest.raises(ImageError, match="no images in"):
        load_survey(folder)


def test_a_folder_that_does_not_exist_or_is_a_file_is_refused(tmp_path):
    with pytest.raises(SurveyError, match="nowhere does not exist; expected a folder with photographs"):
        load_survey(tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    with pytest.raises(SurveyError, match="file is a file"):
        load_survey(tmp_path / "file")


def test_the_only_poses_are_taken_and_named(tmp_path):
    folder = small_survey(tmp_path / "s", toml=replaced(('poses = "cameras.csv"', "")))
    survey = load_survey(folder)
    assert survey.findings.assumptions == ("the poses are those in cameras.csv, the only poses found",)
    assert survey.config.cameras.poses == "cameras.csv"


def test_local_poses_need_an_origin_and_take_their_frame_from_it(tmp_path):
    folder = small_survey(tmp_path / "s")
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 SIMPLE_RADIAL 64 48 120 32 24 0.01\n")
    lines = [f"{i + 1} 0 1 0 0 {-3 * i} 0 20 1 {i:04d}.jpg\n" for i in range(4)]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    toml = replaced(("cameras.csv", "sparse/0"))
    (folder / "survey.toml").write_text(toml)
    with pytest.raises(ConfigError, match=r"in a local frame, .* give \[local\] origin"):
        load_survey(folder)
    (folder / "survey.toml").write_text(toml + f"[local]\norigin = [{E0}, {N0}, {LEVEL}]\n")
    survey = load_survey(folder)
    assert survey.frame.origin == (E0, N0, LEVEL)
    centres = [view.camera.centre for view in survey.views]
    assert centres == pytest.approx(np.array([[3.0 * i, 0.0, 20.0] for i in range(4)]), abs=1e-12)
    assert survey.views[0].lens.model == "SIMPLE_RADIAL"
    (lens,), bent = survey.findings.warnings, survey.findings.assumptions[-1]
    assert lens.startswith(
        "[cameras] model = PINHOLE and [cameras] focal_px = 100.0 in survey.toml has no effect: spar"
    )
    assert lens.endswith(": sparse/0 has a lens of its own (SIMPLE_RADIAL, 64 x 48 px, focal length 120.0 px)")
    assert bent.startswith("COLMAP ignores refraction")


@pytest.mark.parametrize(
    ("model", "focal", "distortion", "params"),
    [
        ("SIMPLE_RADIAL", "90", "[0.1]", (90.0, 31.0, 25.0, 0.1)),
        ("RADIAL", "90", "[0.1, 0.2]", (90.0, 31.0, 25.0, 0.1, 0.2)),
        ("OPENCV", "[90, 91]", "[0.1, 0.2, 3e-3, 4e-3]", (90.0, 91.0, 31.0, 25.0, 0.1, 0.2, 3e-3, 4e-3)),
        ("FULL_OPENCV", "90", str([0.1] * 8), (90.0, 90.0, 31.0, 25.0, *[0.1] * 8)),
    ],
)
def test_a_lens_is_taken_from_survey_toml_in_the_order_of_its_model(tmp_path, model, focal, distortion, params):
    toml = replaced(
        ('model = "PINHOLE"', f'model = "{model}"\ndistortion = {distortion}'),
        ("focal_px = 100.0", f"focal_px = {focal}"),
        ("[32.0, 24.0]", "[31.0, 25.0]"),
    )
    lens = load_survey(small_survey(tmp_path / "s", toml=toml)).views[0].lens
    assert (lens.model, lens.params) == (model, params)


def test_masks_are_found_by_the_name_of_their_image(tmp_path):
    folder = small_survey(tmp_path / "s", toml=replaced(("[cameras]", "[images]\nmasks = 'masks'\n[cameras]")))
    (folder / "masks").mkdir()
    with pytest.raises(ImageError, match=r"no mask in .* is named like an image"):
        load_survey(folder)
    for name in ("0000.png", "0001.jpg.png", "0002.jpg"):
        Image.new("L", (64, 48), 255).save(folder / "masks" / name)
    survey = load_survey(folder)
    assert [view.mask_path and view.mask_path.name for view in survey.views] == [
        "0000.png",
        "0001.jpg.png",
        "0002.jpg",
        None,
    ]
    assert survey.findings.warnings == ("1 image without a mask, used whole: 0003.jpg",)


def test_poses_far_from_the_positions_in_exif_are_doubted(tmp_path):
    folder = small_survey(tmp_path / "s", gps=True)
    write_poses(folder, [line.replace("58901", "58911").replace("58902", "58912") for line in camera_lines()])
    toml = replaced((f"level_at = [{E0}, {N0}]", ""))
    (folder / "survey.toml").write_text(toml)
    (warning,) = load_survey(folder).findings.warnings
    assert warning.startswith("poses lie 100 m (median) from GPS positions; check crs")


def test_an_image_that_exif_marks_as_rotated_is_reported_as_used_as_stored(tmp_path):
    folder = small_survey(tmp_path / "s")
    write_image(folder / "images" / "0001.jpg", Orientation=6)
    (first, *_) = load_survey(folder).findings.warnings
    assert first.startswith("EXIF marks 1 of 4 images as rotated; pixels and poses are taken as stored")
    (folder / "survey.toml").write_text(replaced(("[64, 48]", "[48, 64]"), ("[32.0, 24.0]", "[24.0, 32.0]")))
    write_image(folder / "images" / "0000.jpg", Orientation=6)
    with pytest.raises(ImageError, match=r"EXIF marks it as rotated, which is ignored here"):
        load_survey(folder)


@pytest.mark.parametrize("name", ["quick", "river", "wreck_water", "wreck_dry"])
def test_the_drawn_surveys_load_without_an_assumption_or_a_warning(data_dir, name):
    survey = load_survey(data_dir / name)
    # Nothing there says that it is dry.
    said = (NO_WATER,) if name == "wreck_dry" else ()
    assert (survey.findings.assumptions, survey.findings.warnings) == ((), said)
    assert (survey.water is None) == (name == "wreck_dry")


def test_level_water_is_followed_from_where_its_plane_touches(tmp_path):
    toml = replaced((f"level_at = [{E0}, {N0}]", f"level_at = [{E0 + 1000.0}, {N0}]"))
    survey = load_survey(small_survey(tmp_path / "s", toml=toml))
    assert survey.findings.warnings == ()
    # Of 1000 m on the grid 1000.5 m are left without its scale and height; so far level water falls 7.9 cm.
    over = survey.observations.departure.at(np.zeros((1, 2)))[0]
    assert over == pytest.approx(-0.079, abs=2e-3)


@pytest.mark.parametrize("off", [-12.0, 15.0, 400.0])
def test_a_pose_whose_height_is_far_from_the_others_is_named(tmp_path, off):
    lines = camera_lines(8)
    name, e, n, h, *angles = lines[3].split(",")
    lines[3] = ",".join([name, e, n, str(float(h) + off), *angles])
    folder = small_survey(tmp_path, num=8)
    write_poses(folder, lines)
    warnings = load_survey(folder).findings.warnings
    assert any("far from the others by its pose height" in text and name in text for text in warnings)
