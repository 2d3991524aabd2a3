"""Real points that straight rays made, and their cameras: what each correction of them errs (bench_real_points.py)."""

import bench_real_points as benchmark
import numpy as np
import pytest

# Every so many of 64,920 points.
EVERY = 130


@pytest.fixture
def stream(data_dir):
    return benchmark.read_stream(data_dir / "real" / "pyBathySfM", EVERY)


def test_the_cameras_of_the_sample_see_its_points_as_its_own_program_has_it(stream):
    for block, theirs in (stream.every, stream.near):
        found = benchmark.corrected(block, stream.straight).per_camera
        deep = -stream.straight[:, 2] > 0.1
        # A point at the rim of a frame may have a camera more or less.
        assert np.quantile(np.abs(found / theirs - 1.0)[deep], 0.99) < 0.01


def test_bent_rays_find_a_stream_again_where_corrections_of_straight_ones_miss_it(stream):
    block = stream.near[0]
    bed = np.column_stack([stream.straight[:, :2], 14.0 * stream.straight[:, 2]])
    known = benchmark.repeated(block, bed, noise_px=0.5, seed=1)
    errors = {name: float(np.mean(depth - known.truth)) for name, depth in known.found.methods().items()}
    # About 3 m deep: straight rays lose a third of it, the index brings back a quarter, and cameras one by one more.
    assert errors["straight"] < -0.2 * known.truth.mean()
    assert errors["times index"] < -0.03 * known.truth.mean()
    assert errors["per camera (Dietrich)"] < -0.01 * known.truth.mean()
    assert abs(errors["bent rays, least squares"]) < 0.0005 * known.truth.mean()
    assert 0.92 < known.inside < 0.98


def test_the_straight_points_alone_tell_bent_rays_where_the_bed_is_without_noise(stream):
    block = stream.near[0]
    bed = np.column_stack([stream.straight[:, :2], 1.4 * stream.straight[:, 2]])
    known = benchmark.repeated(block, bed, noise_px=0.0, seed=1)
    np.testing.assert_allclose(known.found.bent, known.truth, atol=1e-6)
    share = (known.from_points / known.truth - 1.0)[known.truth > 0.1]
    assert np.abs(share).max() < 0.02


def test_heights_of_coral_heads_are_nearer_to_the_tape_with_bent_rays(data_dir):
    truth, methods = benchmark.palau(data_dir / "real" / "palau_coral_heights")
    rms = [float(np.sqrt(np.mean((height - truth) ** 2))) for height in methods.values()]
    straight, by_index, by_camera, bent, theirs = rms
    # Published: 21.4 cm before, 10.1 cm after their own correction.
    assert straight == pytest.approx(0.214, abs=1e-3)
    assert theirs == pytest.approx(0.101, abs=1e-3)
    assert bent < by_camera < by_index < straight
