"""The published radiance fields by their names, over one box and along the same bent paths.

| name | field | source |
|---|---|---|
| tensorf | planes times vectors, of density and of colour apart, refined in steps | Chen et al. 2022 |
| mdw | planes times vectors at several scales, with weighted density | MDW-NeRF |
| mdw-printed | the same with colour as its paper prints it, and L1 of the density features | MDW-NeRF |
| m, dw, vm | mdw without the weighting, without the scales, without both | its ablation |
| nerf, tinynerf | a multilayer perceptron of sines of the position | Mildenhall et al. 2020 |
| nerfacto | a hash grid with two rounds of proposals | Tancik et al. 2023; Müller et al. 2022 |
| hash | the same at a size for processors, with one round | |
| octree | grids of an octree's nodes, which grows where density has detail | Inf-NeRF |
| ground | planes over the ground, and a perceptron beside them | Grid-NeRF |
| neus | a signed distance, narrower networks, a level surface at first | Wang et al. 2021 |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from fields.device import Device
from fields.volume.ground_plane import GroundPlaneSettings, GroundPlaneVolume
from fields.volume.hash_grid import HashSettings, HashVolume
from fields.volume.mlp import MlpSettings, MlpVolume
from fields.volume.model import VolumeModel
from fields.volume.octree import OctreeSettings, OctreeVolume
from fields.volume.paths import Box
from fields.volume.proposal import Proposal, ProposalSettings
from fields.volume.sdf import SdfSettings, SdfVolume
from fields.volume.tensor import TensorSettings, TensorVolume
from fields.volume.tensorf import TensorfSettings, TensorfVolume

# A vector of this length for each photograph, where appearance is learned.
APPEARANCE = 16
# Learning rate of the factors after the switch to weighted density: with the paper's 0.001, which is for 150,000 steps,
# they hardly change in some thousands.
FINE_RATE = 0.02

# Shares of the steps over which NeuS and Nerfacto anneal: 50,000 of 300,000 and 1000 of 30,000 as published.
NEUS_ANNEALED, NERFACTO_ANNEALED = 1 / 6, 1 / 30
# Cells of TensoRF at first, of those at last.
_COARSEST = 128 / 300


@dataclass(frozen=True)
class Setup:
    """What a model is built for: box, resolution, device, steps."""

    box: Box
    cells: int  # Along the longest edge of the box at the finest scale; models without cells ignore it
    device: Device  # For the lookups of those with planes
    appearance: int = 0  # Length of the vectors of photographs; 0 for none
    steps: int = 2000  # Of the training that follows


Make = Callable[[Setup], VolumeModel]


def _tensor(name: str) -> Make:
    def make(of: Setup) -> VolumeModel:
        settings = getattr(TensorSettings, name)(n_min=max(of.cells // 4, 2), n_max=of.cells, fine_rate=FINE_RATE)
        return TensorVolume(of.box, settings, of.device, appearance=of.appearance)

    return make


def _tensorf(of: Setup) -> VolumeModel:
    settings = TensorfSettings(n_min=max(round(_COARSEST * of.cells), 2), n_max=of.cells, steps=of.steps)
    return TensorfVolume(of.box, settings, of.device, appearance=of.appearance)


def _octree(of: Setup) -> VolumeModel:
    settings = OctreeSettings(cells=max(of.cells // 4, 2), steps=of.steps)
    return OctreeVolume(of.box, settings, appearance=of.appearance)


def _ground(of: Setup) -> VolumeModel:
    settings = GroundPlaneSettings(n_min=max(of.cells // 4, 2), n_max=of.cells, steps=of.steps)
    return GroundPlaneVolume(of.box, settings, of.device, appearance=of.appearance)


def _neus(of: Setup) -> VolumeModel:
    settings = SdfSettings.small(start="plane", start_at=0.0, annealed=NEUS_ANNEALED, steps=of.steps)
    return SdfVolume(of.box, settings, appearance=of.appearance)


def _hash(of: Setup, **sizes: int) -> VolumeModel:
    return HashVolume(of.box, HashSettings(n_max=4 * of.cells, **sizes), appearance=of.appearance)


MODELS: dict[str, Make] = {
    "mdw": _tensor("mdw"),
    "mdw-printed": _tensor("published"),
    "m": _tensor("m"),
    "dw": _tensor("dw"),
    "vm": _tensor("vm"),
    "tensorf": _tensorf,
    "nerf": lambda of: MlpVolume(of.box, MlpSettings.nerf(), appearance=of.appearance),
    "tinynerf": lambda of: MlpVolume(of.box, MlpSettings.tiny_nerf(), appearance=of.appearance),
    "nerfacto": _hash,
    "hash": lambda of: _hash(of, levels=8, log2_table=15, degree=2),
    "octree": _octree,
    "ground": _ground,
    # A bed is open, with water above.
    "neus": _neus,
}


def build_model(
    name: str, box: Box, cells: int, device: Device, *, appearance: int = 0, seed: int = 0, steps: int = Setup.steps
) -> VolumeModel:
    """An untrained model, key of `MODELS`, drawn from a seed; the others are those of `Setup`."""
    torch.manual_seed(seed)
    return MODELS[name](Setup(box, cells, device, appearance, steps))


def proposal_for(name: str, box: Box, cells: int, steps: int) -> Proposal | None:
    """Proposal that draws the samples of a model in place of the occupied cells, for a training of so many steps.

    None for all but the hash grids.
    """
    if name == "nerfacto":
        annealed = round(NERFACTO_ANNEALED * steps)
        return Proposal(box, ProposalSettings(n_max=(max(cells // 2, 2), cells), annealed=annealed))
    return Proposal(box, ProposalSettings((48,), (cells,))) if name == "hash" else None
