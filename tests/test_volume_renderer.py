"""Rendering of volumes with known answers: fog of constant density, an opaque bed under water, water and backdrop."""

import numpy as np
import pytest
import torch
from test_volume_paths import whole
from torch import nn
from volume_scenes import BOX, WATER, Backdrop, Slab, looking_down

from fields.image_store import GAMMA
from fields.volume.renderer import VolumeRenderer, render_volume
from fields.volume.sampling import Cells
from fields.water_column import WaterColumn

# Colours are looked up above a weight of 1 %, and the rest takes their mean: of one colour nothing is lost.
ROUNDING = 2e-6
BLACK = Backdrop((0.0, 0.0, 0.0))


def seen(renderer: VolumeRenderer, camera, water, num=64, **options):
    paths = whole(camera, water)
    return paths, renderer.render(paths, Cells.everywhere(BOX, 8).samples(paths, num, jitter=False), **options)


@pytest.mark.parametrize("water", [None, WATER])
@pytest.mark.parametrize("num", [4, 64])
def test_constant_fog_hides_what_its_thickness_says(water, num):
    paths, rendered = seen(VolumeRenderer(Slab(0.8), background=BLACK), looking_down(tilt=0.3), water, num)
    expected = 1.0 - torch.exp(-0.8 * (paths.far - paths.near))
    torch.testing.assert_close(rendered.opacity, expected, rtol=1e-5, atol=ROUNDING)


def test_fog_of_one_colour_over_a_backdrop_mixes_the_two_in_linear_light():
    renderer = VolumeRenderer(Slab(0.8), background=Backdrop((1.0, 0.5, 0.0)))
    paths, rendered = seen(renderer, looking_down(), None, 16)
    opacity = rendered.opacity[:, None]
    behind = torch.tensor([1.0, 0.5, 0.0]) ** GAMMA
    expected = opacity * torch.tensor([0.2, 0.4, 0.6]) + (1.0 - opacity) * behind
    torch.testing.assert_close(rendered.rgb, expected.clamp(min=1e-4) ** (1.0 / GAMMA), rtol=1e-4, atol=1e-4)
    assert (paths.far > paths.near).all()


@pytest.mark.parametrize("water", [None, WATER])
def test_the_median_depth_of_an_opaque_bed_is_where_the_bent_path_meets_it(water):
    camera = looking_down(tilt=0.3)
    paths, rendered = seen(VolumeRenderer(Slab(2e3, top=-1.4), background=BLACK), camera, water, 256)
    points = paths.at(rendered.depth[:, None])[:, 0]
    under = (points[:, :2].abs() < 0.98).all(dim=1) & (rendered.opacity > 0.5)
    step = float((paths.far - paths.near).max()) / 256
    assert under.float().mean() > 0.25
    # The first sample inside is anywhere in the first piece, and takes its weight in the middle of it.
    assert float((points[under, 2] + 1.4).abs().max()) < step
    expected = camera.paths(camera.pixel_centres().reshape(-1, 2), water).at_height(np.full(len(paths), -1.4), water)
    assert np.abs(points[under, :2].numpy() - expected[under.numpy(), :2]).max() < step


def test_water_takes_light_by_the_length_of_the_bent_path_and_dry_leaves_it_out():
    column = WaterColumn()
    renderer = VolumeRenderer(Slab(1e4), column=column, background=BLACK)
    paths, wet = seen(renderer, looking_down(tilt=0.3), WATER, 512)
    length = (paths.near - paths.crossing)[:, None]
    kept = torch.exp(-column.absorption * length)
    veil, sky = nn.functional.softplus(column.raw_veil), nn.functional.softplus(column.raw_sky)
    r = paths.reflectance[:, None]
    hit = paths.far > paths.near + 0.05
    assert hit.float().mean() > 0.3
    expected = (1.0 - r) * (kept * torch.tensor([0.2, 0.4, 0.6]) + (1.0 - kept) * veil) + r * sky
    torch.testing.assert_close(wet.rgb[hit], expected.detach()[hit] ** (1.0 / GAMMA), rtol=2e-3, atol=0)
    _, dry = seen(renderer, looking_down(tilt=0.3), WATER, 512, dry=True)
    colour = (torch.tensor([0.2, 0.4, 0.6]) ** (1.0 / GAMMA)).expand_as(dry.rgb[hit])
    torch.testing.assert_close(dry.rgb[hit], colour, rtol=1e-4, atol=1e-4)


def test_a_given_water_counts_the_way_down_too():
    given = WaterColumn(absorption=(0.3, 0.1, 0.05), veil=(0.0, 0.0, 0.0))
    renderer = VolumeRenderer(Slab(1e4), column=given, background=BLACK)
    paths, wet = seen(renderer, looking_down(tilt=0.3), WATER, 512)
    hit = paths.far > paths.near + 0.05
    top = paths.at(paths.near[:, None])[:, 0]
    way = (paths.near - paths.crossing) - top[:, 2]
    r = paths.reflectance[:, None]
    kept = torch.exp(-given.absorption * way[:, None])
    expected = (1.0 - r) * kept * torch.tensor([0.2, 0.4, 0.6]) + r * given.sky
    torch.testing.assert_close(wet.rgb[hit], expected.detach()[hit] ** (1.0 / GAMMA), rtol=2e-3, atol=0)


def test_without_a_background_all_light_comes_from_the_box():
    paths, rendered = seen(VolumeRenderer(Slab(0.8)), looking_down(tilt=0.3), None, 16)
    _, over_black = seen(VolumeRenderer(Slab(0.8), background=BLACK), looking_down(tilt=0.3), None, 16)
    torch.testing.assert_close(rendered.opacity, (paths.far > paths.near).float())
    assert torch.equal(rendered.weights[:, :-1], over_black.weights[:, :-1])


def test_paths_beside_the_box_show_the_backdrop():
    renderer = VolumeRenderer(Slab(1e4), background=Backdrop((0.3, 0.6, 0.9)))
    view = render_volume(renderer, looking_down(tilt=np.pi), None, Cells.everywhere(BOX, 8), samples=8)
    np.testing.assert_allclose(view.rgb, np.broadcast_to([0.3, 0.6, 0.9], view.rgb.shape), rtol=1e-5)
    assert (view.opacity == 0.0).all()
    assert np.isnan(view.distance).all()
    assert np.isnan(view.points).all()
    without = render_volume(
        VolumeRenderer(Slab(1e4)), looking_down(tilt=np.pi), None, Cells.everywhere(BOX, 8), samples=8
    )
    assert (without.opacity == 0.0).all()


def test_a_rendered_view_does_not_depend_on_its_chunks():
    renderer, camera = VolumeRenderer(Slab(2.0, top=-1.2), column=WaterColumn()), looking_down(tilt=0.2)
    cells = Cells.everywhere(BOX, 8)
    one, other = (render_volume(renderer, camera, WATER, cells, samples=32, chunk=chunk) for chunk in (100, 10_000))
    np.testing.assert_array_equal(one.distance, other.distance)
    np.testing.assert_allclose(one.rgb, other.rgb, atol=1e-6)


def test_normals_of_a_density_that_falls_upwards_point_up():
    class Ramp(Slab):
        def evaluate(self, x):
            return 5.0 - 2.0 * x[:, 2] + 0.5 * x[:, 0], x

    x = torch.tensor([[0.1, 0.2, -1.0], [0.0, 0.0, -1.5]])
    up = torch.tensor([-0.5, 0.0, 2.0]) / 4.25**0.5
    torch.testing.assert_close(Ramp(1.0).normals(x, 0.01), up.expand(2, 3), rtol=1e-3, atol=1e-3)
    assert (Slab(1.0).normals(x, 0.01) == 0.0).all()
