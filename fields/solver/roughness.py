"""How rough the bed is, learned by cross-validation: half of the photographs predict the other half."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from fields.solver.smoothness import stiffness_of
from fields.solver.solve import CG_RESIDUAL, CG_RESIDUAL_BEFORE, FAINT, Solved, conjugate_gradients, normal_matrix
from fields.solver.tile import Tile

# The search starts at this share of the ground sampling distance and goes in steps of this factor, this far at most.
START_GSD, FACTOR, MOST_STEPS = 0.5, np.sqrt(2.0), 6
# Times that the stiffness follows the bends.
_ROUNDS = 3
# Errors within one such block are correlated.
_BLOCK_PX = 16
# Share of the blocks left out at either end: steps and edges would decide for all of the bed.
TRIM = 0.1


@dataclass(frozen=True)
class Half:
    """What half of the photographs say about the heights of a tile, about those that all of them gave.

    The sum of their squared residuals, for changes d (N,) [m], is ``sum(information * d * d + 2 * pull * d)`` more.
    """

    information: np.ndarray
    pull: np.ndarray

    def cost(self, change: np.ndarray) -> np.ndarray:
        """Increase (N,) of the squared residuals, in units of their variance."""
        return self.information * change * change + 2.0 * self.pull * change


def halves_of(solved: Solved) -> tuple[Half, Half]:
    """Every other photograph, and the rest; the albedo is that of each half alone."""
    found = []
    for first in (0, 1):
        weight = solved.brightness.weight[first::2]
        total = np.maximum(weight.sum(axis=0), 1e-12)
        residual, slope = (
            np.where(weight > 0.0, part - np.einsum("kn,kn->n", weight, part) / total, np.float32(0.0))
            for part in (solved.brightness.residual[first::2], solved.slope[first::2])
        )
        information = np.einsum("kn,kn,kn->n", weight, slope, slope)
        pull = np.einsum("kn,kn,kn->n", weight, slope, residual)
        found.append(Half(information, pull))
    return found[0], found[1]


def heights_of(solved: Solved, half: Half, roughness: float) -> np.ndarray:
    """Heights (N,) [m] from half of the photographs, linear about those of all."""
    height = solved.height
    for number in range(_ROUNDS):
        stiffness = stiffness_of(solved.bends.of_heights @ height, roughness)
        right = -half.pull - half.information * (height - solved.height) - solved.bends.pull(stiffness, height)
        diagonal = half.information + solved.bends.squared @ stiffness + FAINT
        matrix = normal_matrix(half.information, solved.bends, stiffness)
        residual = CG_RESIDUAL if number + 1 == _ROUNDS else CG_RESIDUAL_BEFORE
        height = height + conjugate_gradients(matrix, right, diagonal, residual)
    return height


def roughness_of(samples: list[tuple[Tile, Solved]], gsd: float, pool: Executor) -> float:
    """The scale [m] of the bed's bends with which each half of the photographs predicts the other best.

    Of those that are worse by less than one standard error the smoothest is taken, as is usual in cross-validation.
    Where that is the best itself, it is the least of a parabola through the best and its neighbours, so that the scale
    does not jump by a step where two of them are as good.

    Parameters
    ----------
    samples : tiles that were solved with `START_GSD` times the ground sampling distance
    gsd : [m]
        Ground sampling distance.
    pool : Executor
        Solves the samples side by side.
    """
    split = [(tile, solved, halves_of(solved)) for tile, solved in samples]
    known: dict[int, np.ndarray] = {}

    def cost(step: int) -> np.ndarray:
        if step not in known:
            roughness = START_GSD * gsd * FACTOR**step
            known[step] = np.concatenate(
                list(pool.map(lambda each: _costs(each[0], each[1], each[2], roughness), split))
            )
        return known[step]

    best = 0
    for way in (1, -1):
        while abs(best + way) <= MOST_STEPS and _trimmed_mean(cost(best + way) - cost(best)) < 0.0:
            best += way
    found = best
    while best > -MOST_STEPS:
        difference = cost(best - 1) - cost(found)
        if _trimmed_mean(difference) > _error(difference):
            break
        best -= 1
    between = 0.0
    if best == found and abs(found) < MOST_STEPS:
        between = _vertex(*(_trimmed_mean(cost(found + way) - cost(found)) for way in (-1, 1)))
    return float(START_GSD * gsd * FACTOR ** (best + between))


def _vertex(below: float, above: float) -> float:
    """Where, in steps from the best, a parabola is least that is zero there and so high a step below and above it."""
    return 0.5 * (below - above) / (below + above) if below + above > 0.0 else 0.0


def _trimmed_mean(values: np.ndarray) -> float:
    """Mean of values without the largest and the smallest; scipy.stats has it, and takes half a second to import."""
    out = int(TRIM * len(values))
    return float(np.sort(values)[out : len(values) - out].mean())


def _error(values: np.ndarray) -> float:
    """Standard error of the trimmed mean of values."""
    inner = np.clip(values, *np.quantile(values, (TRIM, 1.0 - TRIM)))
    return float(inner.std() / ((1.0 - 2.0 * TRIM) * np.sqrt(len(values))))


def _costs(tile: Tile, solved: Solved, halves: tuple[Half, Half], roughness: float) -> np.ndarray:
    """How badly each half predicts the other, summed over blocks of pixels."""
    total = sum(
        other.cost(heights_of(solved, half, roughness) - solved.height) for half, other in (halves, halves[::-1])
    )
    rows, columns = (index // _BLOCK_PX for index in tile.places)
    block, number = np.unique(rows * 1000 + columns, return_inverse=True)
    return np.bincount(number, np.where(tile.asked, total, 0.0), len(block))
