"""Keys of survey.toml without an effect: each key, under circumstances where it has one and where it has none."""

import pytest
from small_survey import TOML, small_survey, unposed

from refract.lens import Lens
from survey.files.toml_table import table_of
from survey.folder.found import Circumstances, conditions, find_survey, unused_keys
from survey.folder.survey import load_survey
from survey.photos.exif import read_exif
from survey.photos.poses import PoseFrame
from survey.settings.config import SurveyConfig, parse_config

LENS = Lens("OPENCV", (500.0, 501.0, 32.0, 24.0, 0.1, 0.0, 0.0, 0.0), 64, 48)
# Keys that have an effect whatever else is given, or whose readers say where they have none.
ALWAYS = {
    "images", "water", "area", "process", "report", "field", "local.frame", "control.gcps", "control.checkpoints",
    "control.marks", "control.reference", "control.reference_std_m", "control.stable", "cameras.poses",
    "cameras.position_std_m", "cameras.rolling_shutter_s", "cameras.rolling_shutter_std_s", "name", "crs", "dry",
}  # fmt: skip
FILE = {"poses": "cameras.csv", "frame": PoseFrame.GRID}
MODEL = {"poses": "sparse", "frame": PoseFrame.LOCAL, "lens": LENS}
EARTH, LEVEL = (FILE | {"frame": frame} for frame in (PoseFrame.GEOCENTRIC, PoseFrame.ENU))
FREE = MODEL | {"is_placed_by_gps": True}
NONE: dict = {}


@pytest.mark.parametrize(
    ("table", "has_effect", "has_none"),
    [
        ('[cameras]\ngps_height = "ellipsoidal"', [NONE, EARTH, FREE], [FILE, MODEL, LEVEL]),
        ("[cameras]\nfocal_px = 450.0", [NONE, FILE], [MODEL]),
        ("[cameras]\nsize_px = [640, 480]", [NONE, FILE], [MODEL]),
        ("[cameras]\nprincipal_point_px = [30.0, 24.0]", [NONE, FILE], [MODEL]),
        ('[cameras]\nmodel = "SIMPLE_PINHOLE"', [NONE, FILE], [MODEL]),
        ('[cameras]\nmodel = "OPENCV"\ndistortion = [0.2, 0.0, 0.0, 0.0]', [NONE, FILE], [MODEL]),
        ("[cameras]\nrotation_std_deg = 1.0", [FILE, MODEL], [NONE, FREE]),
        ("[cameras]\nrolling_shutter_s = 0.02\nspeed_m_s = 5.0", [NONE, FILE], []),
        ("[cameras]\nrolling_shutter_s = 0.0\nspeed_m_s = 5.0", [], [NONE, FILE]),
        ("[local]\norigin = [1.0, 2.0, 3.0]", [MODEL, FILE | {"has_other_poses": True}], [NONE, FILE, EARTH]),
        ("[control]\nstd_m = 0.02", [], [NONE, FILE]),
        ('[control]\ngcps = "a.txt"\nstd_m = 0.02\nmarks_std_px = 1.0', [NONE, FILE], []),
        ("[control]\nmarks_std_px = 1.0", [], [NONE, MODEL]),
    ],
)  # fmt: skip
def test_each_key_is_said_where_nothing_reads_it_and_only_there(tmp_path, table, has_effect, has_none):
    small_survey(tmp_path, num=1)
    headers = {"0000.jpg": read_exif(tmp_path / "images" / "0000.jpg")}
    config, (name, _) = parse_config(table), table.splitlines()[-1].split(" = ")
    for circumstances in has_effect:
        assert unused_keys(Circumstances(config, headers, **circumstances)) == ()
    for circumstances in has_none:
        (said,) = unused_keys(Circumstances(config, headers, **circumstances))
        assert f"{name} = " in said
        assert "in survey.toml has no effect: " in said


def test_the_lens_of_the_file_itself_is_no_contradiction(tmp_path):
    small_survey(tmp_path, num=1)
    same = 'model = "OPENCV"\nsize_px = [64, 48]\nfocal_px = 500.5\nprincipal_point_px = [32.0, 24.0]'
    config = parse_config(f"[cameras]\n{same}\ndistortion = [0.1, 0.0, 0.0, 0.0]")
    assert unused_keys(Circumstances(config, {}, **MODEL)) == ()
    assert unused_keys(Circumstances(SurveyConfig(), {}, **MODEL)) == ()


def test_every_key_has_a_condition_or_always_an_effect():
    keys = {
        key if isinstance(value, dict) is False else f"{key}.{name}"
        for key, value in table_of(SurveyConfig()).items()
        for name in (value if isinstance(value, dict) else [""])
    }
    assert {key for key in keys if key not in ALWAYS and key.split(".")[0] not in ALWAYS} == set(
        conditions(Circumstances(SurveyConfig(), {}))
    )


def test_surveys_with_and_without_poses_say_it(tmp_path):
    folder = small_survey(tmp_path / "s", toml=TOML.replace("[water]", 'gps_height = "ellipsoidal"\n[water]'))
    (said,) = [text for text in load_survey(folder).findings.warnings if "has no effect" in text]
    assert said.startswith(
        "[cameras] gps_height = ellipsoidal in survey.toml has no effect: it is that of GPS positions"
    )
    found = find_survey(unposed(tmp_path / "u", ("[water]", "[control]\nstd_m = 0.1\n[water]")))
    assert any("[control] std_m = 0.1 in survey.toml has no effect" in text for text in found.findings.warnings)
    assert found.poses_path is None
