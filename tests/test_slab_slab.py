"""The slab about the proxy: medians per cell, holes, sheared coordinates, and the proxy between its cells."""

from __future__ import annotations

import math

import numpy as np
import torch
from plane_field import level_slab

from fields.slab.rays import Slab

# Local coordinates of some 10 m in float32, in units of cells of 0.1 m; measured 1e-6 of a box, 1e-6 m.
BOX, HEIGHT_M = 2e-6, 4e-6


def scattered(rng, num: int = 400):
    """Points over 3 x 2 m with a hole in the middle, and their heights."""
    xy = rng.uniform((-4.0, 7.0), (-1.0, 9.0), (num, 2))
    xy = xy[np.abs(xy - (-2.5, 8.0)).max(axis=1) > 0.5]
    return xy, rng.normal(-2.0, 0.1, len(xy))


def rough_slab(rng) -> Slab:
    """5 rows of 7 cells of 0.5 m with heights of their own."""
    proxy = rng.normal(0.0, 0.3, (5, 7)).astype(np.float32)
    return Slab(np.array([10.0, -3.0]), 0.5, proxy, np.ones((5, 7), bool), 0.2)


def test_every_point_lies_in_a_cell_and_cells_have_the_median_of_their_points(rng):
    xy, height = scattered(rng)
    slab = Slab.of_points(xy, height, 0.25, 0.1)
    cells: dict[tuple[int, int], list[float]] = {}
    for (x, y), z in zip(xy, height, strict=True):
        cells.setdefault((int((y - slab.low[1]) // 0.25), int((x - slab.low[0]) // 0.25)), []).append(z)
    assert {len(v) % 2 for v in cells.values()} == {0, 1}  # an even count has two heights in its middle
    assert int(slab.known.sum()) == len(cells)
    for (row, column), heights in cells.items():
        assert slab.known[row, column]
        assert slab.proxy[row, column] == np.float32(np.median(heights))
    assert (slab.half, slab.cell) == (0.1, 0.25)
    assert slab.holds(torch.from_numpy(xy).float()).all()


def test_cells_without_points_take_the_nearest_height_and_are_not_known(rng):
    xy, height = scattered(rng)
    slab = Slab.of_points(xy, height, 0.25, 0.1)
    known = np.argwhere(slab.known)
    assert np.isfinite(slab.proxy).all()
    assert not slab.known.all()
    for row, column in np.argwhere(~slab.known):
        away = np.hypot(*(known - (row, column)).T)
        nearest = {float(slab.proxy[r, c]) for r, c in known[away <= away.min() + 1e-9]}
        assert float(slab.proxy[row, column]) in nearest


def test_one_point_makes_a_slab():
    slab = Slab.of_points(np.array([[3.0, 4.0]]), np.array([-1.5]), 0.1, 0.05)
    assert slab.known.sum() == 1
    assert (slab.proxy == np.float32(-1.5)).all()


def test_the_box_runs_from_zero_to_one(rng):
    slab = rough_slab(rng)
    np.testing.assert_allclose(slab.size, [3.5, 2.5, 0.4])
    xy = torch.tensor([[10.0, -3.0], [13.5, -0.5], [11.75, -1.75]])
    u = slab.box_coordinates(xy, torch.tensor([-0.2, 0.2, 0.0]))
    np.testing.assert_allclose(u, [[0, 0, 0], [1, 1, 1], [0.5, 0.5, 0.5]], atol=BOX)


def test_the_proxy_is_bilinear_between_cell_centres_and_level_beyond_the_outermost(rng):
    slab = rough_slab(rng)
    xy = rng.uniform((9.0, -4.0), (14.5, 0.5), (300, 2)).astype(np.float32)
    found = slab.height_at(torch.from_numpy(xy)).numpy()
    for (x, y), z in zip(xy.astype(float), found, strict=True):
        column = min(max((x - 10.0) / 0.5 - 0.5, 0.0), 6.0)
        row = min(max((y + 3.0) / 0.5 - 0.5, 0.0), 4.0)
        truth = 0.0
        for r in (math.floor(row), math.floor(row) + 1):
            for c in (math.floor(column), math.floor(column) + 1):
                weight = (1.0 - abs(row - r)) * (1.0 - abs(column - c))
                truth += weight * float(slab.proxy[min(r, 4), min(c, 6)])
        assert abs(z - truth) < HEIGHT_M


def test_a_plane_proxy_is_that_plane(rng):
    slab = level_slab(-2.0, slope_x=0.1)
    xy = rng.uniform(-3.9, 3.9, (200, 2)).astype(np.float32)
    np.testing.assert_allclose(slab.height_at(torch.from_numpy(xy)), -2.0 + 0.1 * xy[:, 0], atol=HEIGHT_M)


def test_it_holds_the_places_of_known_cells_alone(rng):
    slab = rough_slab(rng)
    slab.known[2, 3] = False
    for row in range(-1, 6):
        for column in range(-1, 8):
            place = torch.tensor([[10.0 + 0.5 * (column + 0.4), -3.0 + 0.5 * (row + 0.7)]])
            inside = 0 <= row < 5 and 0 <= column < 7 and (row, column) != (2, 3)
            assert bool(slab.holds(place)[0]) == inside, (row, column)
