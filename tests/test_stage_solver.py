"""What a later round keeps of what an earlier one has solved, at its own size."""

from __future__ import annotations

import numpy as np

from fields.solver.solver import SolvedMap
from fields.sweep.maps import HeightMap, upsample_map
from survey.run.stage_solver import _enlarged

SMALL, LARGE = (6, 8), (12, 16)


def flat_map(shape: tuple[int, int], height: float) -> HeightMap:
    """A map of one height, confirmed by three."""
    grey = np.full(shape, height, dtype=np.float32)
    return HeightMap(0, grey, grey, np.full(shape, 3, dtype=np.uint8), grey)


def test_solved_pixels_keep_height_and_std_at_twice_the_size():
    before = flat_map(SMALL, -2.0)
    left = np.zeros(SMALL, dtype=bool)
    left[:, :4] = True
    pixels = np.flatnonzero(left)
    solved = SolvedMap(pixels, np.full(len(pixels), -2.5, np.float32), np.full(len(pixels), 0.02, np.float32))
    keep = np.ones(LARGE, dtype=bool)
    keep[0] = False
    found = _enlarged(before, solved, upsample_map(before, LARGE[::-1]), keep)
    rows, columns = np.divmod(found.pixels, LARGE[1])
    # Every kept pixel whose small one was solved, and no other.
    assert rows.min() == 1
    assert columns.max() == 7
    assert len(found.pixels) == 11 * 8
    np.testing.assert_allclose(found.std, 0.02)
    # Away from the border of what was solved.
    np.testing.assert_allclose(found.height[columns < 7], -2.5, atol=1e-6)
