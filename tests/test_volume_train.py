"""Training of volumes from photographs of a painted bed under water: it is found; what is drawn is what is there."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
import torch
from volume_models import Interrupted, Kept
from volume_scenes import BOX, WATER, Slab, bed_photographs, looking_down

from fields.device import choose_device
from fields.volume.photographs import Photographs
from fields.volume.renderer import VolumeRenderer, render_volume
from fields.volume.sampling import Cells
from fields.volume.tensor import TensorSettings, TensorVolume
from fields.volume.train import (
    POOL_STEPS,
    Training,
    proxy_of,
    train_volume,
)

BED_M = -1.5
SMALL = {"n_min": 8, "n_max": 32, "channels": 4, "degree": 0, "hidden": 16, "switch_window": 20}


def quietly(share: float, errors: list[float]) -> None:
    """Progress that nobody looks at."""


def tensor_renderer(**changes) -> VolumeRenderer:
    torch.manual_seed(0)  # of the heads
    return VolumeRenderer(TensorVolume(BOX, TensorSettings(**(SMALL | changes)), choose_device("cpu")))


def heights(renderer: VolumeRenderer, cells: Cells, photographs) -> np.ndarray:
    """Of the bed as the first view sees it, at the pixels that show it."""
    camera, pixels = photographs.cameras[0], photographs.pixels[0]
    view = render_volume(renderer, camera, photographs.water, cells, samples=64)
    return view.points.reshape(-1, 3)[pixels, 2]


# Over five seeds the median height is 7 to 73 mm off, half of the heights lie within 32 to 79 mm, and colours agree to
# 32 to 37 dB; the finest cells measure 62 mm. An even grey has 14 dB.
SHORT = Training(steps=300, rays=384, samples=24, cells=32, refresh=(0.6,))


@pytest.mark.slow
def test_training_finds_a_bed_under_water_from_nothing_coarse_to_fine():
    photographs = bed_photographs(BED_M, views=9)
    renderer, shares = tensor_renderer(), []
    cells, figures = train_volume(renderer, photographs, SHORT, lambda share, errors: shares.append(share))
    found = heights(renderer, cells, photographs)
    cell = BOX.edge / 32
    assert abs(np.median(found) - BED_M) < cell
    assert np.median(np.abs(found - BED_M)) < 1.5 * cell
    assert figures.psnr_db > 30.0
    assert cells.occupied.float().mean() < 0.8
    assert (len(shares), shares[-1]) == (300, 1.0)
    assert len(figures.changed_at) == 1


@pytest.mark.slow
def test_without_water_the_same_photographs_put_the_bed_too_high():
    photographs = bed_photographs(BED_M, views=9)
    renderer = tensor_renderer()
    photographs.water = None
    cells, _ = train_volume(renderer, photographs, SHORT, quietly)
    # At small angles depth appears divided by the index: 1.5 m as 1.13 m.
    assert np.median(heights(renderer, cells, photographs)) == pytest.approx(BED_M / WATER.n_water, abs=0.06)


def test_paths_are_drawn_from_the_pixels_given_each_photograph_by_its_share():
    photographs = bed_photographs(views=3)
    photographs.pixels = [p[: 100 * (k + 1)] for k, p in enumerate(photographs.pixels)]
    paths = photographs.draw(6000, BOX, np.random.default_rng(0))
    counts = torch.bincount(paths.view) / 6000
    torch.testing.assert_close(counts, torch.tensor([1, 2, 3]) / 6, rtol=0, atol=0.03)
    for view in range(3):
        image = photographs.images[view].reshape(-1, 3)[photographs.pixels[view]] / 255.0
        drawn = paths.rgb[paths.view == view].numpy()
        known = {tuple(c) for c in image.astype(np.float32).tolist()}
        assert {tuple(c) for c in drawn.tolist()} <= known
    assert not (paths.view.diff() >= 0).all()


@pytest.mark.parametrize("water", [None, WATER])
def test_a_bed_in_a_box_is_seen_by_the_pixels_whose_path_leaves_through_the_floor(water):
    cameras = [looking_down(tilt=tilt, size=30) for tilt in (0.0, 0.4)]
    found = Photographs.over(cameras, [], BOX, water).pixels
    for camera, pixels in zip(cameras, found, strict=True):
        bent = camera.paths(camera.pixel_centres().reshape(-1, 2), water)
        floor = bent.at_height(np.full(900, BOX.low[2]), water)
        inside = (np.abs(floor[:, :2]) < 1.0).all(axis=1)
        near_an_edge = (np.abs(np.abs(floor[:, :2]) - 1.0) < 2e-3).any(axis=1)
        assert 100 < inside.sum() < 900
        chosen = np.isin(np.arange(900), pixels)
        np.testing.assert_array_equal(chosen[~near_an_edge], inside[~near_an_edge])


def test_an_interrupted_training_goes_on_to_the_same_volume():
    photographs = bed_photographs(views=3)
    # The model switches to weighted density at step 20; the proxy is renewed before and after the interruptions.
    training = Training(steps=36, rays=16, samples=6, cells=4, refresh=(0.5, 0.95))
    early = {"switch_window": 10, "switch_ratio": 1e9, "n_min": 4, "n_max": 8, "scales": 2}
    found = []
    for stop_at in (None, POOL_STEPS, POOL_STEPS + 3):
        kept = Kept(stop_at)
        for _ in range(2):
            renderer = tensor_renderer(**early)
            renderer.model.factors.device = choose_device("torch")
            with suppress(Interrupted):
                cells, figures = train_volume(renderer, photographs, training, quietly, seed=5, checkpoints=kept)
                break
            kept.stop_at = None
        found.append((renderer.state_dict(), cells, figures))
    first, first_cells, first_figures = found[0]
    assert first_figures.changed_at
    for state, cells, figures in found[1:]:
        assert figures == first_figures
        assert torch.equal(cells.occupied, first_cells.occupied)
        assert all(torch.equal(state[k], first[k]) for k in first if torch.is_tensor(first[k]))


def test_the_proxy_of_a_field_is_where_it_stops_light():
    cells = Cells.everywhere(BOX, 40)
    proxy = proxy_of(VolumeRenderer(Slab(100.0, top=BED_M)), cells, margin=0.04)
    z = cells.centres()[:, 2].view(cells.occupied.shape)
    assert proxy.occupied[z < BED_M].all()
    assert not proxy.occupied[z > BED_M + 0.1].any()
    fog = proxy_of(VolumeRenderer(Slab(1.0 / BOX.edge)), cells, margin=0.04)
    assert not fog.occupied.any()
