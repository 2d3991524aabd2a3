"""Shapes of a drawn bed: rays meet grids and boxes where closed forms say."""

from __future__ import annotations

import numpy as np
import pytest

from survey.simulate.ground.shapes import BedGrid, Solid


def test_rays_over_a_slope_of_triangles_end_at_the_distance_in_closed_form(rng):
    x, y = 0.1 * np.arange(60), 0.1 * np.arange(40)[:, None]
    bed = BedGrid(0.3 * x - 0.2 * y - 1.0, 0.0, 0.0, 0.1)
    origin = rng.uniform((2.0, 1.5, 2.0), (4.0, 2.5, 3.0), (500, 3))
    direction = np.array([*rng.uniform(-0.3, 0.3, (2, 500)), np.full(500, -1.0)]).T
    direction[:20, :2] = 0.0  # plumb
    direction[20:40, 0] = 0.0  # along a line of the grid
    direction[40:60, 1] = -direction[40:60, 0]  # along the diagonals
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    expected = (origin @ (0.3, -0.2, -1.0) - 1.0) / (direction @ (-0.3, 0.2, 1.0))
    endless = np.full(500, np.inf)
    np.testing.assert_allclose(bed.hit(origin, direction, endless)[0], expected, atol=1e-12)
    assert np.isinf(bed.hit(origin, direction, expected - 1e-6)[0]).all()


def test_a_ray_stops_at_a_thin_wall_of_the_bed_that_hides_the_ground_behind():
    heights = np.zeros((9, 400))
    heights[:, 200] = 1.0
    bed = BedGrid(heights, 0.0, 0.0, 0.01)
    origin, direction = np.array([[0.4, 0.045, 2.0]]), np.array([[1.6, 0.0, -1.4]])
    direction /= np.linalg.norm(direction)
    # The west face of the wall is the plane z = 100 (x - 1.99).
    t = (100.0 * (0.4 - 1.99) - 2.0) / (direction[0, 2] - 100.0 * direction[0, 0])
    np.testing.assert_allclose(bed.hit(origin, direction, np.array([np.inf]))[0], t, atol=1e-12)


def test_a_box_is_entered_where_its_faces_are_and_missed_beside_them():
    corners = np.stack(np.meshgrid([-1.0, 1.0], [-2.0, 2.0], [0.0, 3.0]), axis=-1).reshape(-1, 3)
    box = Solid.around(corners)
    assert len(box.normals) == 6
    assert len(box.faces) == 12
    origin = np.array([[0.0, 0.0, 5.0], [1.1, 0.0, 5.0], [-4.0, 0.0, 5.0], [0.5, 2.5, 5.0]])
    direction = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.6, 0.0, -0.8], [0.0, 0.0, -1.0]])
    t, plane = box.hit(origin, direction, np.full(4, np.inf))
    np.testing.assert_allclose(t, [2.0, np.inf, 5.0, np.inf], atol=1e-12)
    np.testing.assert_allclose(box.normals[plane[[0, 2]]], [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]], atol=1e-12)
    a, b, c = (box.vertices[box.faces[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0
    assert volume == pytest.approx(24.0)  # positive: all normals point outward
