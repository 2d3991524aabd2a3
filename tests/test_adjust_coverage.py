"""What an adjustment states about itself: truth lies within its 95 % as often as it should."""

from __future__ import annotations

import adjust_coverage as benchmark
import numpy as np
import pytest
from slow_cases import slow

# Of 8 parameters of 95 % each more than two lie beyond in half a per cent of all draws. Errors of the poses of a block
# go together: their share over a few blocks varies by some 3 %.


@pytest.mark.parametrize(
    ("shared", "num_points", "seeds"), [(False, 200, (2, 3, 5, 8, 9, 10)), slow(True, 400, (5, 14))]
)
def test_truth_lies_within_what_is_stated(shared, num_points, seeds):
    blocks = [benchmark.covered(seed, shared=shared, num_points=num_points) for seed in seeds]
    within, found = np.sum([benchmark.share_within(blocks, name) for name in benchmark.NAMES], axis=0)
    assert found >= 3
    assert within >= found - 2
    for share in benchmark.poses_within(blocks):
        assert 0.88 < share < 0.995


def test_shared_errors_cost_more_than_independent_ones():
    alone, shared = (benchmark.covered(5, shared=shared, num_points=450) for shared in (False, True))
    assert alone.factor < 1.1
    # Twice the noise of a pixel is shared: four parts in five of the variance.
    assert shared.factor > 1.5


def test_the_table_counts_what_was_found():
    positions = np.array([[0.0, 1.0, 3.0]])
    scaled = {"level_m": 1.0, "refractive_index": 0.0, "camera0.f": 2.5}
    block = benchmark.Covered(7, {}, scaled, frozenset({"level_m", "camera0.f"}), positions, positions, 1.0)
    assert benchmark.share_within([block, block], "level_m") == (2, 2)
    assert benchmark.share_within([block], "camera0.f") == (0, 1)
    assert benchmark.share_within([block], "refractive_index") == (0, 0)
    assert "level_m 1 of 1, refractive_index 0 of 0, camera0.f 0 of 1" in benchmark.table([block])
    assert "66.7% and 66.7%" in benchmark.table([block])
