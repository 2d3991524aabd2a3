"""The figures that docs/gallery.md states, against the code that draws its pictures."""

import re
from pathlib import Path

import gallery_matching as networks
import numpy as np
import pytest

from refract import FlatWater, apparent_depth, apparent_depth_tangential, trace

ROOT = Path(__file__).resolve().parent.parent
N = 1.333


@pytest.fixture(scope="module")
def page() -> str:
    return " ".join((ROOT / "docs" / "gallery.md").read_text(encoding="utf-8").split())


def test_straight_rays_of_a_ring_meet_at_the_sagittal_image():
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


def test_the_errors_of_both_networks_are_those_that_the_page_states(page):
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
        r"good to 1 % of the depth up to (\d+)° or (\d+)° of incidence, and 5 % off at (\d+)° or (\d+)°", page
    )
    expected = dict(zip(((1, 0), (1, 1), (5, 0), (5, 1)), map(float, angles.groups()), strict=True))
    for (percent, kind), degrees in expected.items():
        depth = (apparent_depth, apparent_depth_tangential)[kind]
        errors = [1.0 - N * depth(1.0, np.radians(degrees + k), n_water=N) for k in (-0.5, 0.5)]
        assert errors[0] < percent / 100.0 < errors[1]


def test_curves_colours_and_errors_of_the_water_are_those_of_the_page(page):
    bent, straight = networks.epipolar_places()
    beside = networks.beside_line(bent, straight)
    assert "2 px from the line at a depth of 2 m and 4 px at 4 m" in page
    np.testing.assert_allclose(np.interp([2.0, 4.0], networks.DEPTHS, beside), [2.0, 4.0], atol=0.5)
    assert "0.4 px and 0.2 px beside green" in page
    degrees = np.linspace(0.0, 40.0, 201)
    shifts = [abs(networks.colour_shift_px(np.radians(degrees), 4.0, nm)[100]) for nm in (470.0, 610.0)]
    np.testing.assert_allclose(shifts, [0.4, 0.2], atol=0.05)
    by_level, by_index = networks.depth_errors(np.array([0.01, 30.0]), 3.0)
    assert "1.7 cm too low under the camera and 2.1 cm at 30°" in page
    np.testing.assert_allclose(100.0 * by_level, [1.7, 2.1], atol=0.05)
    assert "by 0.75 % of the depth and 0.87 % at 30°" in page
    np.testing.assert_allclose(100.0 * by_index / 3.0, [0.75, 0.87], atol=0.005)


def test_errors_of_a_level_are_those_of_rays_through_the_water_that_is_assumed():
    true, assumed = FlatWater((0.0, 0.0, 0.0), n_water=N), FlatWater((0.0, 0.0, 0.05), n_water=N)
    ray = np.array([np.sin(0.4), 0.0, -np.cos(0.4)])
    place = trace(np.array([0.0, 0.0, 20.0]), ray, true).at_height(np.array(-3.0), true)[0]
    path = trace(np.array([0.0, 0.0, 20.0]), ray, assumed)
    # The height over the assumed water at which the ray is over the place.
    heights = np.linspace(-3.2, -2.8, 4001)
    east = path.at_height(heights[:, None], assumed)[..., 0].ravel()
    found = np.interp(place, east[::-1], heights[::-1]) if east[0] > east[-1] else np.interp(place, east, heights)
    by_level, _ = networks.depth_errors(np.degrees([0.4]), 3.0)
    # Heights count from the water.
    assert -3.0 - (found + 0.05) == pytest.approx(by_level[0], abs=2e-4)
