"""Habits of writing that are no TOML, or another value than meant: each is refused with what to write instead."""

from __future__ import annotations

import pytest

from survey.errors import ConfigError
from survey.settings.config import parse_config, read_config

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
