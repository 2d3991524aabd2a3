"""Repetition of a run: its options, the reference of its report, and the command."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, fields, replace
from pathlib import Path

from survey.errors import SurveyError
from survey.plan.choices import option_of
from survey.run.job import Job
from survey.settings.config import dump_config
from survey.settings.tables import ProcessConfig


def options_of(job: Job, truth: Truth) -> dict:
    """Effective options of a run by name, and under ``command`` the command that repeats it."""
    chosen, plan = job.chosen, job.plan
    return {
        "quality": plan.quality,
        "device": plan.device,
        "field": plan.field,
        "poses": plan.pose_choice,
        "image_scale": plan.image_scale,
        "calibrate_water": chosen.calibrate_water,
        "true_colour": chosen.true_colour,
        "tiles": 1 if job.plan.tiling is None else len(job.plan.tiling),
        **({"target_std_m": chosen.target_std_m, "time_budget_s": chosen.time_budget_s} if chosen.has_aim else {}),
        "command": command_of(job, truth),
    }


def command_of(job: Job, truth: Truth) -> str:
    """The command line of a run, without its run folder."""
    words = ["bathynerf", "process", str(job.survey.folder)]
    for field in fields(ProcessConfig):
        name, value = option_of(field.name), getattr(job.chosen, field.name)
        if job.chosen.has_aim and field.name in ("quality", "image_scale"):
            continue
        # A default is stated too where survey.toml has another value.
        is_open = getattr(job.survey.config.process, field.name) in (None, value)
        if value is True or (value is False and not is_open):
            words.append(name if value else name.replace("--", "--no-", 1))
        elif value not in (None, False) and not (value == "auto" and is_open):
            words += [name, str(value)]
    for name, path in (("--reference", truth.reference), ("--visible", truth.visible)):
        words += [] if path is None else [name, str(path)]
    return shlex.join(words)


def settings_text(job: Job, options: dict) -> str:
    """The settings of a run as survey.toml has them, with its `options_of` as comments."""
    effect = ", ".join(f"{name} {value}" for name, value in options.items() if name != "command" and value is not None)
    head = (
        "# The settings in effect, with defaults and with what the run found of the water.\n"
        f"# Options in effect: {effect}\n"
        f"# The same run again: {options['command']}\n\n"
    )
    return head + dump_config(replace(job.survey.config, process=ProcessConfig()))


@dataclass(frozen=True)
class Truth:
    """A known surface; the reconstruction never reads it."""

    # reference, visible: True surface, and the points of it that cameras see
    reference: Path | None = None
    visible: Path | None = None

    def require_there(self) -> None:
        """Raise SurveyError where a file is missing."""
        for name, path in (("--reference", self.reference), ("--visible", self.visible)):
            if path is not None and not path.exists():
                raise SurveyError(f"{name} {path} does not exist; give the path of a PLY, OBJ, LAS or LAZ file")
