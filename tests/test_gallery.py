"""The figures that docs/gallery.md states, against the code that draws its pictures."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from refract import FlatWater, apparent_depth, apparent_depth_tangential

ROOT = Path(__file__).resolve().parent.parent
N = 1.333


@pytest.fixture
def networks(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import gallery_networks

    return gallery_networks


@pytest.fixture(scope="module")
def page() -> str:
    return " ".join((ROOT / "docs" / "gallery.md").read_text(encoding="utf-8").split())


def test_straight_rays_of_a_ring_meet_at_the_sagittal_image(networks):
    angle, azimuth = np.radians(30.0), np.radians(np.arange(0.0, 360.0, 30.0))
    reach = 40.0 * np.tan(angle)
    cameras = np.stack([reach * np.cos(azimuth), reach * np.sin(azimuth), 0.0 * azimuth + 40.0], axis=-1)
    points, misses = networks.meeting_points(cameras, np.zeros((1, 12, 3)), np.ones((1, 12), bool))
    np.testing.assert_allclose(points, [[0.0, 0.0, 0.0]], atol=1e-12)
    # Aimed at the surface 30 degrees off nadir, the ring sees a point 2 m down at its sagittal depth.
    inside = 2.0 * np.tan(np.arcsin(np.sin(angle) / N)) * np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], -1)
    points, misses = networks.meeting_points(cameras + inside, inside[None], np.ones((1, 12), bool))
    np.testing.assert_allclose(points, [[0.0, 0.0, -apparent_depth(2.0, angle, n_water=N)]], atol=1e-12)
    assert misses < 1e-12


def test_the_errors_of_both_networks_are_those_that_the_page_states(networks, page):
    nadir_m, oblique_px = (
        float(re.search(pattern, page)[1]) for pattern in (r"wrong by ([\d.]+) m", r"at ([\d.]+) px")
    )
    water = FlatWater((0.0, 0.0, 0.0), n_water=N)
    grid = np.linspace(-10.0, 10.0, 21)
    places = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    error, miss = networks.error_map(networks.nadir_block(), water, places)
    assert error.mean() == pytest.approx(nadir_m, abs=0.01)
    # "Within a quarter of a pixel"; a coarse grid weighs the rim, where they miss most, more than the picture does.
    assert miss.mean() == pytest.approx(0.25, abs=0.02)
    error, miss = networks.error_map(networks.convergent_block(), water, places)
    assert miss.mean() == pytest.approx(oblique_px, abs=0.1)


def test_the_small_angle_correction_fails_where_the_page_says(page):
    angles = re.search(
        r"good to 1 % of the depth up to (\d+)° or (\d+)° of incidence and 5 % off at (\d+)° or (\d+)°", page
    )
    expected = dict(zip(((1, 0), (1, 1), (5, 0), (5, 1)), map(float, angles.groups()), strict=True))
    for (percent, kind), degrees in expected.items():
        depth = (apparent_depth, apparent_depth_tangential)[kind]
        errors = [1.0 - N * depth(1.0, np.radians(degrees + k), n_water=N) for k in (-0.5, 0.5)]
        assert errors[0] < percent / 100.0 < errors[1]
