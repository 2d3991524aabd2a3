"""The published radiance fields by their names, over one box and along the same bent paths.

| name | field | source |
|---|---|---|
| tensorf | planes times vectors at one scale, density linear in the features | Chen et al. 2022 |
| m, dw, mdw | the same at several scales, with weighted density, with both | MDW-NeRF |
| nerf, tinynerf | a multilayer perceptron of sines of the position | Mildenhall et al. 2020 |
| nerfacto | a hash grid with two rounds of proposals | Tancik et al. 2023; Müller et al. 2022 |
| hash | the same at a size for processors, with one round | |
| neus | a signed distance, narrower networks, a level surface at first | Wang et al. 2021 |
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from fields.device import Device
from fields.volume.hash_grid import HashSettings, HashVolume
from fields.volume.mlp import MlpSettings, MlpVolume
from fields.volume.model import VolumeModel
from fields.volume.paths import Box
from fields.volume.proposal import Proposal, ProposalSettings
from fields.volume.sdf import SdfSettings, SdfVolume
from fields.volume.tensor import TensorSettings, TensorVolume

# A vector of this length for each photograph, where appearance is learned.
APPEARANCE = 16
# Learning rate of the factors after the switch to weighted density: with the paper's 0.001, which is for 150,000 steps,
# they hardly change in some thousands.
FINE_RATE = 0.02

Make = Callable[[Box, int, Device, int], VolumeModel]


def _tensor(name: str) -> Make:
    def make(box: Box, cells: int, device: Device, appearance: int) -> VolumeModel:
        settings = getattr(TensorSettings, name)(n_min=max(cells // 4, 2), n_max=cells, fine_rate=FINE_RATE)
        return TensorVolume(box, settings, device, appearance=appearance)

    return make


# Each takes a box, the cells along its longest edge, a device and the length of appearance vectors.
MODELS: dict[str, Make] = {
    **{name: _tensor(name) for name in ("tensorf", "m", "dw", "mdw")},
    "nerf": lambda box, _cells, _device, more: MlpVolume(box, MlpSettings.nerf(), appearance=more),
    "tinynerf": lambda box, _cells, _device, more: MlpVolume(box, MlpSettings.tiny_nerf(), appearance=more),
    "nerfacto": lambda box, cells, _device, more: HashVolume(box, HashSettings(n_max=4 * cells), appearance=more),
    "hash": lambda box, cells, _device, more: HashVolume(
        box, HashSettings(levels=8, log2_table=15, n_max=4 * cells), appearance=more
    ),
    # A bed is open, with water above.
    "neus": lambda box, _cells, _device, more: SdfVolume(
        box, SdfSettings.small(start="plane", start_at=0.0), appearance=more
    ),
}


def build_model(name: str, box: Box, cells: int, device: Device, *, appearance: int = 0, seed: int = 0) -> VolumeModel:
    """An untrained model.

    Parameters
    ----------
    name : key of `MODELS`
    box : Box
    cells : int
        Along the longest edge of the box at the finest scale; models without cells ignore it.
    device : Device
        For the lookups of those with planes.
    appearance : int
        Length of the vectors of photographs; 0 for none.
    seed : int
    """
    torch.manual_seed(seed)
    return MODELS[name](box, cells, device, appearance)


def proposal_for(name: str, box: Box, cells: int) -> Proposal | None:
    """What draws the samples of a model in place of the occupied cells; None for all but the hash grids."""
    if name == "nerfacto":
        return Proposal(box, ProposalSettings(n_max=(max(cells // 2, 2), cells)))
    return Proposal(box, ProposalSettings((48,), (cells,))) if name == "hash" else None
