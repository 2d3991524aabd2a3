"""Gauss-Newton steps for the heights of one tile, with a Cauchy prior on second differences.

The prior keeps beds smooth, with steps and edges.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy import ndimage, sparse

from fields.image_store import GreyImages
from fields.solver.tile import Appearance, Brightness, SolverTile, appearance_of, brightness_of, log_likelihood_ratio
from fields.solver.visibility import Ground, TileProjection
from fields.sweep.images import slope_of

ITERATIONS = 3
APPEARANCE_ITERATIONS = 2  # Gain and offset are estimated in the first steps
# Conjugate gradients: most steps, and the residual relative to the first at which they end, in the last Gauss-Newton
# step and in those before it, which the next one corrects.
CG_STEPS, CG_RESIDUAL, CG_RESIDUAL_BEFORE = 300, 3e-3, 3e-2
LEAST_INFORMATION = np.float32(1e-2)  # Weight of the start where neither images nor neighbours say anything [1/m^2]
_LARGE_STEP = 2.0  # Steps beyond so many times their median lead from one feature of the texture to another
# Derivative of fourth order: exact for the wavelengths that a cubic lookup keeps.
_DERIVATIVE = np.array([[1.0, -8.0, 0.0, 8.0, -1.0]], dtype=np.float32) / 12.0


# Pixels of a second difference, as steps of rows and columns from the first of them, and their factors.
_CROSS = np.sqrt(2.0)
_STENCILS = (
    (((0, 0), (0, 1), (0, 2)), (1.0, -2.0, 1.0)),
    (((0, 0), (1, 0), (2, 0)), (1.0, -2.0, 1.0)),
    (((0, 0), (0, 1), (1, 0), (1, 1)), (_CROSS, -_CROSS, -_CROSS, _CROSS)),
)


@dataclass(frozen=True)
class SecondDifferences:
    """Second differences of the heights of a tile, M of N heights: along rows, columns and across both.

    They are zero on a plane, however steep.
    """

    matrix: sparse.csr_matrix  # (M, N) sparse: of heights
    transposed: sparse.csr_matrix  # (N, M) sparse
    inside: np.ndarray  # (rows, columns) bool: the N pixels in the window of the tile
    # Of those along rows, columns and across: the first pixel, by its number in the window
    first: tuple[np.ndarray, ...]

    @cached_property
    def _touching(self) -> sparse.csr_matrix:
        """Averaging operator (N, M) over the second differences that each height takes part in."""
        touching = self.transposed.copy()
        counts = np.diff(touching.indptr)
        touching.data = np.repeat(1.0 / np.maximum(counts, 1), counts).astype(np.float32)
        return touching

    def mean_at_heights(self, values: np.ndarray) -> np.ndarray:
        """Mean (N,) of values (M,) over the second differences of each height; 0 where there are none."""
        return self._touching @ values

    def gradient(self, stiffness: np.ndarray, heights: np.ndarray) -> np.ndarray:
        """Gradient (N,) of half the sum of stiffness (M,) times squared second differences."""
        return self.transposed @ (stiffness * (self.matrix @ heights))

    def solve(self, information: np.ndarray, stiffness: np.ndarray, right: np.ndarray, tolerance: float) -> np.ndarray:
        """Heights (N,) of the normal equations of information (N,) and stiffness (M,), for a right side (N,)."""
        window = np.zeros((2, self.inside.size), dtype=np.float32)
        window[:, self.inside.ravel()] = information + LEAST_INFORMATION, right
        diagonal, of_window = window
        matrix = self.normal_matrix(diagonal, stiffness)
        # Pixels of the window that are none of the tile: alone, with nothing on the right.
        diagonal = np.where(self.inside.ravel(), matrix.diagonal(), np.float32(1.0))
        return conjugate_gradients(matrix, of_window, diagonal, tolerance)[self.inside.ravel()]

    def normal_matrix(self, information: np.ndarray, stiffness: np.ndarray) -> sparse.dia_array:
        """Normal matrix (P, P) of information (P,) and stiffness (M,), over the P pixels of the window.

        By its 13 diagonals: products with them take a quarter of the time of those with `matrix` and `transposed`.
        """
        size, columns = information.size, self.inside.shape[1]
        diagonals = {0: information.astype(np.float32)}
        ends = np.cumsum([len(first) for first in self.first])[:-1]
        for first, values, (steps, factors) in zip(self.first, np.split(stiffness, ends), _STENCILS, strict=True):
            at_first = np.zeros(size, dtype=np.float32)
            at_first[first] = values
            places = [row * columns + column for row, column in steps]
            for number, place in enumerate(places):
                for other, factor in zip(places[: number + 1], factors, strict=False):
                    diagonal = diagonals.setdefault(place - other, np.zeros(size, dtype=np.float32))
                    diagonal += np.float32(factor * factors[number]) * np.roll(at_first, place)
        # Those below mirror those above it; a column has its place in all of them, and only zeros are rolled around.
        below = {-step: np.roll(each, -step) for step, each in diagonals.items() if step}
        every = diagonals | below
        return sparse.dia_array((np.stack(list(every.values())), list(every)), shape=(size, size))


def second_differences_of(tile: SolverTile) -> SecondDifferences:
    """Second-difference operator of the pixels of a tile."""
    inside, parts, first = tile.inside, [], []
    rows, columns = inside.shape
    number = np.cumsum(inside).reshape(inside.shape) - 1
    for steps, factors in _STENCILS:
        high, wide = (max(step) for step in zip(*steps, strict=True))
        windows = [np.s_[row : rows - high + row, column : columns - wide + column] for row, column in steps]
        at = np.nonzero(np.logical_and.reduce([inside[window] for window in windows]))
        chosen = np.stack([number[window][at] for window in windows], axis=-1)
        count, size = chosen.shape
        values = np.tile(factors, count).astype(np.float32)
        parts.append(sparse.csr_matrix((values, chosen.ravel(), np.arange(count + 1) * size), shape=(count, len(tile))))
        first.append(at[0] * columns + at[1])
    matrix = sparse.vstack(parts).tocsr()
    return SecondDifferences(matrix, matrix.T.tocsr(), inside, (first[0], first[1], first[2]))


def stiffness_of(differences: np.ndarray, roughness: float) -> np.ndarray:
    """Weights (M,) [1/m^2] of squared second differences (M,) [m] of a Cauchy prior of scale ``roughness`` [m].

    Its heavy tails keep steps and edges: a second difference much above the roughness costs hardly more when it grows.
    """
    return (1.0 / (roughness**2 + differences * differences)).astype(np.float32)


@dataclass(frozen=True)
class Start:
    """Heights of the sweep at the pixels of a tile; N of them."""

    height: np.ndarray  # (N,) float32 [m]
    height_slope: np.ndarray  # (N,) [m/px]: of the heights in their map

    @staticmethod
    def of(tile: SolverTile, heights: np.ndarray) -> Start:
        """Start from a map (height, width) [m]."""
        window = np.ascontiguousarray(tile.window(heights), dtype=np.float32)
        return Start(window[tile.inside], slope_of(window)[tile.inside])


@dataclass(frozen=True)
class TileSolution:
    """Heights of the N pixels of a tile, and the normal equations that they solve."""

    height: np.ndarray  # (N,) float32 [m] over the water plane
    # (N,) [1/m^2]: of the images, for each height alone: the diagonal that the images add to the normal matrix
    information: np.ndarray
    stiffness: np.ndarray  # (M,) [1/m^2]: of the second differences
    differences: SecondDifferences
    brightness: Brightness
    residual_by_height: np.ndarray  # (K, N) [grey/m]: derivative of each residual by the height
    motion: np.ndarray  # (K, 2, N) [px/m]: as `TileProjection` has it
    # Gradient response: change of the gradient by a step, relative to that expected from ``information``. Less than one
    # where robust weights drop it, more where the albedo is sharper than its gradients. NaN of no change.
    response: float
    start: Start
    improvement: np.ndarray  # (N,): Log-likelihood ratio of the photographs at the solved height and at the start
    ground: Ground  # As `TileProjection` has it
    views: tuple[int, ...] = ()  # (K,) of int: the photographs, by their number

    def with_roughness(self, roughness: float) -> TileSolution:
        """The solution with the stiffness of a roughness [m]."""
        return replace(self, stiffness=stiffness_of(self.differences.matrix @ self.height, roughness))


def solve(
    tile: SolverTile,
    projected: TileProjection,
    images: GreyImages | Mapping[int, np.ndarray],
    start: Start,
    roughness: float,
    tolerance: float,
) -> TileSolution:
    """Heights of a tile by least squares over all photographs that see it.

    ``images`` (height, width) float32, by view: grey levels; NaN where masked. ``roughness`` [m]: scale of the second
    differences of the bed. ``tolerance`` [m]: the largest change in one step.
    """
    differences, height = second_differences_of(tile), start.height
    appearance: Appearance | None = None
    seen: list[Brightness] = []
    response, before = np.nan, None
    for iteration in range(ITERATIONS):
        grey = projected.sample(images, height - start.height)
        if appearance is None or iteration < APPEARANCE_ITERATIONS:
            appearance = appearance_of(tile, grey)
        brightness = brightness_of(appearance.albedo(grey))
        seen.append(brightness)
        window = tile.window_of_view(images, projected.views[0])
        # Gradients of single photographs are noisy, and their noise would count as texture: those of the albedo.
        across, down = _gradients(tile, window.astype(np.float32), brightness.albedo)
        by_height = projected.motion[:, 0] * across + projected.motion[:, 1] * down
        by_height = brightness.minus_albedo(np.where(np.isfinite(by_height), by_height, np.float32(0.0)))
        information = np.einsum("kn,kn,kn->n", brightness.weight, by_height, by_height)
        gradient = np.einsum("kn,kn,kn->n", brightness.weight, by_height, brightness.residual)
        if before is not None:
            response = gradient_response(*before, gradient)
        stiffness = stiffness_of(differences.matrix @ height, roughness)
        right = -gradient - differences.gradient(stiffness, height)
        residual = CG_RESIDUAL if iteration + 1 == ITERATIONS else CG_RESIDUAL_BEFORE
        step = differences.solve(information, stiffness, right, residual)
        step = np.clip(step, -tolerance, tolerance).astype(np.float32)
        height, before = height + step, (information, gradient, step)
    improvement = log_likelihood_ratio(seen[0], brightness)
    return TileSolution(
        height, information, stiffness, differences, brightness, by_height, projected.motion, response, start,
        improvement, projected.ground, tuple(projected.views),
    )  # fmt: skip


def gradient_response(
    information: np.ndarray, gradient: np.ndarray, step: np.ndarray, gradient_after: np.ndarray
) -> float:
    """Change of the gradient (N,) by a step (N,) [m], relative to that expected from the information (N,)."""
    size = np.abs(step)
    known = (information > 0.0) & (size < _LARGE_STEP * np.median(size))
    expected = float((information * step * step)[known].sum())
    return float((step * (gradient_after - gradient))[known].sum()) / expected if expected > 0.0 else np.nan


def gradients_of(tile: SolverTile, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradients along columns and rows (N,) each [grey/px] of an albedo (N,), extended by its border values."""
    nearest = ndimage.distance_transform_edt(~tile.inside, return_distances=False, return_indices=True)
    return _gradients(tile, tile.image(albedo)[tuple(nearest)], albedo)


def _gradients(tile: SolverTile, image: np.ndarray, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradients of an image of the window, in which the tile has an albedo (N,)."""
    image[tile.inside] = albedo
    across, down = (
        cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE)[tile.inside]
        for kernel in (_DERIVATIVE, _DERIVATIVE.T)
    )
    return across, down


def shift_information(weight: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Information of a height against random shifts of the photographs, (N,) [px^2/m^2].

    Random shifts of the photographs with a standard deviation of one pixel along each axis give the height one of one
    over the root of the information. ``weight`` (K, N) is 0 where not seen, ``motion`` (K, 2, N) [px/m] as
    `TileProjection` has it.
    """
    seen = (weight > 0.0)[:, None]
    count = np.maximum(seen.sum(axis=0), 1)
    visible_motion = np.where(seen, motion, np.float32(0.0))
    about = np.where(seen, motion - visible_motion.sum(axis=0) / count, np.float32(0.0))
    return np.maximum(np.einsum("kan,kan->n", about, about), 1e-6)


def conjugate_gradients(
    matrix: sparse.dia_array, right: np.ndarray, diagonal: np.ndarray, tolerance: float
) -> np.ndarray:
    """Solution x (N,) of A x = b by preconditioned conjugate gradients (Nocedal and Wright 2006, algorithm 5.3).

    ``matrix``: A. ``right`` (N,): b. ``diagonal`` (N,): of A: the Jacobi preconditioner. ``tolerance``: norm of the
    preconditioned residual, relative to the start, at which it ends.
    """
    x, residual = np.zeros_like(right), right.copy()
    preconditioned = residual / diagonal
    direction, square = preconditioned.copy(), _product(residual, preconditioned)
    enough = tolerance**2 * square
    for _ in range(CG_STEPS):
        if square <= enough:
            break
        a_p = matrix @ direction
        step = square / _product(direction, a_p)
        x += step * direction
        a_p *= step
        residual -= a_p
        np.divide(residual, diagonal, out=preconditioned)
        before, square = square, _product(residual, preconditioned)
        direction *= square / before
        direction += preconditioned
    return x


def _product(one: np.ndarray, other: np.ndarray) -> float:
    """Inner product on this thread: a BLAS would start threads inside those that solve tiles."""
    return float(np.einsum("n,n->", one, other))
