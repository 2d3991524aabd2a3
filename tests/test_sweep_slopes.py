"""Where a height map is steep."""

from __future__ import annotations

import numpy as np
import pytest

from fields.sweep.planes import slope_of, steep_and_wall_pixels


@pytest.mark.parametrize("height", [0.0, -300.0])
def test_the_slope_of_a_plane_is_its_rise_from_pixel_to_pixel(height):
    rows, columns = np.mgrid[:20, :30]
    plane = (height + 0.03 * rows - 0.04 * columns).astype(np.float32)
    inner = np.s_[1:-1, 1:-1]
    np.testing.assert_allclose(slope_of(plane)[inner], 0.05, atol=1e-4)


def test_a_wall_is_steep_and_plane_and_an_edge_is_not_plane():
    wall = np.repeat((0.3 * np.clip(np.arange(30) - 10, 0, 9)).astype(np.float32)[None], 20, axis=0)
    found = steep_and_wall_pixels(wall, 0.1)[1][10]
    assert found[12:18].all()
    assert not found[:10].any()
    assert not found[21:].any()
    edge = np.where(np.arange(30) < 15, 0.0, 2.0).astype(np.float32)[None].repeat(20, axis=0)
    steep, walls = steep_and_wall_pixels(edge, 0.1)
    assert steep[10, 14:16].all()
    assert not steep[10, :13].any()
    assert not walls.any()
