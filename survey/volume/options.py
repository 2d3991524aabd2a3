"""Options of `bathynerf field`: of a training and its results, from the command line and from [field]."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from fields.models import maker
from fields.volume.losses import Losses, PatchWeights, PriorWeights
from fields.volume.surface import Rule
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun, survey_folder
from survey.run.stored_field import VolumeRecipe
from survey.settings.config import settings_of
from survey.settings.tables import FieldConfig, LossesConfig
from survey.volume.monocular import priors_hash
from survey.volume.scene import SceneOptions
from survey.words import Drop

# Weights of depth and of normals (MonoSDF, Yu et al. 2022).
MONOCULAR = (0.1, 0.05)


@dataclass(frozen=True)
class VolumeOptions:
    """Options of the training of a radiance field on a run, and of its products."""

    model: str = "mdw"  # a name of `fields.models.maker`
    # steps, rays, samples: Steps of training, paths of each, and samples of each path
    steps: int = 2000
    rays: int = 4096
    samples: int = 48
    cells: int = 256  # Along the longest edge at the finest scale, of models that have cells
    image_scale: float | None = None  # [-], optional: of the photographs; default: two pixels a cell
    # (E0, N0, E1, N1), optional, in crs: part of the bed; default: all of it
    bounds: tuple[float, float, float, float] | None = None
    held_every: int | None = None  # optional: every so many photographs one is left out and predicted
    from_scratch: bool = False  # Surfaces may be anywhere in the box at first; else within two cells of the run's bed
    straight: bool = False  # Rays are not bent, as in the fields of others
    appearance: bool = False  # A vector for each photograph that changes colours, for changing light
    shell: bool = False  # What lies beyond the box is learned, too (`fields.volume.shell`)
    # "N" or "NxM", optional: cells on the ground (along east and north) with a field of their own each, of ``cells``
    submodules: str | None = None
    drop: str | None = None  # A word of `survey.words.Drop`; default: geometry
    rule: Rule = Rule.median  # Where on a path the surface is
    # [1/m], optional: of ``Rule.density``; default: half of the light is stopped within a cell
    density: float | None = None
    reference: Path | None = None  # optional: mesh or cloud that the surface is compared with
    cameras: Path | None = None  # optional: poses of views to render; ``dry``, without the water
    dry: bool = False
    survey: str | None = None  # optional: folder of the survey, if it was moved since the run
    device: str = "auto"  # "auto", "cpu", "cuda" or "torch"
    seed: int = 0
    monocular: Path | None = None  # optional: folder of monocular depth and normals, see `survey.volume.monocular`
    # Where none of depth and normal has a weight, those of MonoSDF count with ``monocular``
    losses: LossesConfig = field(default_factory=LossesConfig)

    def __post_init__(self):
        try:
            maker(self.model)
        except ValueError as error:
            raise SurveyError(str(error)) from error
        for name, least in (("steps", 1), ("rays", 1), ("samples", 2), ("cells", 8), ("held_every", 2)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise SurveyError(f"{name} is {value}, expected at least {least}")
        if self.image_scale is not None and not 0.0 < self.image_scale <= 1.0:
            raise SurveyError(f"the image scale is {self.image_scale:g}, expected more than 0 and at most 1")
        if self.submodules is not None and not re.fullmatch("[1-9][0-9]{0,3}(x[1-9][0-9]{0,3})?", self.submodules):
            raise SurveyError(f"submodules is {self.submodules}, expected a number, or 3x2: along east and along north")
        if self.drop is not None and self.drop not in tuple(Drop):
            raise SurveyError(f"drop is {self.drop}, expected one of {', '.join(Drop)}")
        if self.density is not None and not 0.0 < self.density < np.inf:
            raise SurveyError(f"the density is {self.density:g}, expected more than 0, in 1/m")
        for option, needed in self._without_effect():
            raise SurveyError(f"{option} has no effect without {needed}; give both or leave it out")
        if self.monocular is None and (self.losses.depth or self.losses.normal or self.losses.predicted_normal):
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
        if of.patch_px is not None and not (of.ncc or of.ssim or of.smooth_normals or of.virtual_patches):
            yield "[field.losses] patch_px", "ncc, ssim, smooth_normals or virtual_patches"

    def of_training(self, run: LoadedRun) -> dict[str, Any]:
        """All that the trained field depends on: the result of the run, the options, and the monocular priors."""
        made = ("rule", "density", "reference", "cameras", "dry", "survey", "device", "drop")
        settings = {name: value for name, value in asdict(self).items() if name not in made}
        priors = None if self.monocular is None else priors_hash(self.monocular)
        return {"result": run.stages} | settings | {"monocular": priors}

    @property
    def scene(self) -> SceneOptions:
        """Options of the box and its photographs."""
        return SceneOptions(**{each.name: getattr(self, each.name) for each in fields(SceneOptions)})

    @property
    def recipe(self) -> VolumeRecipe:
        """Options of the model and its paths."""
        return VolumeRecipe.of({each.name: getattr(self, each.name) for each in fields(self)})

    def of_losses(self) -> Losses:
        """The weights of the losses."""
        of = self.losses
        depth, normal = of.depth, of.normal
        if self.monocular is not None and not (depth or normal):
            depth, normal = MONOCULAR
        return Losses(
            transparency=of.transparency,
            distortion=of.distortion,
            orientation=of.orientation,
            density=of.density,
            gaussian_density=of.gaussian_density,
            printed_density=of.printed_density,
            printed_gaussian_density=of.printed_gaussian_density,
            empty=of.empty,
            virtual_views=of.virtual_views,
            patches=PatchWeights(
                of.patch_px or PatchWeights.size, of.ncc, of.ssim, of.smooth_normals, of.virtual_patches
            ),
            priors=PriorWeights(depth=depth, normal=normal, predicted_normal=of.predicted_normal),
        )


def field_config(run: str | Path, survey: str | None) -> FieldConfig:
    """[field] in the current survey.toml of a run's survey, with absolute paths.

    Parameters
    ----------
    survey : str, optional
        Folder of the survey, if it was moved since the run.
    """
    with LoadedRun(run) as loaded:
        folder = survey_folder(loaded, survey)
    settings = settings_of(folder) if folder.is_dir() else None
    config = FieldConfig() if settings is None else settings.field
    if config.monocular is None:
        return config
    return replace(config, monocular=str((folder / config.monocular).absolute()))


def volume_options(config: FieldConfig, **others: Any) -> VolumeOptions:
    """`VolumeOptions` of a configuration; what it leaves open has its default."""
    given = {each.name: value for each in fields(config) if (value := getattr(config, each.name)) is not None}
    if config.monocular is not None:
        given["monocular"] = Path(config.monocular)
    return VolumeOptions(**given, **others)
