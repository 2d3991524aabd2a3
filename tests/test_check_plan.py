"""`bathynerf check` before the flight: a plan of patterns or of poses, and what it promises."""

import math
from pathlib import Path

import numpy as np
import pytest
from small_survey import rows_of, small_survey
from typer.testing import CliRunner

from survey.adjust.result.foreseen import foresee
from survey.commands.verbs import app
from survey.errors import ConfigError, SurveyError
from survey.plan.choices import Choices
from survey.simulate.check_plan import check_plan, survey_of
from survey.simulate.scene_file import read_scene
from survey.simulate.simulate import light_of, plan_scene, simulate_flight

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
PLAN = """
crs = "EPSG:25832+7837"
origin = [676120.0, 5311480.0, 584.2]
[area]
size_m = [12.0, 10.0]
[bed]
depth_m = 1.5
[water]
[camera]
size_px = [600, 450]
focal_px = 500.0
[flight]
height_m = 12.0
patterns = ["nadir", "outer"]
forward_overlap = 0.75
side_overlap = 0.6
[light]
time = "2026-06-21T13:15+02:00"
"""


def plan_file(folder: Path, *pairs: tuple[str, str]) -> Path:
    text = PLAN
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    path = folder / "plan.toml"
    path.write_text(text)
    return path


def checked(path: Path, wind: float = 3.0):
    return check_plan(path, chosen=Choices(device="cpu"), wind_m_s=wind)


def std_mm(row: str, depth: str) -> float:
    """The standard deviation that heights at a depth have in common, of the row that `check` prints."""
    (part,) = [part for part in row.split(", ") if f" mm at {depth} m of depth" in part]
    return float(part.partition(" mm")[0].rpartition("/ ")[2])


def test_a_plan_is_checked_by_the_command_that_checks_surveys(tmp_path):
    result = CliRunner().invoke(app, ["check", str(plan_file(tmp_path)), "--quality", "draft"])
    assert result.exit_code == 0, result.output
    for title in ("Flight", "Foreseen from the poses", "Light and motion", "Processing"):
        assert f"{title}\n" in result.output
    assert " from 12.0 m over the water: " in result.output


@pytest.mark.slow
def test_the_flight_of_the_examples_is_good():
    result = CliRunner().invoke(app, ["check", str(EXAMPLES / "flight.toml"), "--quality", "draft"])
    assert result.exit_code == 0, result.output
    assert "81 from 40.0 m over the water: 55 nadir, 26 oblique (tilted by up to 31" in result.output
    assert "good: blurs by 0.36 px at most (4.0 m/s, open for 1 ms)" in result.output


@pytest.mark.slow
def test_a_plan_says_what_an_aim_promises_and_costs(tmp_path):
    path = str(plan_file(tmp_path))
    asked = CliRunner().invoke(app, ["check", path, "--device", "cpu", "--target-std", "0.004"]).output
    before, _, said_of_aim = asked.partition("Aim\n")
    assert said_of_aim
    assert "Aim" not in CliRunner().invoke(app, ["check", path]).output
    assert "Flight\n" in before
    rows = " ".join(said_of_aim.split())
    assert "standard at image scale 1" in rows
    assert "photographs of this size and overlap give" in rows
    refused = CliRunner().invoke(app, ["check", path, "--target-std", "20"])
    assert refused.exit_code == 2
    assert "--target-std 20 is in metres" in refused.output


@pytest.mark.slow
def test_a_file_of_poses_is_the_flight_that_it_was_written_from(tmp_path):
    path = plan_file(tmp_path)
    simulate_flight(path, tmp_path / "flown")
    of_file = plan_file(
        tmp_path, ("height_m = 12.0", 'poses = "flown/cameras.csv"'), ('patterns = ["nadir", "outer"]', "")
    )
    (tmp_path / "again.toml").write_text(of_file.read_text())
    plan_file(tmp_path)
    flown = [plan_scene(read_scene(tmp_path / name), tmp_path).cameras for name in ("plan.toml", "again.toml")]
    assert len(flown[0]) == len(flown[1])
    for one, other in zip(*flown, strict=True):
        np.testing.assert_allclose(one.centre, other.centre, atol=2e-6)
        np.testing.assert_allclose(one.cam_from_local, other.cam_from_local, atol=1e-8)
        assert (one.fx, one.cx, one.width) == (other.fx, other.cx, other.width)
    rows = [rows_of(checked(tmp_path / name), "Foreseen from the poses") for name in ("plan.toml", "again.toml")]
    assert rows[0]["overlap"] == rows[1]["overlap"]


@pytest.mark.slow
def test_oblique_views_and_better_positions_tell_the_level_and_nadir_alone_does_not(tmp_path):
    crossing = rows_of(checked(plan_file(tmp_path)), "Foreseen from the poses")
    assert crossing["level"].startswith("good: ")
    nadir = rows_of(checked(plan_file(tmp_path, ('["nadir", "outer"]', '["nadir"]'))), "Foreseen from the poses")
    assert nadir["level"].startswith("poor: not observable by this flight")
    rough = plan_file(tmp_path, ("height_m = 12.0", "height_m = 12.0\nposition_std_m = 3.0"))
    vague = rows_of(checked(rough), "Foreseen from the poses")
    assert std_mm(vague["heights"], "1.5") > 1.5 * std_mm(crossing["heights"], "1.5")


def test_heights_of_photographs_that_are_halved_are_half_as_good(tmp_path):
    path = plan_file(tmp_path, ("[600, 450]", "[4000, 3000]"), ("focal_px = 500.0", "focal_px = 3300.0"))
    survey = survey_of(plan_scene(read_scene(path), tmp_path))
    fine, standard = (foresee(survey, depth_m=1.5, chosen=Choices(quality=quality)) for quality in ("fine", "standard"))
    assert standard.heights.of_point_m == pytest.approx(2.0 * fine.heights.of_point_m)


def test_a_short_way_is_said_in_seconds(tmp_path):
    way = rows_of(checked(plan_file(tmp_path, ("height_m = 12.0", "height_m = 12.0\nspeed_m_s = 4.0"))), "Flight")[
        "path"
    ]
    metres, seconds = (int(way.partition(f" {unit} ")[0].split()[-1]) for unit in ("m", "seconds"))
    assert seconds == pytest.approx(metres / 4.0, abs=1.0)


def test_a_flight_with_too_little_overlap_is_told_to_have_more(tmp_path):
    path = plan_file(
        tmp_path, ("forward_overlap = 0.75", "forward_overlap = 0.4"), ("side_overlap = 0.6", "side_overlap = 0.1"),
        ('["nadir", "outer"]', '["nadir"]'), ("[12.0, 10.0]", "[40.0, 40.0]"),
    )  # fmt: skip
    coverage = rows_of(checked(path), "Flight")["coverage"]
    assert coverage.startswith("poor: ")
    assert coverage.endswith("give more overlap, or let the strips begin outside the area")


@pytest.mark.slow
def test_glitter_is_worst_at_noon_and_the_hours_without_it_are_said(tmp_path):
    noon = rows_of(checked(plan_file(tmp_path)), "Light and motion")
    # 47.94 degrees north at the solstice: 90 - 47.94 + 23.44.
    assert noon["sun"].startswith("66 degrees high in the south")
    assert not noon["glitter"].startswith("good")
    early = rows_of(checked(plan_file(tmp_path, ("T13:15", "T07:30"))), "Light and motion")
    assert early["glitter"].startswith("good: ")
    assert early["hours"] == noon["hours"]
    # Good in the morning until some time, and again from some time in the afternoon.
    assert noon["hours"].count(" to ") == 2
    first, last = noon["hours"].split(" and ")[:2]
    assert first[:5] < "07:30" < first[9:14] < "13:15" < last[:5]


def test_without_a_time_the_plan_says_where_to_give_it(tmp_path):
    rows = rows_of(checked(plan_file(tmp_path, ('time = "2026-06-21T13:15+02:00"', ""))), "Light and motion")
    assert rows["sun"].startswith("unknown: give [light] time")
    assert rows["motion"] == "unknown: the speed is not given"


def test_a_scene_is_lit_by_the_sun_of_its_time(tmp_path):
    plan = plan_scene(read_scene(plan_file(tmp_path)), tmp_path)
    light = light_of(plan.settings.light, plan.frame)
    assert math.degrees(light.elevation) == pytest.approx(65.5, abs=0.1)
    assert light.sun[1] < 0.0
    night = plan_scene(read_scene(plan_file(tmp_path, ("T13:15", "T01:15"))), tmp_path)
    with pytest.raises(ConfigError, match="below the horizon"):
        light_of(night.settings.light, night.frame)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("+02:00", "", "expected a time with its zone"),
        ("2026-06-21T13:15+02:00", "noon", "expected a time with its zone"),
        ("[light]", "[light]\nsun_elevation_deg = 30.0", "remove sun_elevation_deg"),
        ("[light]", "[sensor]\nshutter_s = 0.001\n[light]", "without flight.speed_m_s"),
        ("height_m = 12.0", "", "give exactly one of height_m"),
        ("height_m = 12.0", 'height_m = 12.0\nposes = "cameras.csv"', "not both"),
        ("height_m = 12.0", 'poses = "none.csv"', "does not exist"),
    ],
)
def test_what_is_wrong_with_a_plan_is_said(tmp_path, old, new, words):
    with pytest.raises(SurveyError, match=words):
        checked(plan_file(tmp_path, (old, new)))


def test_the_settings_of_a_survey_and_photographs_of_a_plan_are_refused(tmp_path):
    folder = small_survey(tmp_path / "s")
    with pytest.raises(SurveyError, match=r"survey\.toml has the settings of a survey, expected its folder"):
        checked(folder / "survey.toml")
    for options in (["--deep"], ["--image-scale", "0.5"]):
        result = CliRunner().invoke(app, ["check", str(plan_file(tmp_path)), *options])
        assert result.exit_code == 2
        assert "a plan has none" in result.output
