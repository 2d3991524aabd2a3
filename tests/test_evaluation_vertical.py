"""Vertical differences: planes, holes, overhangs, and a ray caster of another library."""

import igl
import numpy as np
import pytest

from evaluation import vertical_difference

# A quotient of cross products of coordinates up to 1e3 m.
ROUNDING_M = 1e-10
UP = np.array([0.0, 0.0, 1.0])


def _relief(rng, side=30, size=10.0):
    """A triangulated relief of random heights over a square, and its faces."""
    along = np.linspace(0.0, size, side)
    x, y = np.meshgrid(along, along)
    vertices = np.stack([x.ravel(), y.ravel(), rng.normal(0.0, 0.3, x.size)], axis=1)
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + side], 1), np.stack([a + 1, a + side + 1, a + side], 1)])
    return vertices, faces


def test_random_points_over_a_relief_agree_with_rays(rng):
    vertices, faces = _relief(rng)
    points = np.column_stack([rng.uniform(0.01, 9.99, (500, 2)), rng.uniform(-2.0, 2.0, 500)])
    tree = igl.AABB()
    tree.init(vertices, faces.astype(np.int64))
    tops = np.column_stack([points[:, :2], np.full(500, 50.0)])
    down = np.tile([0.0, 0.0, -1.0], (500, 1))
    _, fall, _ = tree.intersect_ray_first(vertices, faces.astype(np.int64), tops, down)
    # igl keeps the length of a ray in float32: 50 m * 2^-23.
    np.testing.assert_allclose(vertical_difference(points, vertices, faces), points[:, 2] - (50.0 - fall), atol=6e-6)


def test_points_on_vertices_and_edges_are_over_the_surface(rng):
    vertices, faces = _relief(rng)
    middles = 0.5 * (vertices[faces[:, 0]] + vertices[faces[:, 1]])
    for on in (vertices, middles):
        np.testing.assert_allclose(vertical_difference(on + UP / 4, vertices, faces), 0.25, atol=ROUNDING_M)


def test_beyond_the_rim_and_in_holes_there_is_none(rng):
    vertices, faces = _relief(rng)
    middle = vertices[faces][..., :2].mean(axis=1)
    open_faces = faces[np.abs(middle - 5.0).max(axis=1) > 1.5]
    points = np.array([[-0.1, 5.0, 0.0], [5.0, 5.0, 0.0], [np.nan, 1.0, 0.0], [1.0, 1.0, 0.0], [5.0, 10.2, 0.0]])
    difference = vertical_difference(points, vertices, open_faces)
    assert np.isfinite(difference).tolist() == [False, False, False, True, False]


def test_under_an_overhang_the_surface_that_is_nearest_in_height_counts():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    vertices = np.concatenate([square, square + 2 * UP])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]])
    points = np.array([[0.5, 0.3, 0.4], [0.5, 0.3, 1.7], [0.5, 0.3, 1.0], [0.5, 0.3, 2.5]])
    np.testing.assert_allclose(vertical_difference(points, vertices, faces), [0.4, -0.3, 1.0, 0.5], atol=ROUNDING_M)
    # A wall has none.
    wall = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0, 1]])
    assert np.isnan(vertical_difference(np.array([[0.5, 0.0, 0.2]]), wall, np.array([[0, 1, 2]]))).all()
    assert len(vertical_difference(np.empty((0, 3)), wall, np.array([[0, 1, 2]]))) == 0


def test_large_triangles_among_many_small_ones_and_blocks_of_points_change_nothing(rng):
    vertices, faces = _relief(rng)
    far = np.array([[-500.0, -500, -30], [900, -500, -30], [0, 900, -30]])
    # So many that the points of both blocks are divided once more.
    both = np.concatenate([vertices, far]), np.concatenate([faces, np.tile(len(vertices) + np.arange(3), (180, 1))])
    points = np.column_stack([rng.uniform(0.0, 10.0, (21_000, 2)), rng.uniform(-0.5, 0.5, 21_000)])
    expected = vertical_difference(points, vertices, faces)
    steps = []
    found = vertical_difference(points, *both, advance=steps.append)
    np.testing.assert_allclose(found, expected, atol=ROUNDING_M)
    assert sum(steps) == len(points)
    assert np.count_nonzero(steps) > 1


@pytest.mark.parametrize("shift", [0.0, 5e6])
def test_coordinates_of_a_map_lose_no_more_than_their_rounding(rng, shift):
    vertices, faces = _relief(rng)
    points = np.column_stack([rng.uniform(0.1, 9.9, (200, 2)), np.zeros(200)])
    at = np.array([shift, shift, 0.0])
    expected = vertical_difference(points, vertices, faces)
    # float64 steps by 1e-9 m at 5e6 m; slopes of this relief reach 3.
    np.testing.assert_allclose(vertical_difference(points + at, vertices + at, faces), expected, atol=2e-8)
