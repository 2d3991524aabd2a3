"""Photographs of several cameras at one shot, and of several days under one level."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta

import pytest
from small_survey import write_image

from survey.folder.headers import header_warnings
from survey.photos.exif import read_exif
from survey.settings.config import SurveyConfig, parse_config

START = datetime(2026, 6, 1, 10, 30)
WATER = "[water]\nlevel_m = 2.0\n"


@pytest.fixture
def header(tmp_path):
    write_image(tmp_path / "a.jpg")
    return read_exif(tmp_path / "a.jpg")


def shots(header, endings, *, num=6, clocks=True, lag_s=0.2):
    found = {}
    for number in range(num):
        for order, (ending, size) in enumerate(endings.items()):
            clock = START + timedelta(seconds=3.0 * number + lag_s * order) if clocks else None
            found[f"DJI_20260601_{number:04d}{ending}.JPG"] = replace(header, size_px=size, clock=clock)
    return found


@pytest.mark.parametrize("clocks", [True, False])
@pytest.mark.parametrize(
    ("endings", "words"),
    [
        ({"_V": (4000, 3000), "_T": (640, 512)}, ["6 of 4000 x 3000 px (*_V)", "6 of 640 x 512 px (*_T)"]),
        ({"_W": (8000, 6000), "_T": (1280, 1024)}, ["(*_W)", "(*_T)"]),
        ({"_D": (5280, 3956), "_MS_G": (2592, 1944), "_MS_R": (2592, 1944)}, ["(*_D)", "12 of 2592 x 1944 px"]),
        ({"": (4000, 3000), "_IR": (640, 512)}, ["(*_IR)"]),
    ],
)
def test_shots_of_several_cameras_are_named_with_their_endings(header, endings, words, clocks):
    (said,) = header_warnings(SurveyConfig(), shots(header, endings, clocks=clocks, lag_s=0.0))
    assert said.startswith("each shot has photographs of several cameras: ")
    for part in words:
        assert part in said


@pytest.mark.parametrize(
    "endings", [{"": (4000, 3000)}, {"_left": (4000, 3000), "_right": (4000, 3000)}]
)  # fmt: skip
def test_one_camera_and_rigs_of_equal_ones_are_not(header, endings):
    assert header_warnings(SurveyConfig(), shots(header, endings)) == []


def test_two_cameras_of_two_flights_are_not(header):
    first, second = shots(header, {"_A": (4000, 3000)}), shots(header, {"_B": (5000, 4000)})
    later = {name: replace(one, clock=one.clock + timedelta(hours=1)) for name, one in second.items()}
    assert header_warnings(SurveyConfig(), first | later) == []


@pytest.mark.parametrize(
    ("hours", "toml", "num_days"),
    [
        (24.0, WATER, 2),
        (9.0, WATER, 2),
        (24.0 * 40, WATER, 2),
        (24.0, '[water]\ngnss_points = "a.csv"\n', 2),
        (1.0, WATER, 0),
        (24.0, "dry = true", 0),
        (24.0, '[water]\ngauge = "a.csv"\n', 0),
        (24.0, '[water]\nimage_levels = "a.csv"\n', 0),
        (24.0, WATER + "level_rate_m_per_h = 0.3\nlevel_time = '2026-06-01T10:30:00Z'", 0),
    ],
)
def test_days_under_one_level_are_said(header, hours, toml, num_days):
    first = shots(header, {"": (4000, 3000)})
    second = {
        f"b/{name}": replace(one, clock=one.clock + timedelta(hours=hours)) for name, one in list(first.items())[:4]
    }
    said = header_warnings(parse_config(toml), first | second)
    assert len(said) == (num_days > 0)
    if said:
        day = (START + timedelta(hours=hours)).strftime("%Y-%m-%d")
        assert f"photographs of 2 days (2026-06-01: 6, {day}: 4) have one level" in said[0]
