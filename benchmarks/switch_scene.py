"""A small scene with a known surface, for what is measured in minutes: a block and a ramp on a bed under 2 m of water.

Colours are a sum of waves in space (a solid texture), so that every photograph is exact but for its noise; a disc of
the bed and the top of the block have next to none.
"""

from dataclasses import dataclass

import numpy as np
import torch

from fields.image_store import GAMMA
from fields.volume.paths import Box, Paths
from fields.volume.photographs import Photographs, PriorImages
from refract import FlatWater, PinholeCamera

BOX = Box(np.array([-2.0, -2.0, -2.3]), np.array([2.0, 2.0, -0.9]))
WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.333)
BED, BLOCK = -2.0, (np.array([-0.9, -0.5, -2.0]), np.array([0.2, 0.4, -1.2]))
# The ramp rises along x from the bed, between these x and y.
RAMP_X, RAMP_Y, RAMP_SLOPE = (0.8, 1.8), (-1.5, 1.0), 0.5
SMOOTH_CENTRE, SMOOTH_RADIUS = np.array([0.0, 1.2]), 0.5
VIEWS, HELD_EVERY = 24, 6
NOISE = 2.0


@dataclass(frozen=True)
class SwitchScene:
    """Photographs to learn from and to compare with, and the path length to the surface in each of the latter."""

    train: Photographs
    held: Photographs
    length: list[np.ndarray]


def build(
    *,
    exposed: bool = False,
    wide: bool = False,
    priors: bool = False,
    seed: int = 0,
    water: FlatWater | None = WATER,
    enlarged: float = 1.0,
) -> SwitchScene:
    """The scene.

    Parameters
    ----------
    exposed : bool
        Each photograph has its own exposure and white balance.
    wide : bool
        Photographs take in the bed beyond the box, which is endless; else they are cut to what lies inside.
    priors : bool
        The photographs carry rough monocular depths and normals.
    water : FlatWater or None
        None for a dry scene.
    enlarged : float
        Size of the photographs that are compared with, which then have no noise.
    """
    rng = np.random.default_rng(seed)
    cameras = [_camera(k, wide, rng) for k in range(VIEWS)]
    pictures, shown, lengths, known = [], [], [], []
    held = [k for k in range(VIEWS) if k % HELD_EVERY == HELD_EVERY // 2]
    if enlarged != 1.0:
        cameras = [each.scaled(enlarged) if k in held else each for k, each in enumerate(cameras)]
    for number, camera in enumerate(cameras):
        points, normals, length = surface(camera, water)
        light = colour(points)
        if exposed:
            light = light * np.exp(rng.normal(0.0, 0.3) + rng.normal(0.0, 0.08, 3))
        noise = 0.0 if enlarged != 1.0 and number in held else NOISE
        stored = 255.0 * np.clip(light, 0.0, 1.0) ** (1.0 / GAMMA) + rng.normal(0.0, noise, light.shape)
        pictures.append(np.clip(np.round(stored), 0, 255).astype(np.uint8))
        inside = ((points > BOX.low) & (points < BOX.high)).all(axis=-1)
        shown.append(np.arange(inside.size) if wide else np.flatnonzero(inside))
        lengths.append(np.where(inside, length, np.nan))
        known.append(rough_priors(camera, normals, length, rng))
    rest = [k for k in range(VIEWS) if k not in held]

    def some(which: list[int]) -> Photographs:
        lists = ([values[k] for k in which] for values in (cameras, pictures, shown))
        return Photographs(*lists, water, [known[k] for k in which] if priors else None)

    return SwitchScene(some(rest), some(held), [lengths[k] for k in held])


def _camera(index: int, wide: bool, rng: np.random.Generator) -> PinholeCamera:
    """On a spiral 5 to 7 m above the water, looking at the block; wide ones with half the focal length."""
    turn, out = 2.4 * index, (5.0 if wide else 3.0) * np.sqrt((index + 0.5) / VIEWS)
    centre = np.array([out * np.cos(turn), out * np.sin(turn), rng.uniform(5.0, 7.0)])
    ahead = np.array([*rng.uniform(-0.3, 0.3, 2), -1.7]) - centre
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.1, 1.0, 0.0])
    right /= np.linalg.norm(right)
    focal = 80.0 if wide else 160.0
    return PinholeCamera(centre, np.stack([right, np.cross(ahead, right), ahead]), focal, focal, 48.0, 36.0, 96, 72)


def surface(camera: PinholeCamera, water: FlatWater | None = WATER) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (height, width, 3) [m] that the pixels show, normals, and path lengths (height, width) [m] to them."""
    paths = camera.paths(camera.pixel_centres(), water)
    if water is None:
        start, d, before = np.broadcast_to(camera.centre, paths.air_direction.shape), paths.air_direction, 0.0
    else:
        start, d, before = paths.crossing, paths.water_direction, paths.air_length
    best = (BED - start[..., 2]) / d[..., 2]
    normal = np.broadcast_to([0.0, 0.0, 1.0], d.shape).copy()
    with np.errstate(divide="ignore"):
        a, b = (BLOCK[0] - start) / d, (BLOCK[1] - start) / d
    enters, leaves = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
    block = (enters < leaves) & (enters < best)
    axis = np.minimum(a, b).argmax(axis=-1)
    best = np.where(block, enters, best)
    normal[block] = -np.sign(d[block]) * np.eye(3)[axis[block]]
    # z = BED + slope (x - x0) along the path.
    rise = RAMP_SLOPE * (start[..., 0] - RAMP_X[0]) + BED - start[..., 2]
    t = rise / (d[..., 2] - RAMP_SLOPE * d[..., 0])
    x, y = (start[..., k] + t * d[..., k] for k in (0, 1))
    ramp = (x > RAMP_X[0]) & (x < RAMP_X[1]) & (y > RAMP_Y[0]) & (y < RAMP_Y[1]) & (t < best)
    best = np.where(ramp, t, best)
    normal[ramp] = np.array([-RAMP_SLOPE, 0.0, 1.0]) / np.hypot(1.0, RAMP_SLOPE)
    return start + best[..., None] * d, normal, before + best


def colour(points: np.ndarray) -> np.ndarray:
    """Linear radiance (..., 3), 0.05 to 0.9, of points (..., 3) [m]."""
    waves = np.random.default_rng(7)
    texture = np.zeros(points.shape)
    for _ in range(24):
        way = waves.normal(size=3)
        number = 2.0 * np.pi / np.exp(waves.uniform(np.log(0.25), np.log(2.0)))
        along = number * (points @ (way / np.linalg.norm(way)))
        texture += np.sin(along[..., None] + waves.uniform(0.0, 2.0 * np.pi, 3)) * waves.normal(0.6, 0.1, 3)
    seen = np.array([0.32, 0.36, 0.3]) + 0.055 * texture
    disc = np.linalg.norm(points[..., :2] - SMOOTH_CENTRE, axis=-1) < SMOOTH_RADIUS
    top = np.abs(points[..., 2] - BLOCK[1][2]) < 1e-6
    seen = np.where(disc[..., None], np.array([0.5, 0.44, 0.34]) + 0.001 * texture, seen)
    seen = np.where(top[..., None], np.array([0.12, 0.16, 0.2]) + 0.001 * texture, seen)
    return np.clip(seen, 0.05, 0.9)


def rough_priors(
    camera: PinholeCamera, normals: np.ndarray, length: np.ndarray, rng: np.random.Generator
) -> PriorImages:
    """What a network might say.

    Depths of an unknown scale and shift, half a percent off in swells; normals 5 degrees off.
    """
    ahead = camera.directions(camera.pixel_centres()) @ camera.cam_from_local[2]
    rows, columns = np.mgrid[: camera.height, : camera.width]
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    swell = 1.0 + 0.005 * np.sin(columns / 12.0 + phase[0]) * np.sin(rows / 12.0 + phase[1])
    depth = rng.uniform(0.1, 0.3) * length * ahead * swell + rng.uniform(-1.0, 1.0)
    bent = normals + np.radians(5.0) * rng.normal(size=normals.shape) / np.sqrt(2.0)
    bent /= np.linalg.norm(bent, axis=-1, keepdims=True)
    return PriorImages(depth, normal=bent)


class Backdrop(torch.nn.Module):
    """Constant colour behind the box: three numbers, 0 to 1, as a photograph stores it."""

    def __init__(self, stored: tuple[float, float, float]):
        super().__init__()
        self.register_buffer("linear", torch.tensor(stored) ** GAMMA)

    def forward(self, paths: Paths, _appearance: torch.Tensor | None) -> torch.Tensor:
        return self.linear.expand(len(paths), 3)
