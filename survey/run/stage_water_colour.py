"""The stage of the water's colour: its absorption, estimated from the photographs where survey.toml does not say it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from fields.sweep.maps import HeightMap
from survey.run.stage_sweep import MAPS
from survey.run.stored_maps import Stored
from survey.run.water_colour import save_colour, with_colour

if TYPE_CHECKING:
    from survey.run.job import Job


def estimate_colour(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Estimate the absorption of the water from the photographs that have a height map."""
    maps = Stored(needs["sweep"] / MAPS, HeightMap)
    with job.progress.stage("Water colour"):
        save_colour(folder, job.sources(maps))


def use_colour(job: Job, folder: Path) -> None:
    """Give the job's survey the absorption that was found."""
    job.survey = with_colour(job.survey, folder)
    job.progress.note(f"water colour: {job.survey.findings.assumptions[-1]}")
