"""Two photographs of a sloping bed under water whose ripples move between the exposures, drawn exactly."""

from dataclasses import dataclass

import numpy as np
from plane_survey import look, waves

from fields.device import choose_device
from fields.sweep.block import Block
from refract import FlatWater

WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.335)
SIZE, GSD_M, CONTRAST, NOISE = (480, 400), 0.06, 25.0, 1.5
# Wavelengths [m] of the bed's texture and of the ripples.
BED_M, RIPPLES_M = (0.5, 6.0), (0.15, 0.4)


@dataclass(frozen=True)
class RippledPair:
    """A block of both photographs, and the true heights (height, width) [m] that each shows."""

    block: Block
    truth: list[np.ndarray]
    depth: float


def rippled_pair(seed: int) -> RippledPair:
    """Depth, slope, base, contrast and motion of the ripples are drawn by the seed."""
    rng = np.random.default_rng(seed)
    depth, slope, share = rng.uniform(1.5, 5.0), rng.uniform(-0.05, 0.05, 2), rng.uniform(0.5, 1.5)
    way, angle, flying = rng.uniform(0.1, 0.5), rng.uniform(0.0, 2.0 * np.pi), rng.uniform(40.0, 60.0)
    half = 0.5 * flying * rng.uniform(0.12, 0.25)
    of_bed, of_ripples = (int(each) for each in rng.integers(1 << 30, size=2))
    cameras, images, truth = [], [], []
    for moved, y in ((0.0, -half), (way, half)):
        camera = look((0.0, y, flying), (0.0, y + 0.01, -depth), focal=flying / GSD_M, size=SIZE)
        path = camera.paths(camera.pixel_centres(), WATER)
        height = np.full((SIZE[1], SIZE[0]), -depth)
        for _ in range(20):
            at = path.at_height(height, WATER)
            height = height - 0.8 * (at[..., 2] + depth - at[..., :2] @ slope)
        at, top = path.at_height(height, WATER), path.at_height(np.zeros_like(height), WATER)
        top = top[..., :2] - moved * np.array([np.cos(angle), np.sin(angle)])
        grey = waves(of_bed, at[..., :2], BED_M) + share * waves(of_ripples, top, RIPPLES_M)
        grey = CONTRAST * grey + rng.normal(0.0, NOISE, grey.shape)
        cameras.append(camera)
        images.append(np.rint(grey).astype(np.float32))
        truth.append(height)
    return RippledPair(Block(choose_device("cpu"), cameras, images, WATER, -depth), truth, depth)
