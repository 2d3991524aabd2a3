"""The surface of a volume: where paths meet it by each rule, and what photographs agree on."""

import numpy as np
import pytest
import torch
from volume_scenes import BOX, WATER, Slab, looking_down

from fields.models import Rule
from fields.volume.paths import paths_of
from fields.volume.photographs import Photographs, pixels_over
from fields.volume.renderer import VolumeRenderer
from fields.volume.sampling import Cells
from fields.volume.surface import distance_of, points_on_surface, surface_of

TOP = -1.4
# Light falls to half within 7 mm of this.
DENSE = 100.0


def photographs(num: int, water) -> Photographs:
    cameras = [looking_down(x=0.2 * k, tilt=0.1 * k) for k in range(num)]
    grey = [np.full((c.height, c.width, 3), 40 * (k + 1), dtype=np.uint8) for k, c in enumerate(cameras)]
    return Photographs(cameras, grey, [pixels_over(camera, BOX, water) for camera in cameras], water)


@pytest.mark.parametrize("water", [None, WATER])
@pytest.mark.parametrize("rule", list(Rule))
def test_each_rule_finds_the_top_of_a_dense_layer(rule, water):
    renderer, shown = VolumeRenderer(Slab(DENSE, top=TOP)), photographs(1, water)
    pixels = shown.cameras[0].pixel_centres().reshape(-1, 2)[shown.pixels[0]]
    paths = paths_of(shown.cameras[0], water, pixels, np.zeros((len(pixels), 3)), BOX)
    # 1.5 m in 300 samples: 5 mm a sample, a little more on slanting paths.
    rendered = renderer.render(paths, Cells.everywhere(BOX, 16).samples(paths, 300, jitter=False))
    distance = distance_of(rendered, rule, 0.5 * DENSE)
    height = paths.at(distance[:, None])[:, 0, 2].numpy()
    assert np.isfinite(height).all()
    assert np.abs(height - TOP).max() < 0.02


@pytest.mark.parametrize("rule", list(Rule))
def test_fog_and_emptiness_have_no_surface(rule):
    camera = looking_down()
    pixels = camera.pixel_centres().reshape(-1, 2)
    paths = paths_of(camera, None, pixels, np.zeros((len(pixels), 3)), BOX)
    samples = Cells.everywhere(BOX, 16).samples(paths, 50, jitter=False)
    for density in (0.0, 0.1):
        assert not torch.isfinite(distance_of(VolumeRenderer(Slab(density)).render(paths, samples), rule, 1.0)).any()


@pytest.mark.parametrize("water", [None, WATER])
def test_a_surface_is_the_mean_of_the_photographs_that_agree(water):
    shown = photographs(3, water)
    cells = Cells.everywhere(BOX, 16)
    points = points_on_surface(VolumeRenderer(Slab(DENSE, top=TOP)), shown, cells, samples=150)
    surface = surface_of(points, BOX, 0.25)
    assert len(surface.xyz) > 20
    assert np.abs(surface.xyz[:, 2] - TOP).max() < 0.02
    assert set(surface.num_views) <= {2, 3}
    assert surface.std.max() < 0.01
    # Each photograph counts once, however many of its pixels a cell has.
    everywhere = surface.rgb[surface.num_views == 3]
    np.testing.assert_array_equal(everywhere, 80)
    assert 0.0 <= surface.incidence.min() < surface.incidence.max() < 0.6


def test_one_photograph_alone_has_no_surface():
    renderer, cells = VolumeRenderer(Slab(DENSE, top=TOP)), Cells.everywhere(BOX, 16)
    points = list(points_on_surface(renderer, photographs(1, WATER), cells, samples=60))
    assert len(points[0])
    assert len(surface_of(points, BOX, 0.25).xyz) == 0


def test_sums_over_photographs_give_their_mean_and_the_spread_of_their_heights(rng):
    heights = rng.normal(-1.4, 0.01, 5)
    parts = [np.array([[0.1, 0.1, z, 10.0 * k, 0.0, 0.0, 0.1 * k]] * (k + 1)) for k, z in enumerate(heights)]
    surface = surface_of(iter(parts), BOX, 10.0)
    np.testing.assert_allclose(surface.xyz, [[0.1, 0.1, heights.mean()]], rtol=1e-12)
    np.testing.assert_allclose(surface.std, heights.std(ddof=1) / np.sqrt(5.0), rtol=1e-6)
    assert (surface.rgb.tolist(), surface.num_views.tolist()) == ([[20, 0, 0]], [5])
