"""Training rays: where they stand in both media, where they meet the proxy, and what the surface reflects."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from plane_field import level_slab, plane_sources, rays_at
from plane_survey import TILTED, PlaneBed, look, ring

from fields.slab.rays import MEETING_STEPS, SlabRays, draw_rays, rays_of, slab_of
from refract import FlatWater

N = 1.333
# Local coordinates of 10 m, a foot and a slope in float32; measured 1.2e-6 m.
POINT_M = 3e-6
WATERS = {
    "tilted": TILTED,
    "level": FlatWater((0.0, 0.0, 0.4), n_water=N),
    "dry": None,
    "index one": FlatWater((0, 0, 0), n_water=1.0),
}
BED = PlaneBed(TILTED, -2.0, 0.1)
GSD = 0.03


def pixels_of(camera) -> np.ndarray:
    return camera.pixel_centres()[::9, ::9].reshape(-1, 2)


@pytest.mark.parametrize("water", WATERS.values(), ids=WATERS.keys())
def test_rays_stand_where_bent_paths_stand(water, rng):
    for camera, tide in zip(ring(3), (0.0, 0.3, -0.2, 0.0), strict=True):
        camera = replace(camera, tide=tide)
        rays = rays_at(PlaneBed(water, -2.0), camera, 0.0, step=9)
        heights = rng.uniform(-3.0, 3.0, (len(rays), 5))
        path = camera.paths(pixels_of(camera), water)
        truth = np.stack([path.at_height(heights[:, k], water) for k in range(5)], axis=1)
        np.testing.assert_allclose(rays.at(torch.from_numpy(heights).float()), truth, atol=POINT_M)
        np.testing.assert_allclose(rays.at(torch.from_numpy(heights[:, 0]).float()), truth[:, 0], atol=POINT_M)


@pytest.mark.parametrize("water", [TILTED, None])
def test_slopes_measure_the_path_per_metre_of_height(water):
    camera = ring(2)[1]
    rays = rays_at(PlaneBed(water, -2.0), camera, 0.0, step=9)
    path = camera.paths(pixels_of(camera), water)
    normal = np.array((0.0, 0.0, 1.0) if water is None else water.up)
    above = rays.slope(torch.full((len(rays),), 0.5)).norm(dim=-1)
    below = rays.slope(torch.full((len(rays),), -0.5)).norm(dim=-1)
    np.testing.assert_allclose(above, -1.0 / (path.air_direction @ normal), rtol=1e-6)
    np.testing.assert_allclose(below, -1.0 / (path.water_direction @ normal), rtol=1e-6)


def test_rays_cross_the_surface_without_a_step():
    rays = rays_at(PlaneBed(TILTED, -2.0), ring(2)[1], 0.0)
    at = {z: rays.at(torch.full((len(rays),), z)) for z in (-1e-4, 0.0, 1e-4)}
    for z in (-1e-4, 1e-4):  # 23 degrees off nadir, 1.1e-4 m of path
        assert (at[z] - at[0.0]).norm(dim=1).max() < 1.3e-4 + POINT_M
    assert np.abs(TILTED.depth(at[0.0].numpy().astype(float))).max() < POINT_M


@pytest.mark.parametrize(("slope_x", "left"), [(0.0, 0.0), (0.1, 3e-4), (-0.4, 2e-3)])
def test_rays_meet_a_sloped_proxy(slope_x, left):
    """``left`` [m] is what the steps leave of 6 cm, the most that rays inside a slab are off by."""
    bed = PlaneBed(None, -2.0, slope_x)
    slab = level_slab(-2.0, slope_x=slope_x)
    for camera in ring(4):
        truth = bed.true_height(camera)[::7, ::7].ravel()
        for off in (0.06, -0.06):
            rays = rays_at(bed, camera, (truth + off).astype(np.float32))
            assert np.abs(rays.meet(slab).numpy() - truth).max() < left + 2 * POINT_M


def test_steps_to_the_proxy_contract_as_the_slopes_say():
    bed, camera = PlaneBed(None, -2.0, 0.3), look((4.0, 0.0, 8.0), (0.0, 0.0, -2.0))
    slab = level_slab(-2.0, slope_x=0.3)
    truth = bed.true_height(camera)[::7, ::7].ravel()
    rays = rays_at(bed, camera, (truth + 0.06).astype(np.float32))
    along = 0.3 * rays.air[:, 0].double().numpy()  # rise of the proxy per metre of height along the ray
    expected = 0.06 * along * (0.5 + 0.5 * along) ** (MEETING_STEPS - 1)
    np.testing.assert_allclose(rays.meet(slab).numpy() - truth, expected, atol=4 * POINT_M)


def test_colours_and_reflectance_come_with_the_rays():
    camera = ring(2)[1]
    pixels = pixels_of(camera)
    rgb = np.tile(np.array([0, 51, 255], np.uint8), (len(pixels), 1))
    height = np.full(len(pixels), -1.25, np.float32)
    wet, dry = (rays_of(camera, water, pixels, height, rgb) for water in (TILTED, None))
    torch.testing.assert_close(wet.rgb[0], torch.tensor([0.0, 0.2, 1.0]))
    assert (wet.height == -1.25).all()
    assert not dry.reflectance.any()
    path = camera.paths(pixels, TILTED)
    normal = np.array(TILTED.up)
    for found, air in zip(wet.reflectance.numpy(), -(path.air_direction @ normal), strict=True):
        assert found == pytest.approx(reflectance_in_angles(math.acos(air), TILTED.n_water), rel=1e-5)


def reflectance_in_angles(angle: float, n: float) -> float:
    """Fresnel's sine and tangent laws, averaged over the polarisations."""
    other = math.asin(math.sin(angle) / n)
    s = (math.sin(angle - other) / math.sin(angle + other)) ** 2
    p = (math.tan(angle - other) / math.tan(angle + other)) ** 2
    return 0.5 * (s + p)


def test_rays_are_taken_apart_and_put_together():
    rays = rays_at(PlaneBed(TILTED, -2.0), ring(2)[1], -1.0)
    even, odd = rays[0 : len(rays) : 2], rays[torch.arange(1, len(rays), 2)]
    both = SlabRays.concatenate([even, odd])
    assert len(both) == len(rays)
    assert torch.equal(both.foot[: len(even)], rays.foot[::2])
    assert torch.equal(both.reflectance[len(even) :], rays.reflectance[1::2])


@pytest.fixture(scope="module")
def cameras():
    return ring(4)


def test_the_slab_spans_the_heights_inside_the_area_with_room_for_their_noise(cameras):
    sources = plane_sources(BED, cameras, noise=0.01)
    slab = slab_of(sources, GSD, (-0.3, -0.2, 0.3, 0.4))
    assert slab.cell == GSD
    assert slab.half == pytest.approx(2.0 * GSD)  # a spread of 5 mm asks for 1.5 cm
    np.testing.assert_allclose(slab.low, [-0.33, -0.23], atol=GSD)
    np.testing.assert_allclose(slab.size[:2], [0.66, 0.66], atol=2.5 * GSD)
    rows, columns = np.nonzero(slab.known)
    x, y = slab.low[0] + GSD * (columns + 0.5), slab.low[1] + GSD * (rows + 0.5)
    truth = -TILTED.depth(np.stack([x, y, BED.level + BED.slope * x], axis=-1))
    # Medians of heights that err by 1 cm each: better than one of them, and none off by more than five deviations.
    errors = slab.proxy[rows, columns] - truth
    assert errors.std() < 0.01
    assert np.abs(errors).max() < 0.05
    wide = [replace(m, spread=np.full_like(m.spread, 0.03)) for m in sources.maps]
    assert slab_of(replace(sources, maps=wide), GSD, None).half == pytest.approx(0.09)


def test_rays_are_drawn_from_trusted_pixels_inside_the_image_evenly_over_the_views(cameras, rng):
    sources = plane_sources(BED, cameras[:3])
    slab = slab_of(sources, GSD, None)
    rows, columns = sources.maps[0].height.shape
    maps, images = [], []
    for number, m in enumerate(sources.maps):
        agreeing = np.zeros((rows + 8, columns + 4), dtype=np.uint8)  # padded to a larger image
        agreeing[number * rows // 4 :] = 3
        padded = {
            name: np.pad(getattr(m, name), ((0, 8), (0, 4)), mode="edge") for name in ("height", "score", "spread")
        }
        maps.append(replace(m, agreeing=agreeing, **padded))
        image = np.zeros((rows, columns, 3), dtype=np.uint8)
        image[number * rows // 4 :] = 85 * (number + 1)
        images.append(image)
    rays = draw_rays(replace(sources, maps=maps, images=images), slab, 9000, rng)
    view = torch.round(3.0 * rays.rgb[:, 0])
    assert (view > 0).all()  # a pixel above the trusted rows would be black
    counts = np.array([int((view == v).sum()) for v in (1, 2, 3)])
    np.testing.assert_allclose(counts / 9000, np.array([4, 3, 2]) / 9, atol=0.02)
    assert abs(len(rays) - 9000) < 200


def test_rays_whose_own_height_leaves_the_slab_are_left_out(cameras, rng):
    sources = plane_sources(BED, cameras)
    slab = slab_of(sources, GSD, None)
    for share, kept in ((0.6, True), (0.8, False)):
        maps = [replace(m, height=m.height + np.float32(share * slab.half)) for m in sources.maps]
        some = replace(sources, maps=[maps[0], *sources.maps[1:]])
        drawn = draw_rays(some, slab, 4000, rng)
        of_first = 4000 // len(cameras)
        assert len(drawn) == pytest.approx(4000 if kept else 4000 - of_first, abs=20)


def test_without_a_confirmed_height_there_is_no_slab(cameras):
    sources = plane_sources(BED, cameras)
    alone = [replace(m, agreeing=np.zeros_like(m.agreeing)) for m in sources.maps]
    with pytest.raises(ValueError, match="no confirmed height lies inside the area"):
        slab_of(replace(sources, maps=alone), GSD, None)
    with pytest.raises(ValueError, match="no confirmed height lies inside the area"):
        slab_of(sources, GSD, (50.0, 50.0, 60.0, 60.0))
