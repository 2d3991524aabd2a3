"""The colour of the water of a survey: given in survey.toml, or estimated from the photographs as a stage of a run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from geo.files import write_whole
from survey.errors import Findings, SurveyError
from survey.settings.water import WaterColour

if TYPE_CHECKING:
    from fields.sweep.maps import Sources
    from survey.folder.survey import Survey

COLOUR_FILE = "water_colour.json"


def colour_of(survey: Survey) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
    """Absorption [1/m] and veiling light (linear, 1 for white) of red, green and blue; None where not known."""
    water = survey.config.water
    return (None, None) if water is None else (water.colour.absorption_per_m, water.colour.veiling_light)


def colour_is_known(survey: Survey) -> bool:
    """Whether survey.toml gives absorption and veiling light."""
    return colour_of(survey)[0] is not None


def save_colour(folder: Path, sources: Sources) -> None:
    """Estimate the absorption and write it into the folder of its stage."""
    # Imported where it is needed: it takes torch, whose import takes seconds.
    from fields.colour.true_colour import estimate_absorption

    try:
        absorption = estimate_absorption(sources)
    except ValueError as error:
        raise SurveyError(
            f"the absorption of the water cannot be estimated from the photographs: {error}; give [water] "
            "absorption_per_m and veiling_light in survey.toml, or leave --true-colour out"
        ) from error
    with write_whole(folder / COLOUR_FILE) as stream:
        stream.write(json.dumps({"absorption_per_m": absorption}, indent=2).encode())


def with_colour(survey: Survey, folder: Path) -> Survey:
    """The survey with the colour that `save_colour` found, and none for the veil."""
    record = json.loads((folder / COLOUR_FILE).read_text(encoding="utf-8"))
    red, green, blue = record["absorption_per_m"]
    _, given = survey.require_water()
    water = replace(given, colour=WaterColour((red, green, blue), (0.0, 0.0, 0.0)))
    listed = ", ".join(f"{a:.3f}" for a in (red, green, blue))
    note = f"absorption_per_m = [{listed}], from the photographs, and no veiling_light"
    findings = survey.findings + Findings(assumptions=(note,))
    return replace(survey, config=replace(survey.config, water=water), findings=findings)
