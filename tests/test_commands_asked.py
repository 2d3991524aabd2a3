"""What is asked of a run: by options, by [process] of survey.toml, in this order."""

import itertools
import json
import re
from dataclasses import asdict, fields
from types import SimpleNamespace

import pytest
from command_line import bathynerf
from small_survey import small_survey

from survey.errors import ConfigError, SurveyError
from survey.plan.choices import USUAL, Choices, choices_of
from survey.run.products import command_of
from survey.settings.config import dump_config, parse_config
from survey.settings.tables import ProcessConfig

# A value of each key, and another; none of them the default.
VALUES = {
    "quality": ("draft", "fine"),
    "target_std_m": (0.02, 0.03),
    "time_budget_s": (300.0, 400.0),
    "device": ("cpu", "cuda"),
    "field": ("mdw", "off"),
    "poses": ("fixed", "refine"),
    "image_scale": (0.5, 0.25),
    "calibrate_water": (True, False),
    "true_colour": (True, False),
    "tiles": (4, 2),
    "memory": ("8GB", "500MB"),
    "workers": (2, 3),
    "scheduler": ("tcp://one:8786", "tcp://two:8786"),
}
AIM, RECIPE = {"target_std_m", "time_budget_s"}, {"quality", "field", "image_scale"}


def test_every_key_is_tried_here():
    assert VALUES.keys() == {field.name for field in fields(ProcessConfig)}
    assert {field.name for field in fields(Choices)} == VALUES.keys()


@pytest.mark.parametrize("name", VALUES)
def test_what_is_said_first_counts(name):
    value, other = VALUES[name]
    said, lower = ProcessConfig(**{name: value}), ProcessConfig(**{name: other})
    assert getattr(said.over(lower), name) == value
    assert getattr(ProcessConfig().over(lower), name) == other
    assert ProcessConfig().over(ProcessConfig()) == ProcessConfig()


@pytest.mark.parametrize(("upper", "lower"), list(itertools.permutations(VALUES, 2)))
def test_an_aim_and_a_recipe_of_different_places_never_contradict_each_other(upper, lower):
    merged = ProcessConfig(**{upper: VALUES[upper][0]}).over(ProcessConfig(**{lower: VALUES[lower][0]}))
    choices_of(merged)
    is_displaced = (upper in AIM and lower in RECIPE) or (upper in RECIPE and lower in AIM)
    assert (getattr(merged, lower) is None) == is_displaced


def test_what_nobody_says_is_the_default_and_words_are_plain():
    assert choices_of(ProcessConfig()) == USUAL
    assert choices_of(ProcessConfig(target_std_m=0.02, device="cpu")) == Choices(device="cpu", target_std_m=0.02)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"target_std_m": 0.0}, "--target-std is 0, expected a standard deviation in metres above 0"),
        ({"time_budget_s": -5.0}, "--time-budget is -5, expected the seconds that a run may take, above 0"),
        ({"time_budget_s": float("nan")}, "--time-budget is nan"),
        ({"target_std_m": 0.01, "quality": "fine"}, "--target-std and --quality are given, but"),
        ({"target_std_m": 0.01, "field": "mdw"}, "--target-std and --field are given, but"),
        ({"target_std_m": 0.01, "image_scale": 0.5}, "--target-std and --image-scale are given, but"),
    ],
)
def test_an_aim_that_cannot_be_is_refused(options, words):
    with pytest.raises(SurveyError, match=words):
        choices_of(ProcessConfig(**options))


@pytest.mark.parametrize("name", VALUES)
def test_the_file_keeps_each_key(name):
    for value in VALUES[name]:
        written = dump_config(parse_config(f"[process]\n{name} = {json.dumps(value)}"))
        assert parse_config(written).process == ProcessConfig(**{name: value})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('quality = "best"', 'process.quality is "best", expected one of draft, standard, fine'),
        ('field = "slab"', "off, mdw, m, dw, vm; mdw has taken the place of slab"),
        ("image_scale = 0.3", "process.image_scale is 0.3, expected one of 1, 0.5"),
        ("target_std_m = -1", "process.target_std_m is -1, expected a standard deviation in metres above 0"),
        ('quality = "fine"\ntime_budget_s = 300', "[process] time_budget_s and [process] quality are given, but"),
        ("qualty = 1", "the nearest known one is [process] quality"),
        ("true_colour = 1", "process.true_colour is 1, expected true or false"),
    ],
)
def test_a_wrong_key_of_the_file_is_named(text, words):
    with pytest.raises(ConfigError, match=re.escape(words)):
        parse_config(f"[process]\n{text}")


@pytest.mark.slow
def test_check_plans_what_process_would_do(tmp_path):
    folder = small_survey(tmp_path / "s")
    with (folder / "survey.toml").open("a") as stream:
        stream.write('\n[process]\nquality = "draft"\nfield = "off"\n')

    def plan(*options) -> dict:
        assert bathynerf("check", folder, "--json", tmp_path / "c.json", *options).exit_code == 0
        sections = json.loads((tmp_path / "c.json").read_text())["sections"]
        (numbers,) = [section["numbers"] for section in sections if section["title"] == "Plan"]
        assert numbers["workload"]["num_views"] > 0
        return {decision["name"]: decision["choice"] for decision in numbers["decisions"]} | numbers

    assert (plan()["quality"], plan()["field"]) == ("draft", "off")
    assert (plan("--quality", "fine", "--field", "auto")["quality"], plan("--field", "auto")["field"]) == (
        "fine",
        plan("--field", "auto", "--quality", "draft")["field"],
    )


def test_the_report_of_check_in_json_has_what_is_printed(tmp_path):
    folder = small_survey(tmp_path / "s")
    shown = bathynerf("check", folder, "--json", tmp_path / "c.json").stdout
    for section in json.loads((tmp_path / "c.json").read_text())["sections"]:
        assert section["title"] in shown
        for row in section["rows"]:
            assert row["label"] in shown
            assert row["text"] in shown
    refused = bathynerf("check", folder, "--json", folder / "survey.toml")
    assert (refused.exit_code, "would overwrite the input" in refused.stderr) == (2, True)


@pytest.mark.parametrize("by_file", [{}, {"device": "cpu", "true_colour": True}])
def test_the_command_that_repeats_a_run_overrides_survey_toml(by_file):
    config = SimpleNamespace(process=ProcessConfig(**by_file))
    job = SimpleNamespace(chosen=USUAL, survey=SimpleNamespace(folder="s", config=config))
    words = command_of(job, {}).split()
    added = ["--device", "auto", "--no-true-colour"] if by_file else []
    assert words == ["bathynerf", "process", "s", "--quality", "standard", *added]
    assert asdict(config.process).keys() == VALUES.keys()
