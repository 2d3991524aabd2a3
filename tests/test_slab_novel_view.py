"""Rendering a field from cameras that it was not trained with: where it is met, how far away, which way it faces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from plane_field import field_over, level_slab
from plane_survey import TILTED, PlaneBed, look

from fields.device import choose_device
from fields.slab.novel_view import SlabSurface, rays_on, render_view
from fields.slab.rays import rays_of

DRY = PlaneBed(None, -2.0, 0.1)
WET = PlaneBed(TILTED, -2.0, 0.1)


@pytest.fixture(scope="module")
def camera():
    return look((1.0, 1.2, 9.0), (0.1, 0.1, -2.0), size=(48, 36), focal=400.0)


def untrained(bed: PlaneBed, **settings):
    """A field that is its proxy: the bed over the water plane, to first order in the slopes."""
    water = bed.water
    slope_x, slope_y, level, length = 0.0, 0.0, 0.0, 1.0
    if water is not None:
        slope_x, slope_y, length = water.slope_x, water.slope_y, np.sqrt(1.0 + water.slope_x**2 + water.slope_y**2)
        level = water.point[2] - water.slope_x * water.point[0] - water.slope_y * water.point[1]
    slab = level_slab((bed.level - level) / length, slope_x=(bed.slope - slope_x) / length)
    y = 0.1 * (np.arange(80) - 39.5)
    slab.proxy -= (slope_y * y / length).astype(np.float32)[:, None]
    return field_over(slab, choose_device("torch"), water=water is not None, **settings)


@pytest.mark.parametrize("bed", [DRY, WET], ids=["dry", "wet"])
def test_a_bed_is_met_where_it_is_at_its_distance_and_faces_up_its_normal(bed, camera):
    view = render_view(untrained(bed), camera, bed.water)
    truth = bed.true_height(camera)
    path = camera.paths(camera.pixel_centres(), bed.water)
    points = path.at_height(truth, bed.water)
    below = np.nan_to_num(np.linalg.norm(points - path.crossing, axis=-1))
    distance = np.where(path.wet, path.air_length + below, np.linalg.norm(points - camera.centre, axis=-1))
    assert view.seen.all()
    # A proxy in float32 [m], met to a thousandth of a cell of 0.1 m; medians lie between samples of 2.5 cm.
    np.testing.assert_allclose(view.bed_height, truth, atol=5e-4)
    np.testing.assert_allclose(view.distance, distance, atol=6e-4)
    normal = np.array([-bed.slope, 0.0, 1.0]) / np.sqrt(1.0 + bed.slope**2)
    np.testing.assert_allclose(view.normal, np.broadcast_to(normal, view.normal.shape), atol=1e-3)


def test_without_its_water_a_bed_stays_where_it_is_and_is_seen_along_straight_rays(camera):
    field = untrained(WET)
    wet, dry = (render_view(field, camera, WET.water, dry=d) for d in (False, True))
    straight = camera.paths(camera.pixel_centres(), None)
    points = camera.centre + dry.distance[..., None] * straight.air_direction
    np.testing.assert_allclose(points[..., 2], WET.level + WET.slope * points[..., 0], atol=1e-3)
    assert np.abs(wet.bed_height - dry.bed_height).max() > 0.005  # a tilted bed, met elsewhere
    # Untrained, the column takes light of red most and reflects some.
    assert (wet.rgb.mean(axis=(0, 1)) != dry.rgb.mean(axis=(0, 1))).any()


def test_a_view_over_the_edge_shows_nothing_there_and_one_of_the_sky_nothing():
    field = untrained(DRY)
    edge = render_view(field, look((4.0, 0.0, 8.0), (4.0, 0.0, -2.0), size=(40, 30), focal=200.0), None)
    assert edge.seen[:, :15].all()
    assert not edge.seen[:, 25:].any()
    assert not edge.rgb[~edge.seen].any()
    assert np.isnan(edge.normal[~edge.seen]).all()
    up = render_view(field, look((0.0, 0.0, 8.0), (0.5, 0.0, 20.0), size=(8, 6)), None)
    assert not up.seen.any()


def test_the_first_of_two_meetings_is_shown():
    field = untrained(DRY)
    wall = field.slab.proxy.copy()
    wall[:, 30:34] += 1.5
    field.slab.proxy = wall
    camera = look((-4.0, 0.0, 2.5), (0.0, 0.0, -2.0), size=(60, 45), focal=120.0)
    view = render_view(field, camera, None)
    level = view.bed_height[view.seen]
    assert ((level > -1.0) & (level < -0.3)).any()
    # The line of sight over the wall, 1.5 m high at x = -0.7, comes down again at x = 0.9.
    rays = camera.paths(camera.pixel_centres(), None)
    x = (rays.origin + view.distance[..., None] * rays.air_direction)[..., 0]
    assert not (view.seen & (view.bed_height < -1.7) & (x > -0.6) & (x < 0.7)).any()


def test_gaps_are_closed_and_wide_holes_stay_open(camera):
    field = untrained(DRY)
    field.slab.known[40:44, 40:44] = False
    assert render_view(field, camera, None).seen.all()
    field.slab.known[30:50, 30:50] = False
    assert not render_view(field, camera, None).seen.all()


def test_strides_end_where_single_steps_would(rng):
    field = untrained(DRY)
    field.slab.proxy = field.slab.proxy + (0.3 * rng.random((80, 80))).astype(np.float32)
    camera = look((-4.0, 0.0, 2.5), (0.0, 0.0, -2.0), size=(60, 45), focal=120.0)
    pixels = camera.pixel_centres().reshape(-1, 2)
    none = np.zeros(len(pixels))
    rays = rays_of(camera, None, pixels, none, np.zeros((len(pixels), 3)))
    surface = SlabSurface.of_slab(field.slab)
    found = [rays_on(s, rays) for s in (surface, replace(surface, ceiling=np.full_like(surface.ceiling, 9.0)))]
    np.testing.assert_array_equal(found[0][1], found[1][1])
    assert len(found[0][1]) > 1000
    # Halvings end within a thousandth of a step of 0.05 m, begun where roundings of other sums let them.
    torch.testing.assert_close(found[0][0].height, found[1][0].height, atol=1e-4, rtol=0.0)
