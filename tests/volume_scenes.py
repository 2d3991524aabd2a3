"""Volumes whose answer is known in closed form, and small photographs of them."""

import numpy as np
import torch
from torch import Tensor, nn

from fields.image_store import GAMMA
from fields.volume.model import Rates, VolumeModel
from fields.volume.paths import Box, Paths
from fields.volume.photographs import Photographs
from refract import FlatWater, PinholeCamera

BOX = Box(np.array([-1.0, -1.0, -2.0]), np.array([1.0, 1.0, -0.5]))
WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.333)


class Slab(VolumeModel):
    """Constant density [1/m] under a height [m] and nothing above it, of one linear radiance."""

    def __init__(self, density: float, top: float = 1e9, box: Box = BOX, radiance=(0.2, 0.4, 0.6)):
        super().__init__(box)
        self.level, self.top, self.colour = density, top, torch.tensor(radiance)

    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return torch.where(x[:, 2] < self.top, self.level, 0.0), x

    def radiance(self, features: Tensor, direction: Tensor, appearance: Tensor | None) -> Tensor:
        return self.colour.expand(len(features), 3)

    def rates(self) -> list[Rates]:
        return []


class Backdrop(nn.Module):
    """Constant colour behind the box: three numbers, 0 to 1, as a photograph stores it."""

    def __init__(self, stored: tuple[float, float, float]):
        super().__init__()
        self.register_buffer("linear", torch.tensor(stored) ** GAMMA)

    def forward(self, paths: Paths, _appearance: Tensor | None) -> Tensor:
        return self.linear.expand(len(paths), 3)


def looking_down(height: float = 3.0, *, tilt: float = 0.0, size: int = 24, x: float = 0.0) -> PinholeCamera:
    """A camera at a height [m] that looks at the middle of `BOX`, tilted to the north [rad]; pi looks away upwards."""
    c, s = np.cos(tilt), np.sin(tilt)
    rows = np.array([[1.0, 0.0, 0.0], [0.0, -c, -s], [0.0, s, -c]])
    centre = np.array([x, -s / c * (height + 1.25), height])
    return PinholeCamera(centre, rows, 2 * size, 2 * size, size / 2, size / 2, size, size)


def paint(xy: np.ndarray) -> np.ndarray:
    """Linear radiance (N, 3) of a bed, in waves of half a metre, at positions (N, 2) [m]."""
    x, y = xy.T
    waves = [np.sin(11.0 * x + 7.0 * y), np.sin(13.0 * y - 6.0 * x), np.cos(9.0 * x) * np.cos(10.0 * y)]
    return 0.35 + 0.2 * np.stack(waves, axis=-1)


def bed_photographs(
    height: float = -1.5, *, views: int = 7, size: int = 40, water: FlatWater | None = WATER
) -> Photographs:
    """Photographs of a painted level bed at a height [m], of the pixels that see it inside `BOX`."""
    cameras, images, pixels = [], [], []
    for view in range(views):
        turn = 2.0 * np.pi * view / views
        camera = looking_down(3.0, tilt=0.25 * np.sin(turn), size=size, x=0.6 * np.cos(turn))
        bent = camera.paths(camera.pixel_centres().reshape(-1, 2), water)
        points = bent.at_height(np.full(size * size, height), water)
        images.append(np.round(255.0 * paint(points[:, :2]) ** (1.0 / GAMMA)).astype(np.uint8).reshape(size, size, 3))
        pixels.append(np.flatnonzero((np.abs(points[:, :2]) < 0.95).all(axis=1)))
        cameras.append(camera)
    return Photographs(cameras, images, pixels, water)
