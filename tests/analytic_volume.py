"""Volumes whose density and colour are formulas, and paths through them, for the tests of losses."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from fields.volume.model import Rates, VolumeModel
from fields.volume.paths import Box, Paths, paths_of
from refract import FlatWater, PinholeCamera

BOX = Box(np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, 1.0]))
WATER = FlatWater((0.0, 0.0, 2.0), n_water=1.333)


class AnalyticVolume(VolumeModel):
    """Density a formula of positions (S, 3); colour a formula of x and y, brighter by the appearance's mean."""

    def __init__(self, density: Callable[[Tensor], Tensor], box: Box = BOX):
        super().__init__(box)
        self.density = density
        self.scale = nn.Parameter(torch.ones(()))

    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.scale * self.density(x), x

    def radiance(self, features: Tensor, direction: Tensor, appearance: Tensor | None) -> Tensor:
        x, y, _ = features.unbind(-1)
        seen = torch.stack([0.5 + 0.4 * torch.sin(3.0 * x), 0.5 + 0.4 * torch.cos(2.0 * y), 0.4 + 0.0 * x], dim=-1)
        return seen if appearance is None else seen * torch.exp(appearance.mean(dim=1, keepdim=True))

    def rates(self) -> list[Rates]:
        return [Rates([self.scale], 0.01)]


def floor_at(height: float, *, width: float = 0.01, density: float = 200.0) -> AnalyticVolume:
    """Opaque below a height [m]."""
    return AnalyticVolume(lambda x: density * torch.sigmoid((height - x[..., 2]) / width))


def looking_down(x: float = 0.0, y: float = 0.0, *, size: int = 24) -> PinholeCamera:
    """A camera 5 m over the middle of the box that sees about two thirds of its floor."""
    down = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    return PinholeCamera(np.array([x, y, 5.0]), down, 3.5 * size, 3.5 * size, size / 2, size / 2, size, size)


def seen_by(camera: PinholeCamera, water: FlatWater | None = None, view: int = 0, box: Box = BOX) -> Paths:
    """Paths through all pixels of a camera, row by row, grey."""
    pixels = camera.pixel_centres().reshape(-1, 2)
    return paths_of(camera, water, pixels, np.full((len(pixels), 3), 128), box, view)
