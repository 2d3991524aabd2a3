"""survey.toml: every known key, and a sentence for every mistake."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from survey.errors import ConfigError, SurveyError
from survey.settings.config import SurveyConfig, dump_config, parse_config, read_config

FULL = """
name = 'a "quoted" name'
crs = "EPSG:25832+5778"
dry = false
[images]
dir = "photos"
masks = "masks"
[cameras]
poses = "cameras.csv"
model = "OPENCV"
size_px = [4000, 3000]
focal_px = [3650.5, 3651.0]
principal_point_px = [2000.5, 1499.0]
distortion = [-0.1, 0.02, 1e-4, -2e-5]
gps_height = "ellipsoidal"
position_std_m = [0.02, 0.02, 0.03]
rotation_std_deg = 0.01
rolling_shutter_s = 0.03
rolling_shutter_std_s = 0.005
speed_m_s = 5.5
[water]
level_m = 12.34
level_at = [589012, 5194736]
slope_east = 0.001
slope_north = -0.004
temperature_c = 14
salinity_psu = 7.5
absorption_per_m = [0.3, 0.07, 0.05]
veiling_light = [0, 0.1, 0.2]
level_std_m = 0.05
index_std = 0.001
slope_std = 0.002
[control]
gcps = ["gcp_list.txt", "more.csv"]
marks = "marks.csv"
checkpoints = "checkpoints.csv"
std_m = [0.01, 0.02]
marks_std_px = 0.4
[area]
bounds = [589000, 5194700, 589050, 5194750]
heights = [2.5, 14]
[local]
frame = "topocentric east-north-up"
origin = [589012.0, 5194736.0, 2105.0]
[process]
time_budget_s = 300
device = "cpu"
"""


def test_every_known_key_is_read_and_written_back_to_the_same_settings():
    config = parse_config(FULL)
    assert (config.water.level_m, config.water.slope_north) == (12.34, -0.004)
    assert (config.water.absorption_per_m, config.water.veiling_light) == ((0.3, 0.07, 0.05), (0, 0.1, 0.2))
    assert (config.cameras.position_std_m, config.cameras.rotation_std_deg) == ((0.02, 0.02, 0.03), 0.01)
    assert config.control.files == ("gcp_list.txt", "more.csv", "marks.csv", "checkpoints.csv")
    assert [f.name for f in dataclasses.fields(config) if getattr(config, f.name) is None] == []
    assert parse_config(dump_config(config)) == config


def test_an_empty_file_is_all_defaults_and_survives_the_round_trip():
    assert parse_config("") == SurveyConfig()
    assert parse_config(dump_config(SurveyConfig())) == SurveyConfig()


@given(st.text(st.characters(blacklist_categories=["Cs", "Cc"]), min_size=1).filter(str.strip))
def test_any_name_survives_the_round_trip(name):
    config = SurveyConfig(name=name)
    assert parse_config(dump_config(config)) == config


@given(st.floats(allow_nan=False, allow_infinity=False, min_value=-1e7, max_value=1e7))
def test_any_level_survives_the_round_trip_to_the_last_bit(level):
    config = parse_config(f"[water]\nlevel_m = {level!r}\n")
    assert parse_config(dump_config(config)).water.level_m == level


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[water]\nlevel = 3.0", "unknown key level in [water]; that is [water] level_m here."),
        ("[water]\nwater_level = 3.0", "unknown key water_level in [water]; that is [water] level_m here."),
        ("[water]\nsurface_level = 3.0", "unknown key surface_level in [water]; that is [water] level_m here."),
        ("[water]\nwater_level_m = 3.0", "unknown key water_level_m in [water]; that is [water] level_m here."),
        ("[water]\nslope_nort = 0.1", "the nearest known one is [water] slope_north."),
        ("[camera]\nposes = 'a'", "unknown table [camera]; the nearest known one is [cameras]."),
        ("[cameras]\nfocal = 900", "the nearest known one is [cameras] focal_px."),
        ("naem = 'x'", "the nearest known one is name, above the first table."),
        ("level_m = 3.0", "unknown key level_m; it belongs to [water] level_m."),
        ("[cameras]\nbounds = [0, 0, 1, 1]", "it belongs to [area] bounds."),
        ("[area]\ncrs = 'EPSG:25832+5778'", "it belongs to crs, above the first table."),
        ("[gcp]\nfile = 'a'", "unknown table [gcp]; that is [control] gcps here."),
        ("[water]\nior = 1.3", "that is [water] refractive_index here."),
        ("[volcano]\nlava = 1", "unknown table [volcano]; known are [images], [cameras], [water], [control], [area], "),
        ("[area]\nlava = 1", "unknown key lava in [area]; known are bounds, heights."),
        ("lava = 1", "unknown key lava; known are name, crs, dry."),
    ],
)
def test_an_unknown_key_is_refused_with_a_near_name_its_place_or_what_is_known(text, words):
    with pytest.raises(ConfigError) as error:
        parse_config(text)
    assert words in str(error.value)
    assert str(error.value).endswith(("Correct or remove it", "Move it there, or remove it"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[water]\nlevel_m = nan", "water.level_m is nan, expected a finite number"),
        ("[water]\nlevel_m = 'high'", "water.level_m is 'high', expected a finite number"),
        ("[water]\nlevel_m = true", "water.level_m is True, expected a finite number"),
        (
            "[water]\nlevel_m = 1\nslope_north = 4.0",
            "slope_east and slope_north are 0 and 4, 76 degrees, expected a ri",
        ),
        ("[water]\nlevel_m = 1\nrefractive_index = 0.75", "refractive_index is 0.75, expected 1.0 to 1.6"),
        ("[water]\nlevel_m = 1\nrefractive_index = 1.3\ntemperature_c = 3", "has both refractive_index and temp"),
        ("[water]\nlevel_m = 1\nsalinity_psu = 3", "salinity_psu is given without temperature_c"),
        ("[water]\nlevel_m = 1\nlevel_at = [1, 2, 3]", "water.level_at is [1, 2, 3], expected [easting, northing]"),
        ("[water]\nabsorption_per_m = 0.3", "absorption_per_m is 0.3, expected [red, green, blue], the absorption"),
        ("[water]\nveiling_light = [0, -1, 0]", "veiling_light is [0.0, -1.0, 0.0], expected [red, green, blue]"),
        ("[water]\nabsorption_per_m = [1, 0, 0]", "absorption_per_m is given without veiling_light"),
        ("[water]\nlevel_m = 1\nveiling_light = [0, 0, 0]", "veiling_light is given without absorption_per_m"),
        ("water = 3.0", "water = 3.0 was found where the table [water] was expected"),
        ("[cameras]\nsize_px = [512.0, 384]", "cameras.size_px[0] is 512.0, expected a whole number"),
        ("[cameras]\nsize_px = [0, 384]", "cameras.size_px is [0, 384], expected [width, height] in whole pixels"),
        ("[cameras]\nsize_px = 512", "cameras.size_px is 512, expected [width, height] in whole pixels"),
        ("[cameras]\nfocal_px = -900.0", "focal_px is -900, expected one focal length or [fx, fy] in pixels, above"),
        ("[cameras]\nfocal_px = [900]", "expected one focal length or [fx, fy]"),
        ("[cameras]\ndistortion = [0.1]", "distortion is given without model"),
        ("[cameras]\nmodel = 'RADIAL'\ndistortion = 0.1", "expected a list of coefficients"),
        (
            "[cameras]\ngps_height = 'geoid'",
            'gps_height is "geoid", expected crs (heights in EXIF are heights in crs) or',
        ),
        ("[cameras]\nsize_px = [10, 10]\nprincipal_point_px = [0.0, 0.0]", "lies outside the image"),
        ("[cameras]\nposition_std_m = 0", "position_std_m is 0, expected a standard deviation above 0 and at most 100"),
        ("[cameras]\nposition_std_m = [0.02, 0.03]", "at most 100 metres, one number or [east, north, up]; GPS"),
        ("[cameras]\nposition_std_m = [0.02, 0.02, 300]", "position_std_m is [0.02, 0.02, 300.0], expected a"),
        ("[cameras]\nrotation_std_deg = -1", "cameras.rotation_std_deg is -1, expected"),
        ("[cameras]\nrolling_shutter_s = 30", "rolling_shutter_s is 30, expected seconds from the first to the last"),
        ("[water]\nlevel_m = 1\nlevel_std_m = 0", "water.level_std_m is 0, expected"),
        ("[water]\nlevel_m = 1\nindex_std = 1.3", "index_std is 1.3, expected a standard deviation above 0"),
        ("[water]\nlevel_m = 1\nslope_std = -0.1", "water.slope_std is -0.1, expected"),
        ("[control]\nmarks = 'marks.csv'", "[control] marks is given without gcps"),
        ("[control]\ngcps = []", "gcps is an empty list, expected one file or more"),
        ("[control]\ngcps = 3", "control.gcps is 3, expected a file"),
        ("[control]\nstd_m = [0.01, 0.01, 0.02]", "at most 10 metres, one number or [horizontal, vertical]"),
        ("[control]\nstd_m = 0", "control.std_m is 0, expected a standard deviation above 0 and at most 10 m"),
        ("[control]\nmarks_std_px = 0", "control.marks_std_px is 0, expected"),
        ("[area]\nbounds = [2, 0, 1, 1]", "with low below high"),
        ("[local]\nframe = 'ecef'", 'local.frame is "ecef", expected one of topocentric east-north-up'),
        ("crs = 25832", 'crs is 25832, expected a text with a vertical part, e.g. crs = "EPSG:25832+5778"'),
        ("name = ''", "name is '', expected a text in quotes"),
        ("[water\nlevel_m = 3", "not valid TOML"),
    ],
)
def test_a_wrong_or_contradictory_value_is_named_with_what_was_expected(text, words):
    with pytest.raises(ConfigError) as error:
        parse_config(text)
    assert words in str(error.value)


def test_an_estimate_may_leave_the_range_that_a_file_must_keep():
    water = parse_config("[water]\nlevel_m = 1.0").water
    assert dataclasses.replace(water, refractive_index=0.97, slope_east=0.3).refractive_index == 0.97


def test_an_error_names_the_file(tmp_path):
    path = tmp_path / "survey.toml"
    path.write_text("[water]\nlevel = 3")
    with pytest.raises(SurveyError, match=r"survey\.toml: unknown key level"):
        read_config(path)


def test_a_file_in_another_encoding_is_refused_and_a_byte_order_mark_is_not(tmp_path):
    path = tmp_path / "survey.toml"
    path.write_bytes('name = "Weißensee"'.encode("latin-1"))
    with pytest.raises(ConfigError, match=r"survey\.toml: byte 11 is not UTF-8"):
        read_config(path)
    path.write_bytes('name = "Weißensee"'.encode("utf-8-sig"))
    assert read_config(path).name == "Weißensee"


def test_a_level_that_stands_in_a_file_is_not_known_before_the_file_is_read():
    water = parse_config('[water]\ngauge = "tide.csv"').water
    with pytest.raises(ValueError, match="before the file that"):
        _ = water.known_level_m
    with pytest.raises(ValueError, match="before its default is filled in"):
        _ = water.known_level_at
    read = dataclasses.replace(water, level_m=12.5, level_at=(1.0, 2.0), gauge=None)
    assert (read.known_level_m, read.known_level_at) == (12.5, (1.0, 2.0))


POINT, QUOTES, SLASHES = "with a decimal point", 'write texts in quotes, as "text"', "write paths with /"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[water]\nlevel_m = 12,34", POINT),
        ("[water]\nlevel_m = -0,5 # staff", POINT),
        ("[water]\nlevel_m = 2.105,25", POINT),
        ("[water]\nlevel_m = 2'105.25", POINT),
        ("[water]\nlevel_m = 2 105.25", POINT),
        ("[water]\nlevel_m = 2.105.250", POINT),
        ('[water]\nlevel_m = "12,34"', POINT),
        ('[water]\nlevel_m = "12.34"', "without quotes"),
        ('[water]\nlevel_m = "12.34 m"', "without quotes"),
        ("[water]\nlevel_at = [589012,5, 5194736,25]", POINT),
        ("[area]\nbounds = [1,5, 2,5, 3,5, 4,5]", POINT),
        ("[cameras]\nposition_std_m = 0,03", POINT),
        ("[water]\nlevel_m = 12.34 m", "without a unit"),
        ("[water]\nlevel_m = 12.34m", "without a unit"),
        ("[cameras]\nrotation_std_deg = 1°", "without a unit"),
        ("[water]\nlevel_m = 40 ft", "without a unit"),
        ('[images]\ndir = "C:\\Users\\me"', SLASHES),
        ('[images]\ndir = "C:\\data\\flight"', SLASHES),
        ('[images]\ndir = "D:\\new\\table"', SLASHES),
        ('[cameras]\nposes = "sparse\\0"', SLASHES),
        ('[control]\ngcps = ["a\\b.txt"]', SLASHES),
        ('[control]\ngcps = "\\\\server\\share\\gcps.txt"', SLASHES),
        ("crs = EPSG:25832+5778", QUOTES),
        ("[cameras]\nposes = cameras.csv", QUOTES),
        ("crs = “EPSG:25832+5778”", "straight quotes"),
        ("crs = „EPSG:25832+5778“", "straight quotes"),
        ("dry = True", "true or false"),
        ("dry = yes", "true or false"),
        ("crs: EPSG:25832", "write = between"),
    ],
)
def test_a_habit_is_refused_with_what_to_write(text, words):
    with pytest.raises(ConfigError) as error:
        parse_config(text)
    assert words in str(error.value)


@pytest.mark.parametrize(
    "text",
    [
        "[images]\ndir = 'C:\\data\\new'",
        '[images]\ndir = "C:\\\\data\\\\new"',
        '[images]\ndir = "C:/data/new"',
        "[water]\nlevel_m = 12.34\nlevel_at = [1.5, 2.5]",
        'crs = "EPSG:25832+5778"\n[report]\nproject = "Tiefe 12,5 m"',
    ],
)
def test_what_is_right_is_read(text):
    parse_config(text)


def test_a_file_that_cannot_be_read_is_a_sentence(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_config(tmp_path)
