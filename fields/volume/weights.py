"""Weights of the terms beside the squared error of the colours; `fields.volume.losses` has the terms."""

from __future__ import annotations

from dataclasses import dataclass

# Side of patches [px] where none is given.
PATCH_PX = 8


@dataclass(frozen=True)
class Losses:
    """[field.losses]: weights of the terms added to the squared error of the colours; 0 leaves a term out."""

    transparency: float = 0.0  # light that passes the bed
    distortion: float = 0.0  # spread of the weights along a ray (mip-NeRF 360)
    # density, gaussian_density: density between empty and full (Inf-NeRF), with Gaussians in place of nodes
    density: float = 0.0
    gaussian_density: float = 0.0
    # printed_density, printed_gaussian_density: both as printed; empty: all that is not empty (Inf-NeRF)
    printed_density: float = 0.0
    printed_gaussian_density: float = 0.0
    empty: float = 0.0
    # ncc, ssim, virtual_patches: on patches of the photographs and of views beside their own (MonoPatchNeRF)
    ncc: float = 0.0
    ssim: float = 0.0
    virtual_patches: float = 0.0
    # depth, normal: departures from monocular depth and normals (MonoSDF), which the photographs must carry
    depth: float = 0.0
    normal: float = 0.0
    patch_px: int | None = None  # side of the patches; default: 8

    def __post_init__(self):
        for name, value in vars(self).items():
            least = 3 if name == "patch_px" else 0
            if value is not None and value < least:
                raise ValueError(f"{name} is {value:g}, expected {least} or more")

    @property
    def have_patches(self) -> bool:
        """Whether any of the losses on patches counts."""
        return bool(self.ncc or self.ssim or self.virtual_patches)

    @property
    def patch(self) -> int:
        """Side [px] of the patches that training has to draw; 1 for single pixels."""
        return (self.patch_px or PATCH_PX) if self.have_patches else 1
