"""A radiance field for tests: it begins as an opaque level surface in the middle of its box."""

import torch
from torch import Tensor, nn

from fields.volume.model import Rates, Setup, VolumeModel

NAME = "level_field:LevelField"


class LevelField(VolumeModel):
    """A height that is learned, over which there is nothing, and a colour linear in place and direction."""

    def __init__(self, setup: Setup):
        super().__init__(setup.box)
        self.cell = setup.box.edge / setup.cells
        self.height = nn.Parameter(0.01 * torch.randn(()))
        self.colour = nn.Linear(6 + setup.appearance, 3)

    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        p = self.box.centred(x)
        below = (self.height - p[:, 2]) * (0.5 * self.box.edge / self.cell)
        return 8.0 / self.cell * torch.sigmoid(8.0 * below), p

    def radiance(self, features: Tensor, direction: Tensor, appearance: Tensor | None) -> Tensor:
        seen = [features, direction] if appearance is None else [features, direction, appearance]
        return nn.functional.softplus(self.colour(torch.cat(seen, dim=1)))

    def rates(self) -> list[Rates]:
        return [Rates(list(self.parameters()), 0.001)]
