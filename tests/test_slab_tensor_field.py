"""The field as a whole: a bed at its proxy, moved and seen through water, in closed form; the paper's cube."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from plane_field import field_over, level_slab, rays_at
from plane_survey import PlaneBed, ring

from fields.compositing import MIN_COLOUR_WEIGHT
from fields.device import choose_device
from fields.image_store import GAMMA
from fields.slab.tensor_field import FieldSettings, TensorField
from refract import FlatWater

TORCH = choose_device("torch")
LEVEL = FlatWater((0.0, 0.0, 0.0), n_water=1.333)
# Heights of 2 m over coordinates of 10 m in float32, through eight cumulative sums; measured 2e-6 m.
HEIGHT_M = 5e-6
# A bed this sharp, on an end of two intervals, leaves no sample a weight that is too small to be painted.
SHARP_M, COLOUR = 1e-4, 1e-5


def lift(field: TensorField, metres: float) -> None:
    """Move the bed by so much everywhere."""
    with torch.no_grad():
        field.density.coarse.bias.fill_(math.atanh(metres / field.slab.half))


def set_width(field: TensorField, metres: float) -> None:
    with torch.no_grad():
        field.log_width.fill_(math.log(metres))


def roughen(field: TensorField) -> TensorField:
    """Give the density something to say."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        weight = field.density.coarse.weight
        weight.copy_(0.5 * torch.randn(weight.shape, generator=generator))
    return field


def paint(field: TensorField, colour) -> None:
    """One linear radiance everywhere."""
    with torch.no_grad():
        field.colour.last.weight.zero_()
        field.colour.last.bias.copy_(torch.log(torch.expm1(4.0 * torch.tensor(colour))) / 4.0)


def meeting(bed: PlaneBed, camera, step: int = 7) -> np.ndarray:
    return bed.true_height(camera)[::step, ::step].ravel()


@pytest.mark.parametrize(
    ("water", "level", "slope"),
    [(LEVEL, -2.0, 0.0), (LEVEL, -2.0, 0.1), (LEVEL, 0.02, 0.1), (None, -2.0, 0.1)],
    ids=["deep", "sloped", "shore", "dry"],
)
@pytest.mark.parametrize("width", [0.01, 0.03, 0.1])
def test_a_field_of_zero_is_its_proxy(water, level, slope, width, device):
    bed = PlaneBed(water, level, slope)
    field = field_over(level_slab(level, slope_x=slope), device, water=water is not None)
    set_width(field, width)
    for camera in ring(3, target=(0.0, 0.0, level)):
        truth = meeting(bed, camera)
        heights, spread = field.heights(rays_at(bed, camera, truth))
        np.testing.assert_allclose(heights, truth, atol=HEIGHT_M)
        assert (spread > 0.0).all()


@pytest.mark.parametrize("off", [0.02, -0.02])
def test_a_ray_that_starts_beside_the_proxy_still_ends_on_it(off):
    bed, camera = PlaneBed(LEVEL, -2.0, 0.1), ring(2)[1]
    field = field_over(level_slab(-2.0, slope_x=0.1), TORCH)
    truth = meeting(bed, camera)
    step = 2.0 * field.slab.half / field.settings.samples
    heights, _ = field.heights(rays_at(bed, camera, truth + off))
    # The bed lies anywhere in an interval: linear interpolation costs h / (8 w) of a step.
    assert np.abs(heights.numpy() - truth).max() < step * step / (8.0 * 0.05)


@pytest.mark.parametrize("metres", [0.03, -0.045])
def test_the_density_moves_the_bed_by_what_its_equation_says(metres):
    bed, camera = PlaneBed(LEVEL, -2.0), ring(2)[1]
    field = field_over(level_slab(-2.0), TORCH, samples=80)
    lift(field, metres)
    heights, _ = field.heights(rays_at(bed, camera, -2.0))
    # 80 steps h of 2.5 mm in a law w = 50 mm wide: at most h^2 / (8 w).
    np.testing.assert_allclose(heights, -2.0 + metres, atol=2e-5)


def test_the_spread_is_that_of_the_laplace_law():
    bed, camera = PlaneBed(LEVEL, -2.0), ring(2)[1]
    field = field_over(level_slab(-2.0), TORCH, samples=80)
    set_width(field, 0.02)
    _, spread = field.heights(rays_at(bed, camera, -2.0))
    np.testing.assert_allclose(spread, -0.02 * math.log(2.0 * 0.16), rtol=2e-3)


def test_an_opaque_bed_is_seen_as_its_colour_through_the_water_above_it():
    bed = PlaneBed(LEVEL, -2.0)
    field = field_over(level_slab(-2.0), TORCH)
    set_width(field, SHARP_M)
    colour = np.array([0.5, 0.3, 0.2])
    paint(field, colour.tolist())
    absorption = field.column.absorption.detach().numpy()
    veil, sky = (
        torch.nn.functional.softplus(p).detach().numpy() for p in (field.column.raw_veil, field.column.raw_sky)
    )
    for camera in ring(3, radius=8.0):
        pixels = camera.pixel_centres()[::7, ::7].reshape(-1, 2)
        path = camera.paths(pixels, LEVEL)
        length = np.linalg.norm(path.at_height(np.full(len(pixels), -2.0), LEVEL) - path.crossing, axis=1)
        rays = rays_at(bed, camera, -2.0)
        kept = np.exp(-length[:, None] * absorption)
        r = rays.reflectance.numpy()[:, None]
        truth = (1.0 - r) * (kept * colour + (1.0 - kept) * veil) + r * sky
        seen, weights, _ = field.render(rays, jitter=False)
        np.testing.assert_allclose(weights.sum(dim=1).detach(), 1.0, atol=1e-6)
        np.testing.assert_allclose(seen.detach(), truth ** (1.0 / GAMMA), rtol=COLOUR)


def test_dry_ground_beside_the_water_is_neither_veiled_nor_reflected_upon():
    bed, camera = PlaneBed(LEVEL, 0.5), ring(2, target=(0.0, 0.0, 0.5))[1]
    field = field_over(level_slab(0.5), TORCH)
    set_width(field, SHARP_M)
    paint(field, [0.5, 0.3, 0.2])
    rays = rays_at(bed, camera, 0.5)
    assert (rays.reflectance > 0.01).all()
    seen, _, _ = field.render(rays, jitter=False)
    truth = np.array([0.5, 0.3, 0.2]) ** (1.0 / GAMMA)
    np.testing.assert_allclose(seen.detach(), np.tile(truth, (len(rays), 1)), rtol=COLOUR)


@pytest.mark.parametrize("width", [0.003, 0.02, 0.2])
def test_a_dry_bed_of_one_colour_has_it_however_blurred(width):
    field = field_over(level_slab(-2.0), TORCH, water=False)
    set_width(field, width)
    paint(field, [0.5, 0.3, 0.2])
    seen, weights, _ = field.render(rays_at(PlaneBed(None, -2.0), ring(2)[1], -2.0), jitter=True)
    assert width > 0.1 or (weights < MIN_COLOUR_WEIGHT).any()
    np.testing.assert_allclose(
        seen.detach(), np.tile(np.power([0.5, 0.3, 0.2], 1.0 / GAMMA), (len(seen), 1)), rtol=COLOUR
    )


def test_colour_is_looked_up_only_where_the_weight_matters():
    field = roughen(field_over(level_slab(-2.0), TORCH))
    set_width(field, 0.01)
    asked = []
    field.colour.register_forward_hook(lambda module, given, out: asked.append(len(out)))
    bed, camera = PlaneBed(LEVEL, -2.0), ring(2)[1]
    _, weights, _ = field.render(rays_at(bed, camera, -2.0), jitter=True)
    assert asked == [int((weights > MIN_COLOUR_WEIGHT).sum())]
    assert 0 < asked[0] < 0.7 * weights.numel()
    field.heights(rays_at(bed, camera, -2.0))
    assert len(asked) == 1  # heights need no colour


def test_the_switch_from_coarse_to_fine_leaves_the_image_as_it_is(device):
    field = roughen(field_over(level_slab(-2.0), device))
    rays = rays_at(PlaneBed(LEVEL, -2.0), ring(2)[1], -2.0)
    before = field.render(rays, jitter=False)
    field.density.switch_to_fine()
    after = field.render(rays, jitter=False)
    assert before[1].std(dim=0).max() > 1e-3  # the density does say something
    for one, other in zip(before, after, strict=True):
        assert (one - other).abs().max() < 1e-6


def test_the_devices_render_the_same(device):
    if device.name == "torch":
        pytest.skip("torch is what the others are compared with")
    rays = rays_at(PlaneBed(LEVEL, -2.0), ring(2)[1], -2.0)
    one, other = (roughen(field_over(level_slab(-2.0), d)) for d in (device, TORCH))
    for fast, slow in zip(one.render(rays, jitter=False), other.render(rays, jitter=False), strict=True):
        np.testing.assert_allclose(fast.detach(), slow.detach(), atol=2e-6)


@pytest.mark.parametrize("samples", [1, 100])
def test_so_many_samples_that_none_would_be_painted_are_refused(samples):
    with pytest.raises(ValueError, match=f"a field has {samples} samples per ray, expected 2 to 99"):
        FieldSettings(samples=samples)


def test_intervals_run_down_through_the_slab_about_each_rays_own_proxy():
    field = field_over(level_slab(-2.0), TORCH)
    rays = rays_at(PlaneBed(LEVEL, -2.0), ring(2)[1], -1.95)
    ends = field.intervals(rays, jitter=False)
    np.testing.assert_allclose(ends[0], -1.95 + np.linspace(0.1, -0.1, 9), atol=1e-6)
    torch.manual_seed(2)
    shift = field.intervals(rays, jitter=True) - ends
    step = 0.2 / 8
    assert (shift - shift[:, :1]).abs().max() < 1e-6
    assert shift.abs().max() <= 0.5 * step + 1e-6
    assert shift.max() > 0.4 * step
    assert shift.min() < -0.4 * step
