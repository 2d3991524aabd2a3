"""A level of the water for each photograph: by a gauge, a table or a rate, and where one level will do."""

import dataclasses
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from small_survey import rows_of, small_survey

from geo.crs import parse_crs
from refract import FlatWater
from refract.lens import Lens
from survey.errors import ConfigError
from survey.photos.cameras import View
from survey.photos.exif import Exif
from survey.plan.check import check_survey
from survey.settings.config import parse_config
from survey.simulate.drawn import DrawnScene, draw_survey
from survey.water.level import with_level
from survey.water.tides import MOST_SHIFT_PX, Tide, with_tides

CRS = parse_crs("EPSG:25832+5778")
HEAD = Exif((64, 48), None, None, 1, "", None)
DOWN = np.diag([1.0, -1.0, -1.0])


def heads_at(*minutes, without=()):
    """Headers of photographs a.jpg, b.jpg, ... taken at these minutes, and of some without a time."""
    headers = {
        f"{chr(97 + k)}.jpg": dataclasses.replace(HEAD, taken=datetime(2024, 6, 1, 10, minute, tzinfo=UTC))
        for k, minute in enumerate(minutes)
    }
    return headers | dict.fromkeys(without, HEAD)


def tide_of(folder, text, headers):
    """The level and the tide by lines of [water]."""
    config, _, tide, _ = with_level(folder, parse_config(f"[water]\n{text}\n"), headers, CRS)
    return config.water.level_m, tide


def test_a_table_has_a_level_for_each_photograph(tmp_path):
    (tmp_path / "levels.csv").write_text("image,level\nB,1.2\na.jpg,1.0\nleft_out.jpg,9.0\n")
    level, tide = tide_of(tmp_path, 'image_levels = "levels.csv"', heads_at(0, 10))
    assert level == pytest.approx(1.1)
    assert tide.over == pytest.approx({"a.jpg": -0.1, "b.jpg": 0.1})
    assert tide.moves_m == pytest.approx(0.2)


@pytest.mark.parametrize("source", ["image_levels", "gauge"])
def test_levels_in_files_have_the_unit_of_crs(tmp_path, source):
    lines = {"image_levels": ["image,level", "a.jpg,100", "b.jpg,101"],
             "gauge": ["time,level", "2024-06-01T10:00:00Z,100", "2024-06-01T10:10:00Z,101"]}[source]  # fmt: skip
    (tmp_path / "levels.csv").write_text("\n".join(lines) + "\n")
    config = parse_config(f'[water]\n{source} = "levels.csv"\n')
    config, levels, tide, _ = with_level(tmp_path, config, heads_at(0, 10), parse_crs("EPSG:6344+6360"))
    foot = 1200.0 / 3937.0
    assert config.water.level_m == pytest.approx(100.5 * foot)
    assert tide.over == pytest.approx({"a.jpg": -0.5 * foot, "b.jpg": 0.5 * foot})
    assert [each.level_m for each in levels] == pytest.approx([100.0 * foot, 101.0 * foot])


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (["a.jpg,1.0"], r"no level for 1 of 2 images \(first: b.jpg\)"),
        (["a.jpg,1.0", "b.jpg,1.0", "A,1.1"], "a.jpg has a level already"),
        (["a.jpg,1.0", "b.jpg,high"], "finite number"),
    ],
)
def test_a_table_that_leaves_a_level_open_is_refused(tmp_path, rows, message):
    (tmp_path / "levels.csv").write_text("\n".join(["image,level", *rows]) + "\n")
    with pytest.raises(ConfigError, match=message):
        tide_of(tmp_path, 'image_levels = "levels.csv"', heads_at(0, 10))


def test_a_rate_counts_from_the_mean_time_or_from_that_of_the_level(tmp_path):
    level, tide = tide_of(tmp_path, "level_m = 2.0\nlevel_rate_m_per_h = 0.6", heads_at(0, 20))
    assert level == 2.0
    assert tide.over == pytest.approx({"a.jpg": -0.1, "b.jpg": 0.1})
    at = 'level_m = 2.0\nlevel_rate_m_per_h = 0.6\nlevel_time = "2024-06-01T12:00:00+02:00"'
    assert tide_of(tmp_path, at, heads_at(0, 20))[1].over == pytest.approx({"a.jpg": 0.0, "b.jpg": 0.2})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("level_m = 2.0\nlevel_rate_m_per_h = 30.0", "at most 10 up or down"),
        ('gauge = "g.csv"\nlevel_rate_m_per_h = 0.3', "level_rate_m_per_h and gauge"),
        ("level_m = 2.0\nlevel_rate_std_m_per_h = 0.3", "without level_rate_m_per_h"),
        ("level_m = 2.0\nlevel_rate_m_per_h = 0.0\nlevel_rate_std_m_per_h = 0.0", "standard deviation above 0"),
        ('level_m = 2.0\nlevel_time = "2024-06-01T10:00:00Z"', "without level_rate_m_per_h"),
        ('level_m = 2.0\nlevel_rate_m_per_h = 0.3\nlevel_time = "2024-06-01T10:00:00"', "no time zone"),
    ],
)
def test_rates_that_cannot_be_are_refused(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message):
        tide_of(tmp_path, text, heads_at(0, 20))


def test_photographs_without_a_time_have_the_mean_level_only_where_it_hardly_moves(tmp_path):
    slow, fast = ("level_m = 2.0\nlevel_rate_m_per_h = " + rate for rate in ("0.012", "0.12"))
    headers = heads_at(0, 20, without=("x.jpg",))
    assert tide_of(tmp_path, slow, headers)[1].over == pytest.approx({"a.jpg": -0.002, "b.jpg": 0.002, "x.jpg": 0.0})
    with pytest.raises(ConfigError, match=r"1 of 3 images have no time of exposure in EXIF \(first: x.jpg\).*40 mm"):
        tide_of(tmp_path, fast, headers)
    with pytest.raises(ConfigError, match=r"1 of 3 images have no time of exposure.*finds the rate"):
        tide_of(tmp_path, slow + "\nlevel_rate_std_m_per_h = 0.3", headers)


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_levels_that_move_images_by_less_than_the_noise_of_matching_count_as_one(share):
    # 10 m over the water, pixels of 1 cm on it, the corners 30 degrees off the axis.
    half = 1000.0 * np.tan(np.radians(30.0)) / np.sqrt(2.0)
    lens = Lens("SIMPLE_PINHOLE", (1000.0, half, half), round(2.0 * half), round(2.0 * half))
    views = [View(name, Path(name), lens.camera(np.array([0.0, 0.0, 10.0]), DOWN), lens) for name in "ab"]
    # The tangent in air less that in water; a metre of level moves the corner by so many pixels.
    per_m = (0.57735 - 0.40451) / 0.01
    level = share * MOST_SHIFT_PX / per_m
    tide = Tide("gauge", {"a": level, "b": -level, "of another flight": 9.0}, {})
    found, tide = with_tides(views, tide, FlatWater((0.0, 0.0, 0.0), n_water=1.333))
    assert tide.shift_px == pytest.approx(share * MOST_SHIFT_PX, rel=5e-3)
    assert tide.moves_m == pytest.approx(2.0 * level)
    assert tide.matters == (share > 1.0)
    assert [view.camera.tide for view in found] == ([level, -level] if tide.matters else [0.0, 0.0])


def test_the_plan_says_whether_photographs_have_levels_of_their_own(tmp_path):
    draw_survey(tmp_path / "moving", DrawnScene.tiny(rise_m=0.12))
    gauge = tmp_path / "moving" / "gauge.csv"
    assert rows_of(check_survey(tmp_path / "moving"), "Plan")["level"].startswith("per photograph: gauge, moves by 120")
    gauge.write_text("time,level\n2024-06-01T10:00:00Z,584.199\n2024-06-01T11:00:00Z,584.201\n")
    assert rows_of(check_survey(tmp_path / "moving"), "Plan")["level"].startswith("one: gauge, moves by 2.0")
    toml = tmp_path / "moving" / "survey.toml"
    free = "level_m = 584.2\nlevel_rate_m_per_h = 0.0\nlevel_rate_std_m_per_h = 0.3"
    toml.write_text(toml.read_text(encoding="utf-8").replace('gauge = "gauge.csv"', free), encoding="utf-8")
    plan = rows_of(check_survey(tmp_path / "moving"), "Plan")
    assert plan["level"] == "per photograph: its rate, known to 0 +- 0.3 m/h, is estimated with the poses"
    assert plan["poses"].startswith("refine: level_rate_std_m_per_h asks")
    assert "level" not in rows_of(check_survey(small_survey(tmp_path / "still")), "Plan")
