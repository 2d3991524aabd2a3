"""M3C2 against the two planes that py4dgeo itself is tested with."""

import numpy as np
import pytest

from evaluation import m3c2_distances

pytest.importorskip("py4dgeo", reason="py4dgeo is not installed: pip install 'bathynerf[m3c2]'")
# What importing py4dgeo's own dependencies warns about is not ours.
pytestmark = pytest.mark.filterwarnings("ignore")


def test_two_horizontal_planes_are_a_tenth_of_a_metre_apart(data_dir):
    first, second = (np.loadtxt(data_dir / "real" / "py4dgeo_planes" / f"plane_horizontal_t{i}.xyz") for i in (1, 2))
    found = m3c2_distances(first, second, first, radius_m=3.0, reach_m=5.0)
    # Figures of py4dgeo 1.2.0, to the digits that are published with the planes.
    assert np.mean(found.signed) == pytest.approx(-0.1001, abs=5e-5)
    assert np.std(found.signed) == pytest.approx(0.0009, abs=1e-4)
    assert np.isfinite(found.detection_m).all()


def test_a_tilted_plane_is_measured_along_its_normal_and_empty_cylinders_are_nan(rng):
    plan = rng.uniform(-5.0, 5.0, (4000, 2))
    reference = np.column_stack([plan, 0.75 * plan[:, 0]])
    cloud = reference[np.abs(plan[:, 1]) < 3.0] + [0.0, 0.0, 0.1]
    core = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.75], [0.0, 4.9, 0.0]])
    found = m3c2_distances(reference, cloud, core, radius_m=0.5, reach_m=1.0)
    # cos(atan(0.75)) = 0.8.
    np.testing.assert_allclose(found.signed, [0.08, 0.08, np.nan], atol=1e-9)
