"""Seams in decoded JPEGs: where the rest of another photograph was joined to the first part of one.

Two streams joined where both have used the same number of blocks decode without a fault. But the rows of pixels that
meet there belong to different places: right of one block in its row of blocks, and left of it in the next row. Joined
at the begin of a row of blocks they look like pictures one over the other, or over a bar, and are not told from them.
"""

from __future__ import annotations

import numpy as np

# Differences between rows are compared by so many parts of the width.
_PARTS = 16
_FEWEST_ROWS = 8
# Grey levels that differences of less say nothing about.
_QUIET = 1.0
# Mean logarithm of how much larger a difference is than those of the rows beside it, and the same in robust standard
# deviations. 2,580 whole photographs: above 0.3 up to 4.8, else up to 6.2; 120 that were joined: from 0.51 and 8.7.
_LEAST, _LEAST_STD = 0.45, 7.5
# Least part of the step of a seam on each side; edges of a scene have none.
_LEAST_OF_A_SIDE = 0.4
# Straight edges in a scene lie at the rows of blocks no more often than elsewhere.
_OVER_OTHER_ROWS = 0.3


def has_seam(grey: np.ndarray, step: int) -> bool:
    """Whether a picture (H, W) uint8 has a seam between rows of blocks, which begin every `step` rows."""
    found = _scores(grey, step, 0)
    if found is None or len(found[0]) < _FEWEST_ROWS:
        return False
    usual = float(np.median(found[0]))
    spread = 1.4826 * float(np.median(np.abs(found[0] - usual)))
    most = _most(found)
    if most < max(_LEAST, usual + _LEAST_STD * spread):
        return False
    others = (_scores(grey, step, shift) for shift in range(1, step))
    return all(other is None or _most(other) < most - _OVER_OTHER_ROWS for other in others)


def _most(found: tuple[np.ndarray, np.ndarray]) -> float:
    scores, is_seam = found
    return float(scores[is_seam].max(initial=0.0))


def _scores(grey: np.ndarray, step: int, shift: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Ratio of differences across a seam to those beside it, and whether both its sides have it; (R, N).

    By its row and the part of the width it begins in; left of this part it lies in the next row of blocks. None for
    pictures that are too small.
    """
    height, width = grey.shape
    rows = np.arange(step, height - step, step) + shift
    rows = rows[rows < height - 1]
    each = max(width // _PARTS, 1)
    num = width // each
    if len(rows) < 2 or num < _PARTS:
        return None
    above, last, first, below = (
        grey[rows + i, : num * each].astype(np.float32).reshape(len(rows), num, each) for i in (-2, -1, 0, 1)
    )
    beside = (np.abs(last - above).mean(axis=2) + np.abs(below - first).mean(axis=2)) / 2
    across = np.abs(first - last).mean(axis=2)
    right, left = _sums(np.log((across + _QUIET) / (beside + _QUIET)))
    found = (right[:-1] + left[1:]) / num
    parts = np.arange(1, num)
    of_sides = np.minimum(right[:-1, 1:-1] / (num - parts), left[1:, 1:-1] / parts)
    is_seam = of_sides > _LEAST_OF_A_SIDE * found[:, 1:-1]
    return found[:, 1:-1], is_seam


def _sums(larger: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums (R, num + 1) of (R, num), less what is usual, right of each border between parts, and left of it."""
    larger = larger - np.median(larger, axis=0)
    left = np.concatenate([np.zeros((len(larger), 1)), np.cumsum(larger, axis=1)], axis=1)
    return left[:, -1:] - left, left
