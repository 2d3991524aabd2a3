"""Repetition of a run: its options, the reference of its report, and the command."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path

from survey.run.job import Job
from survey.settings.config import dump_config
from survey.settings.tables import ProcessConfig


def options_of(job: Job, truth: Truth) -> dict:
    """Effective options of a run by name, and under ``command`` the command that repeats it."""
    chosen, plan, aim = job.chosen, job.plan, job.chosen.aim
    asked = {} if aim is None else {"target_std_m": aim.std_m, "time_budget_s": aim.seconds}
    return {
        "quality": plan.quality,
        "device": plan.device,
        "field": plan.field,
        "poses": plan.pose_choice,
        "image_scale": plan.image_scale,
        "calibrate_water": chosen.calibrate_water,
        "true_colour": chosen.true_colour,
        "tiles": 1 if job.tiling is None else len(job.tiling),
        **asked,
        "command": command_of(job, truth),
    }


def command_of(job: Job, truth: Truth) -> str:
    """The command line of a run, without its run folder."""
    chosen, aim = job.chosen, job.chosen.aim
    by_file = job.survey.config.process
    options = {
        "quality": chosen.quality if aim is None else None,
        "target-std": None if aim is None else aim.std_m,
        "time-budget": None if aim is None else aim.seconds,
        "device": chosen.device,
        "field": chosen.field,
        "poses": chosen.poses,
        "image-scale": chosen.image_scale if aim is None else None,
        "calibrate-water": chosen.calibrate_water,
        "true-colour": chosen.true_colour,
        "tiles": chosen.tiles,
        "memory": chosen.memory,
        "workers": chosen.workers,
        "scheduler": chosen.scheduler,
        "reference": truth.reference,
        "visible": truth.visible,
    }
    words = ["bathynerf", "process", str(job.survey.folder)]
    for name, value in options.items():
        # A default is stated too where survey.toml has another value.
        is_open = getattr(by_file, name.replace("-", "_"), None) in (None, value)
        if value is True or (value is False and not is_open):
            words.append(f"--{name}" if value else f"--no-{name}")
        elif value not in (None, False) and not (value == "auto" and is_open):
            words += [f"--{name}", str(value)]
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
