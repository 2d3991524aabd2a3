"""What the result of a stage depends on, part by part, its hash, and the reason why a stage is computed again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from survey.folder.survey import Survey
from survey.settings.water import WaterColour
from survey.stage_key import code_hash, stage_key


def colour_of(survey: Survey) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
    """Absorption [1/m] and veiling light (linear, 1 for white) of red, green and blue; None where not known."""
    water = survey.config.water
    return (None, None) if water is None else (water.colour.absorption_per_m, water.colour.veiling_light)


def _water(job: Any) -> Any:
    departure = job.survey.observations.departure
    return job.survey.water if departure is None else (job.survey.water, departure.points, departure.stds)


def _water_settings(job: Any) -> Any:
    water = job.survey.config.water
    return None if water is None else replace(water, colour=WaterColour()), job.survey.observations.tide


# Parts of a `survey.run.job.Job` that stages depend on: in words, and what is hashed.
PARTS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "photographs": (
        "the photographs or masks",
        lambda job: [job.hashes[view.name] for view in job.survey.views],
    ),
    "cameras": ("poses or lenses", lambda job: [(view.name, view.camera, view.lens) for view in job.survey.views]),
    "water": ("the water", _water),
    "water_settings": ("level, slopes or index in survey.toml", _water_settings),
    "ties": ("the matches of structure from motion", lambda job: job.survey.observations.ties),
    "priors": (
        "positions, or the standard deviations of poses",
        lambda job: (
            dict(job.survey.observations.priors),
            job.survey.config.cameras,
            job.survey.provenance.contradiction,
        ),
    ),
    "control": (
        "the control points",
        lambda job: (job.survey.observations.control, job.survey.observations.ground),
    ),
    "freed": ("--calibrate-water", lambda job: job.chosen.calibrate_water),
    "heights": ("the range of heights", lambda job: job.limits),
    "area": ("the area", lambda job: job.area),
    "tiles": ("the tiles (--tiles, --memory)", lambda job: job.plan.tiling),
    "frame": ("the local frame", lambda job: job.survey.frame),
    "name": ("the name of the survey", lambda job: job.survey.name),
    "size": ("the size that images are worked on", lambda job: job.plan.image_scale),
    "gsd": ("the ground sampling distance", lambda job: job.plan.gsd_m),
    "refined": ("which pixels the sweep refines (--field, or --quality)", lambda job: job.plan.solves),
    "coverage": (
        "the number of views per place (--quality, or the program)",
        lambda job: job.plan.recipe.times_seen,
    ),
    "rays": (
        "the rays that the field learns from (--quality, or the program)",
        lambda job: (job.plan.field, job.plan.recipe.rays_per_cell),
    ),
    "boxes": ("whether the bed is looked for in boxes beside edges (--field)", lambda job: job.plan.boxes),
    "device": ("the device", lambda job: job.plan.device),
    "water_colour": ("the colour of the water", lambda job: colour_of(job.survey)),
    "true_colour": ("--true-colour", lambda job: colour_of(job.survey) if job.chosen.true_colour else None),
    "code": ("the program", lambda _job: code_hash()),
}


@dataclass(frozen=True)
class Key:
    """Key of a stage: the hashes of its inputs."""

    parts: Mapping[str, str]  # A hash for each part, or the folder of another stage, by its name

    @cached_property
    def digest(self) -> str:
        """Hash over all parts."""
        return stage_key(dict(self.parts))

    def reason(self, earlier: Iterable[Mapping[str, str]]) -> str | None:
        """Why a stage is computed again, in words: what differs from the earlier key that has most in common."""
        changed = [[name for name in {**self.parts, **of} if self.parts.get(name) != of.get(name)] for of in earlier]
        if not changed:
            return None
        names = min(changed, key=len)
        if not names:
            return "its earlier result is not whole"
        words = [PARTS[name][0] if name in PARTS else f"the result of the stage {name}" for name in names]
        return f"{' and '.join([', '.join(words[:-1]), words[-1]] if len(words) > 1 else words)} changed"
