"""Epipolar curves through three exact points of the height hypotheses."""

import numpy as np
import pytest

from fields.device import choose_device
from fields.sweep.kernels.rays import (
    MOST_HYPOTHESES,
    fit_curve,
    point_at,
    point_on_curve,
    project_in_front,
    project_with_depth,
    refracted_rays,
    segments,
    straddling_pixels,
)
from fields.sweep.kernels.stack import CameraTerms, ViewStack, camera_table, kernel_water
from refract import FlatWater, PinholeCamera
from refract.curved import WavyWater

WATER = FlatWater((0.0, 0.0, 0.0))
WIDTH, HEIGHT = 1000, 750


def camera(place: np.ndarray, tilt: float, toward: float, focal: float) -> PinholeCamera:
    ahead = np.array([np.sin(tilt) * np.sin(toward), np.sin(tilt) * np.cos(toward), -np.cos(tilt)])
    right = np.array([np.cos(toward), -np.sin(toward), 0.0])
    axes = np.stack([right, np.cross(ahead, right), ahead])
    return PinholeCamera(place, axes, focal, focal, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def misses(water: FlatWater | None, span_px: float) -> np.ndarray:
    """How far [px] places on courses are from those of the points, in random pairs that look at one place."""
    rng, surface, found = np.random.default_rng(1), kernel_water(water), []
    for _ in range(200):
        height = rng.uniform(10.0, 60.0)
        depth, focal = rng.uniform(0.5, 0.4 * height), WIDTH * rng.uniform(0.8, 1.6)
        views = []
        for _ in range(2):
            tilt, toward = rng.uniform(0.0, 0.6), rng.uniform(0.0, 2.0 * np.pi)
            away = (height + depth) * np.tan(tilt) * np.array([np.sin(toward), np.cos(toward)])
            place = np.array([*rng.normal(0.0, 0.15 * height, 2) - away, height])
            views.append(camera(place, tilt, toward, focal))
        beyond = CameraTerms.of(views)
        own, other = camera_table(views, beyond, surface)
        rays = refracted_rays(own, rng.uniform(0, WIDTH, 30), rng.uniform(0, HEIGHT, 30), surface, beyond)

        def seen(z, rays=rays, other=other, beyond=beyond):
            return project_with_depth(other, point_at(rays, z), surface, beyond)

        bed = np.full(30, -depth)
        (u, v, _), (u_up, v_up, _) = seen(bed), seen(bed + 1e-3)
        span = span_px * 1e-3 / np.median(np.hypot(u_up - u, v_up - v))
        low = np.minimum(bed, -0.01 - span)
        three = [point_at(rays, low + share * span) for share in (0.0, 0.5, 1.0)]
        curve = fit_curve([project_in_front(other, point, surface, beyond) for point in three])
        for share in np.linspace(0.0, 1.0, 9):
            (u, v, depth_there), (u_on, v_on, inside) = seen(low + share * span), point_on_curve(curve, share, other)
            known = inside & (depth_there > 0.0)
            found.append(np.hypot(u_on - u, v_on - v)[known])
    return np.concatenate(found)


def test_straight_paths_are_courses_to_rounding():
    assert misses(None, 2.0 * MOST_HYPOTHESES).max() < 1e-9


def test_bent_paths_are_courses_to_a_hundredth_of_a_pixel():
    # Measured: 9e-6 px rms over 6 px; 1.2e-3 px rms and 0.022 px at most over as many hypotheses as a section has.
    assert np.sqrt(np.mean(misses(WATER, 6.0) ** 2)) < 1e-4
    found = misses(WATER, MOST_HYPOTHESES)
    assert np.sqrt(np.mean(found**2)) < 2e-3
    assert found.max() < 0.05


@pytest.mark.parametrize("count", [1, 3, MOST_HYPOTHESES, MOST_HYPOTHESES + 1, 360])
def test_hypotheses_fall_into_sections_of_like_length(count):
    parts = segments(count)
    assert [each for part in parts for each in part] == list(range(count))
    lengths = [len(part) for part in parts]
    assert max(lengths) <= MOST_HYPOTHESES
    assert max(lengths) - min(lengths) <= 1


def test_hypotheses_through_the_water_are_told_from_others():
    views = [camera(np.array([x, 0.0, 20.0]), 0.0, 0.0, 800.0) for x in (0.0, 5.0)]
    images = np.zeros((2, HEIGHT, WIDTH), dtype=np.float32)
    start, part = np.array([-2.0, -0.55, -0.45, 0.05]), range(2, 6)
    wet = ViewStack.build(choose_device("torch"), views, images, WATER)
    np.testing.assert_array_equal(straddling_pixels(wet, start, 0.1, part), [2])
    dry = ViewStack.build(choose_device("torch"), views, images, None)
    assert len(straddling_pixels(dry, start, 0.1, part)) == 0


@pytest.mark.parametrize("water", [None, FlatWater((0.0, 0.0, 0.0), n_water=1.0)])
def test_kernels_do_not_bend_rays_without_water_and_in_water_of_index_one(water):
    assert not kernel_water(water).is_refracting


def test_a_surface_that_no_kernel_is_written_for_is_named():
    with pytest.raises(TypeError, match="sweep and solver take FlatWater or None, got WavyWater"):
        kernel_water(WavyWater((0.0, 0.0, 0.0), (0.05,), ((1.0, 0.5),)))
