"""Photo-consistency of a surface: the photographs that agree on its colours, and so see it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

# Cells about one whose colours are compared together: a window of 3.
WINDOW = 3
# Mean square of the difference of two photographs, in variances of the noise, up to which they agree; beyond it their
# agreement is zero. One cell counts at most so much.
AGREE, _MOST = 1.2, 30.0


@dataclass(frozen=True)
class Colours:
    """Colours of K photographs on the cells (rows, columns) of a surface."""

    # (K, rows, columns, 3) float32: stored values 0 to 255, corrected for gain and offset of each photograph
    values: np.ndarray
    use: np.ndarray  # (K, rows, columns) bool: where the photograph may show the surface
    noise: np.ndarray  # (3,): standard deviation of one photograph


@dataclass(frozen=True)
class Consensus:
    """The photographs that agree on each cell, and how much: weight (rows, columns), members (K, rows, columns)."""

    weight: np.ndarray
    members: np.ndarray

    @property
    def count(self) -> np.ndarray:
        """Number of photographs that agree (rows, columns)."""
        return self.members.sum(axis=0)


def consensus(colours: Colours) -> Consensus:
    """The largest set of photographs that agree with one of them, for each cell."""
    num, shape = len(colours.values), colours.use.shape[1:]
    weight = np.zeros((num, *shape), dtype=np.float32)
    agree = np.zeros((num, num, *shape), dtype=bool)
    scaled = colours.values / (np.sqrt(6.0) * colours.noise).astype(np.float32)
    for a, b in combinations(range(num), 2):
        both = colours.use[a] & colours.use[b]
        if not both.any():
            continue
        difference = scaled[a] - scaled[b]
        square = np.einsum("ijc,ijc->ij", difference, difference)
        misfit = windowed(np.minimum(square, _MOST), both)
        kernel = np.where(both, np.exp(-0.5 * (misfit / AGREE) ** 2), np.float32(0.0))
        weight[a] += kernel
        weight[b] += kernel
        agree[a, b] = agree[b, a] = both & (misfit < AGREE)
    best = weight.argmax(axis=0)
    members = np.take_along_axis(agree, best[None, None], axis=0)[0]
    np.put_along_axis(members, best[None], True, axis=0)
    return Consensus(weight.max(axis=0), members & colours.use)


def windowed(values: np.ndarray, mask: np.ndarray, side: int = WINDOW) -> np.ndarray:
    """Means of values (rows, columns) over the cells of a mask in the window about each."""
    share = mask.astype(np.float32)
    total, count = (cv2.blur(each, (side, side), borderType=cv2.BORDER_CONSTANT) for each in (values * share, share))
    return total / np.maximum(count, np.float32(1e-6))
