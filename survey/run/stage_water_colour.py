"""The stage of the water's colour: its absorption, estimated from the photographs where survey.toml does not say it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from fields.sweep.maps import HeightMap
from survey.errors import Findings, SurveyError
from survey.files.json_values import read_json_object, write_json
from survey.run.stage_sweep import MAPS
from survey.run.stored_maps import Stored
from survey.settings.water import WaterColour

if TYPE_CHECKING:
    from survey.run.job import Job

COLOUR_FILE = "water_colour.json"


def estimate_colour(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Estimate the absorption of the water from the photographs that have a height map."""
    # Imported where it is needed: it takes torch, whose import takes seconds.
    from fields.colour.true_colour import estimate_absorption

    with job.progress.stage("Water colour"):
        try:
            absorption = estimate_absorption(job.sources(Stored(needs["sweep"] / MAPS, HeightMap)))
        except ValueError as error:
            raise SurveyError(
                f"the absorption of the water cannot be estimated from the photographs: {error}; give [water] "
                "absorption_per_m and veiling_light in survey.toml, or leave --true-colour out"
            ) from error
        write_json(folder / COLOUR_FILE, {"absorption_per_m": absorption})


def use_colour(job: Job, folder: Path) -> None:
    """Give the job's survey the absorption that was found, and no veiling light."""
    red, green, blue = read_json_object(folder / COLOUR_FILE)["absorption_per_m"]
    _, given = job.survey.require_water()
    water = replace(given, colour=WaterColour((red, green, blue), (0.0, 0.0, 0.0)))
    listed = ", ".join(f"{a:.3f}" for a in (red, green, blue))
    note = f"absorption_per_m = [{listed}], from the photographs, and no veiling_light"
    findings = job.survey.findings + Findings(assumptions=(note,))
    job.survey = replace(job.survey, config=replace(job.survey.config, water=water), findings=findings)
    job.progress.detail(f"water colour: {note}")
