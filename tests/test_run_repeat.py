"""The options of a run are written where it is found, with the command that repeats it."""

import shlex
from pathlib import Path

import pytest
from small_survey import small_survey

from survey.commands.compute import process
from survey.folder.survey import load_survey
from survey.plan.choices import Choices
from survey.plan.plan import make_plan
from survey.progress import opened
from survey.run.job import Job
from survey.run.products import command_of, options_of, settings_text
from survey.settings.config import parse_config


@pytest.fixture
def folder(tmp_path):
    return small_survey(tmp_path / "a survey")


def job_of(folder: Path, **chosen) -> Job:
    with opened() as progress:
        survey, choices = load_survey(folder), Choices(**chosen)
        return Job(survey, choices, make_plan(survey, choices), progress)


def test_a_run_without_options_is_repeated_with_its_quality(folder):
    said = shlex.split(command_of(job_of(folder), {}))
    assert said == ["bathynerf", "process", str(folder), "--quality", "standard"]


def test_every_option_that_was_chosen_is_repeated(folder):
    job = job_of(folder, quality="draft", device="cpu", field="off", poses="fixed", image_scale=0.5, true_colour=True)
    said = shlex.split(command_of(job, {"reference": Path("true bed.ply")}))
    assert said[3:] == [
        "--quality", "draft", "--device", "cpu", "--field", "off", "--poses", "fixed",
        "--image-scale", "0.5", "--true-colour", "--reference", "true bed.ply",
    ]  # fmt: skip
    known = {parameter.replace("_", "-") for parameter in process.__annotations__}
    assert {word.removeprefix("--") for word in said if word.startswith("--")} <= known


def test_a_run_with_an_aim_is_repeated_with_it_and_not_with_what_was_chosen_for_it(folder):
    job = job_of(folder, quality="draft", image_scale=0.5, target_std_m=0.02, time_budget_s=300.0)
    said = shlex.split(command_of(job, {}))
    assert said[3:] == ["--target-std", "0.02", "--time-budget", "300.0"]
    options = options_of(job, {})
    assert [options[name] for name in ("target_std_m", "quality", "image_scale")] == [0.02, "draft", 0.5]


def test_settings_hold_what_was_done_and_still_load_as_survey_toml(folder):
    job = job_of(folder, field="off")
    options = options_of(job, {})
    text = settings_text(job, options)
    assert parse_config(text) == job.survey.config
    assert "quality standard" in text
    assert "field off" in text
    assert f"# The same run again: {options['command']}\n" in text
