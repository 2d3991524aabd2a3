"""Gauss-Newton over the heights of one tile."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from fields.image_store import GreyImages
from fields.solver.appearance import Appearance, Brightness, appearance_of, brightness_of, gain_of
from fields.solver.sight import Sight
from fields.solver.smoothness import Bends, bends_of, stiffness_of
from fields.solver.tile import Tile
from fields.sweep.slopes import slope_of

ITERATIONS = 3
# Gain and offset are estimated in the first steps.
APPEARANCE_ITERATIONS = 2
# Of conjugate gradients, with the residual relative to the start; in a step that another follows, which mends it.
CG_STEPS, CG_RESIDUAL, CG_RESIDUAL_BEFORE = 300, 3e-3, 3e-2
# Weight of the start where neither images nor neighbours say anything [1/m^2].
FAINT = np.float32(1e-2)
# Steps beyond so many times their median lead from one feature of the texture to another.
_LARGE_STEP = 2.0
# Derivative of fourth order: exact for the wavelengths that a cubic lookup keeps.
_DERIVATIVE = np.array([[1.0, -8.0, 0.0, 8.0, -1.0]], dtype=np.float32) / 12.0


@dataclass(frozen=True)
class Start:
    """Heights of the sweep (N,) float32 [m] at the pixels of a tile, and their rise (N,) [m/px] in its map."""

    height: np.ndarray
    slope: np.ndarray

    @staticmethod
    def of(tile: Tile, heights: np.ndarray) -> Start:
        """Of a map (height, width) [m]."""
        window = np.ascontiguousarray(tile.window(heights), dtype=np.float32)
        return Start(window[tile.inside], slope_of(window)[tile.inside])


@dataclass(frozen=True)
class Solved:
    """Heights of the N pixels of a tile, and the normal equations that they solve.

    Attributes
    ----------
    height : (N,) float32 [m] over the water plane
    information : (N,) [1/m^2]
        Of the images, for each height alone: the diagonal that the images add to the normal matrix.
    stiffness : (M,) [1/m^2]
        Of the bends.
    bends : Bends
    brightness : Brightness
    slope : (K, N) [grey/m]
        Change of each residual with the height.
    motion : (K, 2, N) [px/m]
        As `Sight` has it.
    response : float
        How much of ``information`` the residuals answered to a change of the heights with: less than one where robust
        weights drop what a change adds, more where the albedo is sharper than its gradients. NaN of no change.
    start : Start
    gain : (N,)
        How much better than at the start the photographs agree: logarithm of the ratio of likelihoods.
    views : (K,) of int
        The photographs, by their number.
    """

    height: np.ndarray
    information: np.ndarray
    stiffness: np.ndarray
    bends: Bends
    brightness: Brightness
    slope: np.ndarray
    motion: np.ndarray
    response: float
    start: Start
    gain: np.ndarray
    views: tuple[int, ...] = ()


def solve(
    tile: Tile,
    sight: Sight,
    images: GreyImages | Mapping[int, np.ndarray],
    start: Start,
    roughness: float,
    tolerance: float,
) -> Solved:
    """Heights of a tile by least squares over all photographs that see it.

    Parameters
    ----------
    tile : Tile
    sight : Sight
    images : (height, width) float32, by view
        Grey levels; NaN where masked.
    start : Start
    roughness : [m]
        Typical bend of the bed from pixel to pixel.
    tolerance : [m]
        The largest change in one step.
    """
    bends, height = bends_of(tile), start.height
    appearance: Appearance | None = None
    seen: list[Brightness] = []
    response, before = np.nan, None
    for iteration in range(ITERATIONS):
        grey = sight.sample(images, height - start.height)
        if appearance is None or iteration < APPEARANCE_ITERATIONS:
            appearance = appearance_of(tile, grey)
        brightness = brightness_of(appearance.albedo(grey))
        seen.append(brightness)
        slope = _slopes(tile, sight, tile.window_of(images, sight.views[0]), brightness)
        information = np.einsum("kn,kn,kn->n", brightness.weight, slope, slope)
        pull = np.einsum("kn,kn,kn->n", brightness.weight, slope, brightness.residual)
        if before is not None:
            response = response_to(*before, pull)
        stiffness = stiffness_of(bends.of_heights @ height, roughness)
        step = conjugate_gradients(
            normal_matrix(information, bends, stiffness),
            -pull - bends.pull(stiffness, height),
            information + bends.squared @ stiffness + FAINT,
            CG_RESIDUAL if iteration + 1 == ITERATIONS else CG_RESIDUAL_BEFORE,
        )
        step = np.clip(step, -tolerance, tolerance).astype(np.float32)
        height, before = height + step, (information, pull, step)
    gain = gain_of(seen[0], brightness)
    return Solved(
        height, information, stiffness, bends, brightness, slope, sight.motion, response, start, gain,
        tuple(sight.views),
    )  # fmt: skip


def response_to(information: np.ndarray, pull: np.ndarray, step: np.ndarray, pull_then: np.ndarray) -> float:
    """What a step (N,) [m] changed of the pull (N,), in units of what the information (N,) lets expect."""
    size = np.abs(step)
    known = (information > 0.0) & (size < _LARGE_STEP * np.median(size))
    expected = float((information * step * step)[known].sum())
    return float((step * (pull_then - pull))[known].sum()) / expected if expected > 0.0 else np.nan


def _slopes(tile: Tile, sight: Sight, image: np.ndarray, brightness: Brightness) -> np.ndarray:
    """How the residuals change with the height, (K, N) [grey/m]; ``image`` is the window of the tile's photograph.

    Gradients are those of the albedo, the mean of all photographs: those of single photographs are noisy, and their
    noise would count as texture.
    """
    across, down = _gradients(tile, image.astype(np.float32), brightness.albedo)
    slope = sight.motion[:, 0] * across + sight.motion[:, 1] * down
    return brightness.less_mean(np.where(np.isfinite(slope), slope, np.float32(0.0)))


def gradients_of(tile: Tile, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradients across and down (N,) each [grey/px] of an albedo (N,); beyond the tile it goes on as at its rim."""
    nearest = ndimage.distance_transform_edt(~tile.inside, return_distances=False, return_indices=True)
    image = np.zeros(tile.inside.shape, dtype=np.float32)
    image[tile.inside] = albedo
    return _gradients(tile, image[tuple(nearest)], albedo)


def _gradients(tile: Tile, image: np.ndarray, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of an image of the window, in which the tile has an albedo (N,)."""
    image[tile.inside] = albedo
    across, down = (tile_filter(image, kernel)[tile.inside] for kernel in (_DERIVATIVE, _DERIVATIVE.T))
    return across, down


def parallax_of(weight: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """How firmly photographs hold a height by where they show it, (N,) [px^2/m^2].

    Random shifts of the photographs with a standard deviation of one pixel along each axis give the height one of one
    over its root. ``weight`` (K, N) is 0 where not seen, ``motion`` (K, 2, N) [px/m] as `Sight` has it.
    """
    seen = (weight > 0.0)[:, None]
    count = np.maximum(seen.sum(axis=0), 1)
    there = np.where(seen, motion, np.float32(0.0))
    about = np.where(seen, motion - there.sum(axis=0) / count, np.float32(0.0))
    return np.maximum(np.einsum("kan,kan->n", about, about), 1e-6)


def tile_filter(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """An image correlated with a kernel; the rim repeats."""
    return cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE)


def normal_matrix(information: np.ndarray, bends: Bends, stiffness: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """The normal matrix as a function of heights (N,)."""
    diagonal = information + FAINT
    return lambda heights: diagonal * heights + bends.pull(stiffness, heights)


def conjugate_gradients(
    matrix: Callable[[np.ndarray], np.ndarray], right: np.ndarray, diagonal: np.ndarray, residual: float = CG_RESIDUAL
) -> np.ndarray:
    """Solution (N,) of ``matrix(x) = right``, with ``diagonal`` (N,) as preconditioner."""
    solution, rest = np.zeros_like(right), right.copy()
    towards = rest / diagonal
    way, size = towards.copy(), _product(rest, towards)
    enough = residual**2 * size
    for _ in range(CG_STEPS):
        if size <= enough:
            break
        along = matrix(way)
        length = size / _product(way, along)
        solution += length * way
        along *= length
        rest -= along
        np.divide(rest, diagonal, out=towards)
        before, size = size, _product(rest, towards)
        way *= size / before
        way += towards
    return solution


def _product(one: np.ndarray, other: np.ndarray) -> float:
    """Inner product, on this thread alone: a BLAS would share it out among threads that tiles are solved on."""
    return float(np.einsum("n,n->", one, other))
