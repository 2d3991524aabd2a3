"""What the benchmark of lenses draws, and that it finds the same bed through each of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
# Asked for; measured 0.04 mm. Where photographs were resampled to take distortion out, 0.3 to 0.5 mm.
SAME_MEAN_M = 3e-4


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import bench_lens

    return bench_lens


def test_the_lenses_of_a_scene_look_at_the_same_ground_from_the_same_places(benchmark, monkeypatch):
    monkeypatch.setattr(benchmark, "SIZE_PX", (80, 60))
    monkeypatch.setattr(benchmark, "NUM_VIEWS", 4)
    scene = benchmark.drawn_scene(3)
    straight, *bent = (benchmark.staged(scene, name) for name in benchmark.DISTORTIONS)
    assert not straight.lens.is_distorted
    for other in bent:
        assert other.lens.is_distorted
        np.testing.assert_array_equal(other.renderer.ground.bed.heights, straight.renderer.ground.bed.heights)
        for mine, theirs in zip(other.cameras, straight.cameras, strict=True):
            np.testing.assert_array_equal(mine.centre, theirs.centre)
        # The corner, which the barrel alone shows more of, lies on the ground too.
        camera = other.lens.camera(other.cameras[0].centre, other.cameras[0].cam_from_local)
        rays = camera.directions(camera.outline())
        hits = other.renderer.trace_rays(np.broadcast_to(camera.centre, rays.shape), rays)
        assert np.isfinite(hits.points).all()


@pytest.mark.slow
def test_a_lens_that_distorts_does_not_move_the_bed(benchmark, tmp_path):
    found = list(benchmark.records(range(2, 3), "standard", tmp_path))
    means = [record["mean_inner90_m"] for record in found]
    assert len(means) == 3
    assert np.ptp(means) < SAME_MEAN_M
