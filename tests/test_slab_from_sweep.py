"""What the sweep leaves to the field: the slab about its heights, and which rays are drawn into it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from plane_field import plane_sources
from plane_survey import TILTED, PlaneBed, ring

from fields.slab.from_sweep import draw_rays, slab_of

BED = PlaneBed(TILTED, -2.0, 0.1)
GSD = 0.03


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
