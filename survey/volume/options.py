"""Options of `bathynerf field`: of a training and its results, from the command line and from [field]."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from fields.models import Rule, maker
from fields.volume.weights import Losses
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun, survey_folder
from survey.files.toml_table import require_valid
from survey.run.stored_field import VolumeRecipe
from survey.settings.config import SurveyConfig, settings_of
from survey.settings.tables import FieldConfig
from survey.volume.monocular import priors_hash

# Weights of depth and of normals (MonoSDF, Yu et al. 2022).
MONOCULAR = (0.1, 0.05)


@dataclass(frozen=True)
class VolumeOptions(FieldConfig):
    """Options of the training of a radiance field on a run, and of its products, with their defaults."""

    model: str = "mdw"
    steps: int = 2000
    rays: int = 4096
    samples: int = 48
    cells: int = 256
    appearance: bool = False
    shell: bool = False
    from_scratch: bool = False
    # Where none of depth and normal has a weight, those of MonoSDF count with ``monocular``
    losses: Losses = field(default_factory=Losses)
    device: str = "auto"  # "auto", "cpu", "cuda" or "torch"

    def __post_init__(self):
        try:
            maker(self.model)
        except ValueError as error:
            raise SurveyError(str(error)) from error
        require_valid(self, FieldConfig, lambda each: each.name)
        if self.submodules is not None and not re.fullmatch("[1-9][0-9]{0,3}(x[1-9][0-9]{0,3})?", self.submodules):
            raise SurveyError(f"submodules is {self.submodules}, expected a number, or 3x2: along east and along north")
        for option, needed in self._without_effect():
            raise SurveyError(f"{option} has no effect without {needed}; give both or leave it out")
        if self.monocular is None and (self.losses.depth or self.losses.normal):
            raise SurveyError(
                "losses on monocular depth or normals have a weight, but there are none; name their folder with "
                "--monocular DIR"
            )

    def _without_effect(self) -> Iterator[tuple[str, str]]:
        """Options that were given and that nothing uses, with what they need."""
        of = self.losses
        if self.drop is not None and self.submodules is None:
            yield "--drop", "--submodules"
        if self.density is not None and self.rule is not Rule.density:
            yield "--density", "--extract density"
        if self.dry and self.cameras is None:
            yield "--dry", "--cameras"
        if of.transparency and not self.shell:
            # Light that passes the box is lost nowhere else: the last sample takes it.
            yield "[field.losses] transparency", "--shell"
        if of.patch_px is not None and not of.have_patches:
            yield "[field.losses] patch_px", "ncc, ssim or virtual_patches"

    def of_training(self, run: LoadedRun) -> dict[str, Any]:
        """All that the trained field depends on: the result of the run, the options, and the monocular priors."""
        made = ("rule", "density", "reference", "cameras", "dry", "survey", "device", "drop")
        settings = {name: value for name, value in asdict(self).items() if name not in made}
        priors = None if self.monocular is None else priors_hash(Path(self.monocular))
        of_run = {"run": str(run.folder.path.absolute()), "result": run.stages}
        return of_run | settings | {"monocular": priors}

    @property
    def recipe(self) -> VolumeRecipe:
        """Options of the model and its paths."""
        return VolumeRecipe.of({each.name: getattr(self, each.name) for each in fields(self)})

    def of_losses(self) -> Losses:
        """The weights of the losses, with those of monocular priors where none is given."""
        if self.monocular is None or self.losses.depth or self.losses.normal:
            return self.losses
        depth, normal = MONOCULAR
        return replace(self.losses, depth=depth, normal=normal)


def field_config(run: str | Path, survey: str | None) -> FieldConfig:
    """[field] in the current survey.toml of a run's survey (its folder, if it was moved), with absolute paths."""
    with LoadedRun(run) as loaded:
        folder = survey_folder(loaded, survey)
    config = (settings_of(folder) or SurveyConfig()).field
    if config.monocular is None:
        return config
    return replace(config, monocular=str((folder / config.monocular).absolute()))


def volume_options(config: FieldConfig, **others: Any) -> VolumeOptions:
    """`VolumeOptions` of a configuration; what it leaves open has its default."""
    given = {name: value for name, value in vars(config).items() if value is not None}
    return VolumeOptions(**given | others)
