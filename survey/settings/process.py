"""[process] of survey.toml: what is asked of a run; options and the environment ask the same, one over the other."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from survey.errors import ConfigError
from survey.files.toml_table import key, require_one_of
from survey.words import SCALES, Device, Field, Plan, Poses, Quality

# A quality, a field and an image scale are a recipe; an aim chooses its own.
_RECIPE, _AIM = ("quality", "field", "image_scale"), ("target_std_m", "time_budget_s")
_WORDS = {"quality": Quality, "device": Device, "field": Field, "poses": Poses, "plan": Plan}


@dataclass(frozen=True)
class ProcessConfig:
    """[process]: options of `process` and `check`, as they are called there; None leaves one open."""

    quality: str | None = key(None, "one of draft, standard, fine", one_of=Quality)
    target_std_m: float | None = key(None, "a standard deviation in metres, in place of a quality")
    time_budget_s: float | None = key(None, "the seconds that a run may take, in place of a quality")
    device: str | None = key(None, "one of auto, cpu, cuda", one_of=Device)
    field: str | None = key(None, "one of auto, solver, slab, off", one_of=Field)
    poses: str | None = key(None, "one of auto, fixed, refine", one_of=Poses)
    plan: str | None = key(None, "one of auto, full", one_of=Plan)
    image_scale: float | None = key(None, "1, 0.5, 0.25, ...", one_of=SCALES)
    calibrate_water: bool | None = None
    true_colour: bool | None = None
    tiles: int | None = None
    memory: str | None = key(None, "a size such as 8GB")
    workers: int | None = None
    scheduler: str | None = key(None, "the address of a Dask scheduler, such as tcp://host:8786")

    def over(self, lower: ProcessConfig) -> ProcessConfig:
        """These, and what `lower` says of those that are open; an aim displaces a recipe, and a recipe an aim."""
        displaced: tuple[str, ...] = ()
        if self._says(_AIM):
            displaced += _RECIPE
        if self._says(_RECIPE):
            displaced += _AIM
        names = [field.name for field in dataclasses.fields(self)]
        rest = {name: getattr(lower, name) for name in names if name not in displaced and getattr(self, name) is None}
        return dataclasses.replace(self, **rest)

    def _says(self, names: tuple[str, ...]) -> bool:
        return any(getattr(self, name) not in (None, Field.auto) for name in names)

    def require_sane(self) -> None:
        """Raise ConfigError at a word or number that is not known, or where an aim and a recipe are asked for."""
        for name, words in _WORDS.items():
            if getattr(self, name) is not None:
                require_one_of(f"[process] {name}", getattr(self, name), tuple(words))
        if self.image_scale is not None and self.image_scale not in SCALES:
            known = ", ".join(f"{each:g}" for each in SCALES)
            raise ConfigError(f"[process] image_scale is {self.image_scale:g}, expected one of {known}")
        for name in _AIM:
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ConfigError(f"[process] {name} is {value:g}, expected a number above zero")
        if self._says(_AIM) and self._says(_RECIPE):
            said = [name for name in (*_AIM, *_RECIPE) if getattr(self, name) not in (None, Field.auto)]
            raise ConfigError(
                f"[process] has {' and '.join(said)}, but {' and '.join(_AIM)} choose quality, field and image scale "
                "themselves; keep one kind"
            )
