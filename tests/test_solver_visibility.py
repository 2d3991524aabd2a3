"""Where the kernels of the solver see a point is where its camera does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plane_survey import TILTED, ring

from fields.solver.visibility import Projector
from refract.distortion import Distortion


@pytest.mark.parametrize("water", [TILTED, None], ids=["wet", "dry"])
@pytest.mark.parametrize("bent", [False, True], ids=["pinhole", "lens"])
def test_points_of_pixels_are_seen_where_cameras_see_them(device, rng, water, bent):
    cameras = ring(4)
    if bent:
        lens = Distortion("brown", (-0.08, 0.02, 1e-3, -5e-4, 0.0))
        cameras = [replace(camera, distortion=lens) for camera in cameras]
    pixels = rng.uniform(1.0, np.array([95.0, 71.0]), (500, 2))
    heights = rng.uniform(-2.5, 0.4, 500).astype(np.float32)
    projector = Projector(device, dict(enumerate(cameras)), water)
    points = projector.points(0, pixels, heights)
    expected = cameras[0].paths(pixels, water).at_height(heights.astype(np.float64), water)
    for view, camera in enumerate(cameras):
        at, inside = projector.seen(view, points)
        where = camera.project(expected, water)
        np.testing.assert_allclose(at.T, where, atol=2e-3)
        size = np.array([camera.width, camera.height])
        clear = ((where > 0.51) & (where < size - 0.51)).all(axis=1)
        assert inside[clear].all()
        assert not inside[((where < 0.49) | (where > size - 0.49)).any(axis=1)].any()
