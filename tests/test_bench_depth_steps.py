"""Steps of depth and sightings by the true surface: a block on a bed under water."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plane_survey import look

from refract import FlatWater
from survey.simulate.ground.shapes import TriangleMesh

ROOT = Path(__file__).resolve().parent.parent
WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.34)
BED, TOP = -3.0, -1.0


@pytest.fixture
def steps(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import survey_field_measures

    return survey_field_measures


def block() -> TriangleMesh:
    """A bed of 20 m and a block of 2 m on it, without its underside."""

    def quad(*corners):
        return [corners[0], corners[1], corners[2]], [corners[0], corners[2], corners[3]]

    square = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
    faces = [*quad(*((10 * x, 10 * y, BED) for x, y in square)), *quad(*((x, y, TOP) for x, y in square))]
    for (x0, y0), (x1, y1) in zip(square, square[1:] + square[:1], strict=True):
        faces += quad((x0, y0, BED), (x1, y1, BED), (x1, y1, TOP), (x0, y0, TOP))
    vertices = np.array(faces).reshape(-1, 3)
    return TriangleMesh(vertices, np.arange(len(vertices)).reshape(-1, 3))


def test_true_points_lie_on_the_surface_at_their_length_of_the_bent_path(steps):
    camera = look((2.0, 0.0, 10.0), (0.0, 0.0, -2.0), size=(40, 30), focal=80.0)
    distance, points = steps.true_points(camera, WATER, block())
    np.testing.assert_allclose(camera.paths(camera.pixel_centres(), WATER).at(distance), points, atol=1e-9)
    on_bed, on_top = (np.abs(points[..., 2] - z) < 1e-9 for z in (BED, TOP))
    beside = np.abs(np.abs(points[..., :2]).max(axis=-1) - 1.0) < 1e-9
    assert (on_bed | on_top | beside).all()
    assert on_bed.any()
    assert on_top.any()
    thinned, _ = steps.true_points(camera, WATER, block(), 4)
    np.testing.assert_array_equal(thinned, distance[2::4, 2::4])


def test_pixels_beside_a_step_are_those_within_reach_of_it_and_a_slope_is_none(steps):
    distance = np.full((20, 30), 10.0)
    distance[:, 15:] = 11.0
    found = steps.near_steps(distance, 100.0)
    np.testing.assert_array_equal(np.flatnonzero(found[0]), np.arange(14 - 5, 15 + 6))
    assert (found == found[0]).all()
    # A rise by 0.3 m over a pixel of 0.1 m, steep and no step.
    assert not steps.near_steps(10.0 + 0.3 * np.arange(30.0)[None] * np.ones((20, 1)), 100.0).any()


def test_places_behind_the_block_are_not_seen(steps):
    cameras = [look((x, 0.0, 10.0), (0.0, 0.0, -2.0), size=(240, 180), focal=260.0) for x in (-8.0, 0.0, 8.0)]
    points = np.array([[[0.0, 0.0, TOP], [1.5, 0.0, BED], [-1.5, 0.0, BED], [np.nan] * 3, [90.0, 0.0, BED]]])
    assert steps.sightings(points, cameras, WATER, block()).tolist() == [[3, 2, 2, 0, 0]]
