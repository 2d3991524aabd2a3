"""The radiance fields by their names, the one list that options, help and tests follow.

And the weights of the terms beside the squared error of the colours (`fields.volume.losses`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

GROUP = "bathynerf.fields"  # Entry points of other packages that name models
APPEARANCE = 16  # A vector of this length for each photograph, where appearance is learned


class Rule(StrEnum):
    """Definition of the surface on a path: the median or the mode of its weights, or the first dense sample."""

    median = "median"
    mode = "mode"
    density = "density"


PATCH_PX = 8  # Side of patches [px] where none is given


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


@dataclass(frozen=True)
class Entry:
    """A model of the list."""

    label: str  # In tables and pictures of benchmarks
    made_by: str  # "module:callable" in fields.volume that makes it, untrained, of a `Setup`; imported when built
    published: Mapping[str, Any] = field(default_factory=dict)  # Options of `bathynerf field` as in its paper


_MDW = {"steps": 150_000, "rays": 4096, "cells": 256}
# 2048 cells of Nerfacto's table are four times 512.
_NERFACTO = {"steps": 30_000, "rays": 4096, "cells": 512, "losses": Losses(distortion=0.002)}
_OCTREE = {"steps": 10_000, "rays": 4096, "losses": Losses(distortion=0.002, empty=0.001, printed_density=0.002)}
MODELS = {
    "mdw": Entry("MDW", "tensor:mdw", _MDW),
    "m": Entry("M", "tensor:m", _MDW),
    "dw": Entry("DW", "tensor:dw", _MDW),
    "vm": Entry("VM", "tensor:vm", _MDW),
    "tensorf": Entry("TensoRF", "tensorf:tensorf", {"steps": 30_000, "rays": 4096, "cells": 300}),
    "nerf": Entry("NeRF", "mlp:nerf", {"rays": 2048}),
    "tinynerf": Entry("TinyNeRF", "mlp:tinynerf", {"steps": 1000, "samples": 32}),
    "nerfacto": Entry("Nerfacto", "nerfacto:nerfacto", _NERFACTO),
    "hash": Entry("hash grid, proposals", "nerfacto:hash_grid"),
    "octree": Entry("octree of fields", "octree:octree", _OCTREE),
    "ground": Entry("ground planes", "mlp:ground", {"steps": 120_000, "rays": 4096}),
}
IN_LAYER = ("mdw", "m", "dw", "vm")  # Those that `bathynerf process --field` offers, in a layer about the bed


def maker(name: str) -> Callable[[Any], Any]:
    """What makes a model of a `fields.volume.model.Setup`.

    Raises ValueError if there is none of that name, or it cannot be imported. ``name``: a key of `MODELS`, an entry
    point of `GROUP`, or "package.module:Class".
    """
    place = f"fields.volume.{MODELS[name].made_by}" if name in MODELS else name
    if ":" not in place:
        found = {point.name: point for point in entry_points(group=GROUP)}
        if place not in found:
            raise ValueError(
                f"there is no model {name}; expected one of {', '.join([*MODELS, *found])}, or package.module:Class of "
                "an installed package"
            )
        place = found[place].value
    module, _, attribute = place.partition(":")
    try:
        return getattr(import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"the model {name} cannot be imported from {place}: {error}") from error
