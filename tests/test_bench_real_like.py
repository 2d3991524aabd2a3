"""The campaign of blocks as they come from the field: a seed is a block, and exact matches stand for photographs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from survey.simulate.ground.shapes import BedGrid

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import bench_real_like
    import real_like_blocks

    return SimpleNamespace(bench=bench_real_like, blocks=real_like_blocks, ties=bench_real_like)


def test_a_seed_is_always_the_same_block_and_seeds_are_of_every_kind(bench):
    drawn = [bench.blocks.RealLikeBlock.of(seed) for seed in range(1, 201)]
    assert drawn == [bench.blocks.RealLikeBlock.of(seed) for seed in range(1, 201)]
    for name in ("ground", "num_lines", "has_gap", "gps", "wrong_control", "given", "level", "has_lens", "has_area"):
        assert len({getattr(block, name) for block in drawn}) > 1
    sizes = [block.num_views for block in drawn]
    assert min(sizes) == 2
    assert 50 <= max(sizes) <= 60
    assert {block.num_control for block in drawn} == set(range(13))


@pytest.mark.slow
def test_a_block_of_exact_matches_is_adjusted_to_the_truth(bench, tmp_path):
    block = bench.blocks.RealLikeBlock(
        7, "dry", 12, 2, has_gap=False, gps="good", num_control=0, wrong_control=False, given="found", level="missing",
        has_lens=True, has_area=False,
    )  # fmt: skip
    heights = np.random.default_rng(0).normal(-0.5, 0.05, (40, 200))
    bed = BedGrid(heights, -50.0, -10.0, 0.5)
    flights = tmp_path / "flights"
    (flights / "dry").mkdir(parents=True)
    np.savez(flights / "dry" / "bed.npz", heights=heights, corner=np.array([-50.0, -10.0, 0.5]))
    block.draw(tmp_path / "block", flights, grey=True)
    points, covered = bench.ties.adjusted_by_ties(block, tmp_path / "block", bed)
    errors = bench.bench.errors_of(points, block, flights)
    assert errors["points"] > 100
    # The focal length of a data sheet is good to 2 %, of 14 m.
    assert abs(errors["median_m"]) < 0.5
    assert covered > 0.5


def test_outcomes_are_counted(bench):
    record = {"by": "ties", "outcome": "result", "seconds": 1.0}
    found = {"1": record, "2": record, "3": record | {"outcome": "refused"}, "4": record | {"by": "photographs"}}
    lines = bench.bench.totals_of(found)
    assert lines[2:] == ["| photographs | 1 | 1 | 0 | 0 | 0 |", "| ties | 3 | 2 | 0 | 1 | 0 |"]
