"""Training of volumes from photographs of a painted bed under water, and its parts."""

from contextlib import suppress

import numpy as np
import pytest
import torch
from torch import nn
from volume_models import Interrupted, Kept
from volume_scenes import BOX, WATER, Slab, bed_photographs, looking_down

from fields.device import choose_device
from fields.volume import train
from fields.volume.model import Rates, has_converged
from fields.volume.photographs import pixels_over
from fields.volume.renderer import VolumeRenderer, render_volume
from fields.volume.sampling import Cells
from fields.volume.tensor import TensorSettings, TensorVolume
from fields.water_column import WaterColumn

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
SHORT = train.Training(steps=300, rays=384, samples=24, cells=32, refresh=(0.6,))


@pytest.mark.slow
def test_training_finds_a_bed_under_water_from_nothing_coarse_to_fine():
    photographs = bed_photographs(BED_M, views=9)
    renderer, shares = tensor_renderer(), []
    cells, figures = train.train_volume(renderer, photographs, SHORT, lambda share, errors: shares.append(share))
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
    cells, _ = train.train_volume(renderer, photographs, SHORT, quietly)
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
    found = [pixels_over(camera, BOX, water) for camera in cameras]
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
    training = train.Training(steps=36, rays=16, samples=6, cells=4, refresh=(0.5, 0.95))
    early = {"switch_window": 10, "switch_ratio": 1e9, "n_min": 4, "n_max": 8, "scales": 2}
    found = []
    for stop_at in (None, train.POOL_STEPS, train.POOL_STEPS + 3):
        kept = Kept(stop_at)
        for _ in range(2):
            renderer = tensor_renderer(**early)
            renderer.model.factors.device = choose_device("torch")
            with suppress(Interrupted):
                cells, figures = train.train_volume(renderer, photographs, training, quietly, seed=5, checkpoints=kept)
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
    proxy = train.proxy_of(VolumeRenderer(Slab(100.0, top=BED_M)), cells, margin=0.04)
    z = cells.centres()[:, 2].view(cells.occupied.shape)
    assert proxy.occupied[z < BED_M].all()
    assert not proxy.occupied[z > BED_M + 0.1].any()
    fog = train.proxy_of(VolumeRenderer(Slab(1.0 / BOX.edge)), cells, margin=0.04)
    assert not fog.occupied.any()


def test_groups_move_by_their_share():
    bed, colour = (nn.Parameter(torch.zeros(1)) for _ in range(2))
    optimiser = train.adam([Rates([bed], 0.1), Rates([], 1.0), Rates([colour], 0.4)], eps=1e-15)
    train.set_rates(optimiser, 0.5)
    train.descend(optimiser, (bed - 1.0).square().sum() + (colour - 1.0).square().sum())
    # The first step of Adam is its rate, whatever the slope.
    assert (bed.item(), colour.item()) == (pytest.approx(0.05), pytest.approx(0.2))
    train.set_rates(optimiser, 1.0)
    assert [group["lr"] for group in optimiser.param_groups] == [0.1, 0.4]


def test_losses_have_converged_once_they_vary_little_against_the_first_ones():
    falling, even = [1.0 - 0.1 * k for k in range(10)], [0.1, 0.11] * 5
    assert not has_converged(falling + even[:-1], 10, 0.01)  # too few to compare
    assert has_converged(falling + even, 10, 0.01)
    assert not has_converged(falling + falling, 10, 0.01)


def test_the_water_column_absorbs_and_veils_and_its_surface_reflects(rng):
    column = WaterColumn().double()
    with torch.no_grad():
        for parameter in column.parameters():
            parameter.copy_(torch.from_numpy(rng.standard_normal(3)))
    bed, length, r = torch.tensor([[0.6, 0.4, 0.2]]).double(), torch.tensor([2.5]).double(), torch.tensor([0.03])
    a, veil, sky = (
        np.log1p(np.exp(p.detach().numpy())) for p in (column.raw_absorption, column.raw_veil, column.raw_sky)
    )
    kept = np.exp(-a * 2.5)
    below = kept * (0.6, 0.4, 0.2) + (1.0 - kept) * veil
    np.testing.assert_allclose(column(bed, length, r.double())[0].detach(), 0.97 * below + 0.03 * sky, rtol=1e-6)


def test_of_each_pair_what_is_given_is_a_constant_and_what_is_not_is_learned():
    known = {"absorption": (0.2, 0.1, 0.3), "veil": (0.0, 0.1, 0.2)}
    for given in ({}, {"absorption": known["absorption"]}, {"veil": known["veil"]}, known):
        column = WaterColumn(**given)
        learned = {f"raw_{name}" for name in known.keys() - given.keys()} | {"raw_sky"}
        assert {name for name, _ in column.named_parameters()} == learned
        assert column.state_dict().keys() == learned | {f"given_{name}" for name in given}
        for name, value in given.items():
            torch.testing.assert_close(getattr(column, name), torch.tensor(value))


def test_no_water_shows_the_bed_and_endless_water_the_veil():
    column = WaterColumn()
    bed = torch.rand(4, 3)
    dark = torch.zeros(4)
    torch.testing.assert_close(column(bed, torch.zeros(4), dark), bed)
    veil = torch.nn.functional.softplus(column.raw_veil).expand(4, 3)
    torch.testing.assert_close(column(bed, torch.full((4,), 1e4), dark), veil)
