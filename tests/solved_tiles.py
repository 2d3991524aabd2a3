"""Tiles of the solver whose information, stiffness and noise are known."""

import numpy as np
from scipy import ndimage

from fields.solver.gauss_newton import Start, TileSolution, gradients_of, second_differences_of, stiffness_of
from fields.solver.tile import SolverTile, brightness_of
from fields.solver.visibility import Ground


def plain_tile(size: int) -> SolverTile:
    """A square tile, all of which is asked for."""
    return SolverTile(0, 0, np.ones((size, size), dtype=bool), np.ones(size * size, dtype=bool))


def nowhere(tile: SolverTile) -> Ground:
    """Ground of which nothing is known."""
    return Ground(np.zeros((3, len(tile)), np.float32), np.zeros((2, 2, len(tile)), np.float32))


def level(information: float, roughness: float, size: int = 40) -> tuple[SolverTile, TileSolution]:
    """A tile with the same information everywhere and level heights."""
    tile = plain_tile(size)
    differences, zero = second_differences_of(tile), np.zeros(len(tile), dtype=np.float32)
    stiffness = stiffness_of(differences.matrix @ zero, roughness)
    brightness = brightness_of(np.zeros((2, len(tile)), dtype=np.float32))
    slope, motion = np.zeros((2, len(tile))), np.zeros((2, 2, len(tile)))
    everywhere = zero + np.float32(information)
    start = Start(zero, zero)
    return tile, TileSolution(
        zero, everywhere, stiffness, differences, brightness, slope, motion, 1.0, start, zero, nowhere(tile)
    )


def residuals(
    noise: np.ndarray, depth: float = 2.0, shift_px: float = 0.0, relief: np.ndarray | None = None
) -> tuple[SolverTile, TileSolution]:
    """A textured tile whose photographs have this noise (K, 96, 96) and are shifted in waves, each in its own way.

    Its heights are level, whatever relief (96, 96) [m] the photographs show.
    """
    random, tile, views = np.random.default_rng(8), plain_tile(96), len(noise)
    albedo = 40.0 * ndimage.gaussian_filter(random.standard_normal((96, 96)), 1.5).ravel().astype(np.float32)
    gradients = gradients_of(tile, 10.0 * albedo)
    phase = random.uniform(0.0, 2.0 * np.pi, (views, 2, 1)) + 0.08 * tile.places[0]
    shift = np.sqrt(2.0) * shift_px * np.sin(phase)
    grey = 10.0 * albedo + noise.reshape(views, -1) + shift[:, 0] * gradients[0] + shift[:, 1] * gradients[1]
    motion = 10.0 * random.standard_normal((views, 2, 1)).astype(np.float32) * np.ones((1, 1, len(tile)), np.float32)
    if relief is not None:
        grey = grey - np.einsum("kan,an->kn", motion, np.array(gradients)) * relief.ravel()
    brightness = brightness_of(grey.astype(np.float32))
    slope = brightness.minus_albedo(np.einsum("kan,an->kn", motion, np.array(gradients)).astype(np.float32))
    information = np.einsum("kn,kn,kn->n", brightness.weight, slope, slope)
    zero, differences = np.zeros(len(tile), dtype=np.float32), second_differences_of(tile)
    stiffness = stiffness_of(differences.matrix @ zero, 0.01)
    height, start = zero - np.float32(depth), Start(zero, zero)
    return tile, TileSolution(
        height, information, stiffness, differences, brightness, slope, motion, 1.0, start, zero, nowhere(tile)
    )


def white(views: int, seed: int = 1) -> np.ndarray:
    """Noise (views, 96, 96) of three grey levels that is each pixel's own."""
    return 3.0 * np.random.default_rng(seed).standard_normal((views, 96, 96))
