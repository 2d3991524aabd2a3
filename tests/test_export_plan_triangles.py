"""Triangles in plan by bands of rows: those of all points at once."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import Delaunay

from survey.export import plan_triangles
from survey.export.plan_triangles import most_certain, triangles

CELL_M, LONGEST_M = 0.1, 0.6


def scattered(rng, *, count: int = 4000) -> np.ndarray:
    """Points of a bed far from the origin with a straight shore, and rocks off it, farther than a band is wide.

    Circles through places on the shore bulge over the void; only a rock in another band may lie in them.
    """
    bed = rng.uniform((0.0, 0.0, -1.0), (4.0, 20.0, 0.0), (count, 3))
    along = np.arange(0.05, 20.0, 0.1)
    shore = np.column_stack([4.0 + 1e-3 * rng.random(len(along)), along, np.zeros(len(along))])
    rocks = [np.array([9.0, place, -1.0]) + rng.uniform(-0.3, 0.3, (30, 3)) for place in (3.0, 11.0, 19.0)]
    return np.concatenate([bed, shore, *rocks]) + np.array([400.0, -700.0, 0.0])


def as_set(faces) -> set[tuple[int, ...]]:
    """Triangles from their least corner on, which keeps their sense."""
    faces = np.asarray(faces)
    columns = (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3
    return set(map(tuple, np.take_along_axis(faces, columns, axis=1).tolist()))


@pytest.mark.parametrize("of_band", [37, 500, 10**9])
def test_of_each_cell_the_surest_point_stays_whatever_is_sorted_at_a_time(rng, monkeypatch, of_band):
    points = scattered(rng)
    std = rng.choice([0.01, 0.02, np.nan], len(points))
    monkeypatch.setattr(plan_triangles, "_PORTION", 111)
    numbers = most_certain(points, std, CELL_M, of_band)
    cells = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / CELL_M).astype(int)
    best: dict[tuple[int, int], int] = {}
    for number, (column, row) in enumerate(cells.tolist()):
        other = best.setdefault((row, column), number)
        if np.nan_to_num(std[number], nan=np.inf) < np.nan_to_num(std[other], nan=np.inf):
            best[row, column] = number
    assert numbers.tolist() == [best[cell] for cell in sorted(best)]


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("of_band", [1, 300, 1500])
def test_triangles_by_bands_are_those_of_the_whole(seed, of_band):
    rng = np.random.default_rng(seed)
    points = scattered(rng)[:, :2]
    xy, south = points, float(points[:, 1].min())
    xy = xy[most_certain(np.column_stack([xy, xy[:, 0]]), np.zeros(len(xy)), CELL_M)]
    whole = Delaunay(xy - xy.mean(axis=0)).simplices
    sides = np.linalg.norm(xy[whole] - xy[np.roll(whole, 1, axis=1)], axis=2)
    expected = as_set(whole[sides.max(axis=1) < LONGEST_M])
    found = triangles(xy, south, LONGEST_M, CELL_M, of_band)
    assert len(found) == len(expected)
    assert as_set(found) == expected


def test_rows_without_points_make_no_band():
    """A band of more points than it may have, and empty rows behind it."""
    rng = np.random.default_rng(5)
    south, north = rng.uniform(0.0, 0.05, (300, 2)), rng.uniform(0.0, 0.05, (50, 2)) + np.array([0.0, 9.0])
    plan = np.concatenate([south, north]) * [40.0, 1.0]
    numbers = most_certain(np.column_stack([plan, plan[:, 0]]), np.zeros(len(plan)), CELL_M, 10)
    np.testing.assert_array_equal(
        numbers, most_certain(np.column_stack([plan, plan[:, 0]]), np.zeros(len(plan)), CELL_M)
    )


def test_few_points_and_points_on_a_line_make_no_triangle():
    line = np.column_stack([np.arange(50.0), np.zeros(50)]) * 0.1
    for xy in (line[:0], line[:2], line, line[:, ::-1]):
        assert triangles(xy, 0.0, LONGEST_M, CELL_M, 5).shape == (0, 3)
