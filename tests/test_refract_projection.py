"""Where a point under water appears: against brute force, another package, and over the extremes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from slow_reference import least_path_crossing

from refract import FlatWater, PinholeCamera, crossing_point

CROSSING_M = 1e-9  # the promise of crossing_point
WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.333)
ORACLE_FOCAL_PX = 1662.7687752661222  # ground_truth.json of aquacal_oracle, 1920 x 1080


def test_crossing_minimises_the_optical_path_over_the_extremes(rng):
    count = 150
    H = 10.0 ** rng.uniform(-3, 4, count)
    h = 10.0 ** rng.uniform(-4, 3, count)
    D = (H + h) * 10.0 ** rng.uniform(-4, 1, count)
    n = rng.uniform(1.0, 1.6, count)
    for i in range(count):
        found = crossing_point(
            np.array([D[i], 0.0, -h[i]]), np.array([0.0, 0.0, H[i]]), FlatWater((0.0, 0.0, 0.0), n_water=n[i])
        )
        assert abs(found[0] - least_path_crossing(D[i], H[i], h[i], n[i])) < CROSSING_M
        assert abs(found[1]) < CROSSING_M
        assert abs(found[2]) < CROSSING_M


def test_crossings_of_another_package_are_met(data_dir):
    """AquaCal's world has z down into the water; half a turn about x makes it ours."""
    vectors = data_dir / "real" / "aquacal_oracle" / "aquacal_1.0.2_vectors.csv"
    rows = np.genfromtxt(vectors, delimiter=",", names=True)
    assert len(rows) == 163
    half_turn = np.diag([1.0, -1.0, -1.0])
    for row in rows:

        def xyz(*names, row=row):
            return half_turn @ np.array([row[name] for name in names])

        water = FlatWater((0.0, 0.0, -row["water_z"]), n_water=row["n_water"])
        rotation = Rotation.from_rotvec([row["rvx"], row["rvy"], row["rvz"]]).as_matrix() @ half_turn
        camera = PinholeCamera(
            xyz("Cx", "Cy", "Cz"), rotation, ORACLE_FOCAL_PX, ORACLE_FOCAL_PX, 960.0, 540.0, 1920, 1080
        )
        entry, bed = xyz("ix", "iy", "iz"), xyz("Px", "Py", "Pz")
        np.testing.assert_allclose(crossing_point(bed, camera.centre, water), entry, atol=1e-12)
        np.testing.assert_allclose(camera.project(bed, water), [row["u"], row["v"]], atol=1e-9)
        path = camera.paths(np.array([row["u"], row["v"]]), water)
        np.testing.assert_allclose(path.crossing, entry, atol=1e-12)
        np.testing.assert_allclose(path.water_direction, xyz("dx", "dy", "dz"), atol=1e-12)


def test_a_point_straight_below_is_seen_straight_below():
    water = FlatWater((0.0, 0.0, 1.0), n_water=1.333)
    found = crossing_point(np.array([4.0, 5.0, -3.0]), np.array([4.0, 5.0, 30.0]), water)
    np.testing.assert_array_equal(found, [4.0, 5.0, 1.0])


@pytest.mark.parametrize(
    ("water", "camera_z", "heights"),
    [(WATER, 35.0, (0.0, 9.0)), (None, 35.0, (-9.0, 9.0)), *((WATER, z, (-9.0, 3.0)) for z in (0.0, -0.5, -20.0))],
    ids=["points above", "no water", "camera on the surface", "camera below", "camera deep"],
)
def test_points_that_are_seen_straight_are_their_own_crossing(rng, water, camera_z, heights):
    points = rng.uniform([-30.0, -30.0, heights[0]], [30.0, 30.0, heights[1]], (100, 3))
    points[0, 2] = heights[0]
    np.testing.assert_array_equal(crossing_point(points, np.array([1.0, 2.0, camera_z]), water), points)


def test_crossing_and_point_meet_as_the_depth_goes_to_zero():
    water, centre = FlatWater((0.0, 0.0, 0.0), n_water=1.333), np.array([0.0, 0.0, 30.0])
    depth = np.array([0.0, 1e-300, 1e-15, 1e-9, 1e-6, 1e-3])
    points = np.stack([np.full(6, 20.0), np.zeros(6), -depth], axis=-1)
    shift = 20.0 - crossing_point(points, centre, water)[:, 0]
    tangent_in_water = 20.0 / math.sqrt(1.333**2 * (20.0**2 + 30.0**2) - 20.0**2)
    # 1e-14: coordinates of 20 m; the share of the depth grows by h / H, 3e-5 at 1 mm
    np.testing.assert_allclose(shift, depth * tangent_in_water, rtol=1e-4, atol=1e-14)
