"""[field] of survey.toml: how `bathynerf field` trains a radiance field on a run; its options come first."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from survey.errors import ConfigError
from survey.files.toml_table import key


@dataclass(frozen=True)
class LossesConfig:
    """[field.losses]: weights of what is minimised beside the squared error of the colours; 0 leaves a term out."""

    transparency: float = 0.0  # light that passes the bed
    distortion: float = 0.0  # spread of the weights along a ray (mip-NeRF 360)
    orientation: float = 0.0  # surfaces that face away (Ref-NeRF)
    # density, gaussian_density: density between empty and full (Inf-NeRF), with Gaussians in place of nodes
    density: float = 0.0
    gaussian_density: float = 0.0
    # printed_density, printed_gaussian_density: both as printed; empty: all that is not empty (Inf-NeRF)
    printed_density: float = 0.0
    printed_gaussian_density: float = 0.0
    empty: float = 0.0
    # virtual_views, ncc, ssim, smooth_normals: on patches and views beside the photographs' own (MonoPatchNeRF)
    virtual_views: float = 0.0
    ncc: float = 0.0
    ssim: float = 0.0
    smooth_normals: float = 0.0
    virtual_patches: float = 0.0
    huber: float = 0.0  # limit of Huber's loss of the colours (MonoPatchNeRF: 0.1); 0: the squared error
    # depth, normal: departures from monocular depth and normals (MonoSDF); need `monocular`
    depth: float = 0.0
    normal: float = 0.0
    predicted_normal: float = 0.0  # of normals that a head predicts (MonoPatchNeRF); needs `monocular`
    patch_px: int = 8  # side of the patches

    def __post_init__(self):
        for name, value in dataclasses.asdict(self).items():
            if value < 0.0:
                raise ConfigError(f"field.losses.{name} is {value:g}, expected 0 or more")
        if self.patch_px < 3:
            raise ConfigError(f"field.losses.patch_px is {self.patch_px}, expected 3 pixels or more")


@dataclass(frozen=True)
class FieldConfig:
    """[field]: options of `bathynerf field`, as they are called there; None leaves one open."""

    model: str | None = key(None, "a model of bathynerf field")
    steps: int | None = None
    rays: int | None = None
    samples: int | None = None
    cells: int | None = None
    image_scale: float | None = None
    held_every: int | None = None
    appearance: bool | None = None
    from_scratch: bool | None = None
    monocular: str | None = key(None, "a folder of monocular depth and normals, relative to the survey folder")
    losses: LossesConfig | None = None

    def over(self, lower: FieldConfig) -> FieldConfig:
        """These, and what `lower` says of those that are open."""
        names = [each.name for each in dataclasses.fields(self)]
        return dataclasses.replace(self, **{n: getattr(lower, n) for n in names if getattr(self, n) is None})
