"""A drawn tidal flat: a gentle slope with two winding channels under a thin film of water, its upper end dry.

Every photograph has its own exposure and tint, as under drifting clouds. Colours are those of `switch_scene`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from switch_scene import colour

from fields.image_store import GAMMA
from fields.volume.paths import Box
from fields.volume.photographs import Photographs, pixels_over
from refract import FlatWater, PinholeCamera

BOX = Box(np.array([-6.0, -2.0, -0.7]), np.array([6.0, 2.0, 0.4]))
WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.333)
ROWS, COLUMNS = 3, 7  # of photographs
HELD = (8, 10, 12)  # in the middle row
NOISE = 2.0


@dataclass(frozen=True)
class Flat:
    """Channels of the flat: where they wind about, how far, how deep and how wide they are [m]."""

    middle: np.ndarray
    swing: np.ndarray
    length: np.ndarray
    phase: np.ndarray
    depth: np.ndarray
    width: np.ndarray

    @staticmethod
    def drawn(rng: np.random.Generator) -> Flat:
        """Two channels drawn at random."""
        between = ((-1.2, 1.2), (0.3, 0.8), (5.0, 10.0), (0.0, 6.28), (0.15, 0.25), (0.3, 0.6))
        return Flat(*(rng.uniform(low, high, 2) for low, high in between))

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Heights (...) [m]: a slope of 1.2 % from under 0.1 m of water to a dry end, less the channels."""
        z = 0.012 * x - 0.03 + 0.01 * np.sin(4.0 * x + y)
        for k in range(2):
            line = self.middle[k] + self.swing[k] * np.sin(2.0 * np.pi * x / self.length[k] + self.phase[k])
            z = z - self.depth[k] * np.exp(-(((y - line) / self.width[k]) ** 2))
        return z

    def points(self, camera: PinholeCamera) -> np.ndarray:
        """Points (height, width, 3) [m] that a camera shows: on the way in air, or else on that in water."""
        paths = camera.paths(camera.pixel_centres(), WATER)
        dry = self._met(np.broadcast_to(camera.centre, paths.crossing.shape), paths.air_direction)
        wet = self._met(paths.crossing, paths.water_direction)
        return np.where((dry[..., 2] > 0.0)[..., None], dry, wet)

    def _met(self, start: np.ndarray, way: np.ndarray) -> np.ndarray:
        """Where ways meet the bed, by bisection of a way from over the box to under it."""
        high, low = ((level - start[..., 2]) / way[..., 2] for level in (BOX.high[2], BOX.low[2]))
        for _ in range(30):
            middle = 0.5 * (high + low)
            at = start + middle[..., None] * way
            above = at[..., 2] > self.height(at[..., 0], at[..., 1])
            high, low = np.where(above, middle, high), np.where(above, low, middle)
        return start + (0.5 * (high + low))[..., None] * way

    def grid(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (N, 3) [m] of the bed in the box, and its triangles (T, 3)."""
        x, y = np.meshgrid(*(np.arange(BOX.low[k], BOX.high[k] + 0.5 * spacing, spacing) for k in (0, 1)))
        number = np.arange(x.size).reshape(x.shape)
        a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
        faces = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)])
        return np.stack([x, y, self.height(x, y)], axis=-1).reshape(-1, 3), faces


@dataclass(frozen=True)
class FlatScene:
    """Photographs of a flat: to learn from, and kept aside with all their pixels that show the box."""

    flat: Flat
    train: Photographs
    held: Photographs


def build(seed: int) -> FlatScene:
    """A flat and its photographs."""
    rng = np.random.default_rng(seed)
    flat = Flat.drawn(rng)
    cameras = [_camera(k, rng) for k in range(ROWS * COLUMNS)]
    images, shown = [], []
    for camera in cameras:
        light = colour(flat.points(camera)) * np.exp(rng.normal(0.0, 0.3) + rng.normal(0.0, 0.08, 3))
        stored = 255.0 * np.clip(light, 0.0, 1.0) ** (1.0 / GAMMA) + rng.normal(0.0, NOISE, light.shape)
        images.append(np.clip(np.round(stored), 0, 255).astype(np.uint8))
        shown.append(pixels_over(camera, BOX, WATER))

    def some(which: list[int]) -> Photographs:
        return Photographs(*([each[k] for k in which] for each in (cameras, images, shown)), WATER)

    return FlatScene(flat, some([k for k in range(ROWS * COLUMNS) if k not in HELD]), some(list(HELD)))


def _camera(number: int, rng: np.random.Generator) -> PinholeCamera:
    """About 7 m over the flat, in even rows, looking down within some degrees."""
    row, column = divmod(number, COLUMNS)
    at = np.array([10.0 * column / (COLUMNS - 1) - 5.0, 2.0 * row / (ROWS - 1) - 1.0])
    centre = np.array([*at + rng.uniform(-0.2, 0.2, 2), rng.uniform(6.5, 7.5)])
    ahead = np.array([*rng.uniform(-0.2, 0.2, 2), -1.0])
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.1, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return PinholeCamera(centre, np.stack([right, np.cross(ahead, right), ahead]), 130.0, 130.0, 48.0, 36.0, 96, 72)
