"""The pairs that show how the sweep locks to pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, match, ring

from fields.device import choose_device

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import bench_sampling

    return bench_sampling


def test_bilinear_samples_lock_to_pixels_evenly_to_both_sides_and_a_filter_weakens_it(benchmark):
    means, spread = benchmark.matched(0.0, 1, pixels=128)
    # Measured 36 and 35 thousandths of a pixel, by a wave over the shifts; 132 of spread.
    assert 0.02 < np.ptp(means) / 2.0 < 0.05
    assert abs(means.mean()) < 0.005
    assert 0.08 < spread < 0.2
    filtered, _ = benchmark.matched(0.8, 1, pixels=128)
    assert np.ptp(filtered) < 0.6 * np.ptp(means)


def test_the_cubic_spline_is_what_the_kernels_sample(benchmark):
    device, bed, cameras = choose_device("cpu"), PlaneBed(TILTED, -2.0), ring(4)
    if device.name != "llvm":
        pytest.skip(f"Dr.Jit does not run on this CPU: {device.reason}")
    truth, lost = bed.true_height(cameras[0]), []
    for order in (1, 3):
        with benchmark.sampler(0.0, order):
            stack = bed.block(device, cameras).stack(1.0)
            _, score, curvature = match(stack, [1, 2, 3, 4], (truth - 0.08).astype(np.float32), 0.04, 5, 2)
        lost.append(1.0 - np.median(score[curvature > 0.0]))
    # The texture has no noise: a spline through its pixels is nearer to it, and correlates better.
    assert lost[1] < 0.8 * lost[0]
