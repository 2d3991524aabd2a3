"""Losses on weights and on density: closed forms, slow references, gradients, and nothing where they must vanish."""

from __future__ import annotations

import math
from dataclasses import fields

import pytest
import torch
from analytic_volume import BOX, AnalyticVolume, floor_at, looking_down, seen_by
from volume_scenes import Backdrop

from fields.models import PATCH_PX, Losses
from fields.volume.losses import (
    LIMIT,
    NODES,
    added_loss,
    density_loss,
    density_per_half,
    distortion_loss,
    draw_nodes,
    empty_loss,
    gaussian_density_loss,
    limited_exp,
    printed_density_loss,
    transparency_loss,
)
from fields.volume.photographs import COLUMNS
from fields.volume.renderer import Rendered, VolumeRenderer
from fields.volume.sampling import Cells, Samples

LENGTH = 0.1


def number(value: torch.Tensor) -> float:
    return value.detach().item()


def rendered_from(weights: torch.Tensor, edges: torch.Tensor) -> Rendered:
    samples = Samples(0.5 * (edges[:, 1:] + edges[:, :-1]), edges[:, 1:] - edges[:, :-1], edges)
    return Rendered(torch.full((len(weights), 3), 0.5, dtype=weights.dtype), weights, samples)


@pytest.fixture
def batch():
    """Three paths with random weights over uneven intervals, float64."""
    torch.manual_seed(0)
    paths = seen_by(looking_down())[:3]
    for name in ("near", "far", "origin", "air", "wet", "crossing"):
        setattr(paths, name, getattr(paths, name).double())
    inner = torch.rand(3, 6, dtype=torch.float64).sort(dim=1).values
    shares = torch.cat([torch.zeros(3, 1), inner, torch.ones(3, 1)], dim=1)
    edges = paths.near[:, None] + shares * (paths.far - paths.near)[:, None]
    weights = torch.rand(3, 7, dtype=torch.float64) / 7.0
    return paths, edges, weights


def test_transparency_is_what_the_weights_leave(batch):
    _, edges, weights = batch
    assert number(transparency_loss(rendered_from(weights, edges))) == pytest.approx(1.0 - number(weights.sum()) / 3)


def test_distortion_is_the_double_sum_of_its_equation(batch):
    paths, edges, weights = batch
    total = 0.0
    for path in range(3):
        near, far = number(paths.near[path]), number(paths.far[path])
        s, w = [(number(e) - near) / (far - near) for e in edges[path]], weights[path].tolist()
        middle = [0.5 * (a + b) for a, b in zip(s[1:], s[:-1], strict=True)]
        total += sum(w[i] * w[j] * abs(middle[i] - middle[j]) for i in range(7) for j in range(7))
        total += sum(w[i] ** 2 * (s[i + 1] - s[i]) for i in range(7)) / 3.0
    assert number(distortion_loss(paths, rendered_from(weights, edges))) == pytest.approx(total / 3, rel=1e-12)


def opacity_is(formula) -> AnalyticVolume:
    """A volume of which a piece of `LENGTH` stops a share that is a formula of positions."""
    return AnalyticVolume(lambda x: -torch.log1p(-formula(x.double())) / LENGTH)


def test_even_density_costs_nothing_however_high_it_is():
    for density in (0.0, 3.0, 1e6):
        drawn = draw_nodes(AnalyticVolume(lambda x, d=density: torch.full((len(x),), d)), LENGTH)
        assert number(density_loss(*drawn)) == 0.0


def test_the_density_loss_of_a_ramp_is_its_closed_form():
    slope = torch.tensor([0.3, -0.1, 0.05], dtype=torch.float64)
    model = opacity_is(lambda x: 0.5 + x @ slope)
    torch.manual_seed(0)
    drawn = draw_nodes(model, LENGTH, drawn=4000, points=8)
    torch.testing.assert_close(drawn[1].mean(dim=(0, 1)), LENGTH * slope, rtol=1e-5, atol=1e-7)  # float32 places
    node = 2.0 / torch.tensor(BOX.counts(NODES))
    variance = number((slope**2 * node**2 / 12.0).sum()) * 7 / 8
    expected = number(torch.expm1(LENGTH * slope.abs()).mean()) + math.expm1(variance)
    # The variance is a mean over 4000 nodes: 1 % of a term that is a hundredth of the sum.
    assert number(density_loss(*drawn)) == pytest.approx(expected, rel=1e-3)


def test_the_density_loss_stays_finite_at_an_opaque_wall():
    drawn = draw_nodes(floor_at(0.0, width=1e-6, density=1e6), LENGTH)
    assert number(drawn[1].abs().max()) <= 1.0
    assert number(density_loss(*drawn)) < math.e


def test_gradients_of_the_density_losses_are_those_of_finite_differences():
    def loss(slope: torch.Tensor) -> torch.Tensor:
        model = opacity_is(lambda x: 0.5 + 0.2 * torch.sin(x @ slope))
        torch.manual_seed(3)
        return density_loss(*draw_nodes(model, LENGTH, drawn=4, points=3)) + gaussian_density_loss(
            model, LENGTH, points=5
        )

    slope = torch.tensor([0.9, -0.4, 0.7], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(loss, (slope,))


def test_the_gaussian_form_lets_ramps_pass_and_charges_curvature_by_its_closed_form():
    slope = torch.tensor([0.3, -0.1, 0.05], dtype=torch.float64)
    ramp = gaussian_density_loss(opacity_is(lambda x: 0.5 + x @ slope), LENGTH)
    assert number(ramp) < 1e-14  # positions are float32: 1e-7, squared
    torch.manual_seed(0)
    bend = gaussian_density_loss(opacity_is(lambda x: 0.1 + 0.1 * (x**2).sum(dim=-1)), LENGTH, points=40000)
    # a_s - a is q l^2 times the mean of 4 chi-square numbers of 3 degrees: mean 3, variance 6 / 4.
    expected = (0.1 * LENGTH**2) ** 2 * (9.0 + 6.0 / 4.0)
    assert number(bend) == pytest.approx(expected, rel=0.03)  # 40000 points: 0.6 % standard deviation


def test_the_printed_losses_of_a_ramp_of_density_are_their_closed_forms():
    slope = torch.tensor([0.3, -0.1, 0.05], dtype=torch.float64)
    ramp = AnalyticVolume(lambda x: 2.0 + x.double() @ slope)
    torch.manual_seed(0)
    # The box is 2 m wide: half of its edge is 1 m, so that density and gradient have the same numbers per metre.
    node = 2.0 / torch.tensor(BOX.counts(NODES))
    variance = number((slope**2 * node**2 / 12.0).sum()) * 7 / 8
    expected = number(torch.exp(slope.abs()).mean()) + math.exp(variance)
    assert number(printed_density_loss(ramp, LENGTH, drawn=2000, points=8)) == pytest.approx(expected, rel=1e-5)
    assert number(gaussian_density_loss(ramp, LENGTH, of=density_per_half)) < 1e-12
    assert number(printed_density_loss(AnalyticVolume(lambda x: torch.full((len(x),), 1e6)), LENGTH)) == 2.0


def test_the_printed_exponential_goes_on_along_its_tangent_and_stays_finite_at_a_wall():
    x = torch.tensor([-1.0, LIMIT, LIMIT + 2.0, 1e9], dtype=torch.float64)
    found = limited_exp(x) / math.exp(LIMIT)
    torch.testing.assert_close(found[:3], torch.tensor([math.exp(-1.0 - LIMIT), 1.0, 3.0], dtype=torch.float64))
    assert math.isfinite(number(printed_density_loss(floor_at(0.0, width=1e-6, density=1e6), LENGTH)))


def test_what_is_not_empty_costs_its_opacity():
    fog = AnalyticVolume(lambda x: torch.full((len(x),), 0.7))
    assert number(empty_loss(fog, LENGTH)) == pytest.approx(1.0 - math.exp(-0.07), rel=1e-5)
    torch.manual_seed(0)
    assert number(empty_loss(floor_at(0.0, density=1e4), LENGTH, points=4000)) == pytest.approx(0.5, abs=0.04)


SWITCHES = [Losses(**{f.name: 1.0, "patch_px": 4}) for f in fields(Losses) if f.name != "patch_px"]


@pytest.fixture
def trained_on():
    """A renderer, paths with colours and priors that disagree with it, what they show of it, and the proxy."""
    torch.manual_seed(0)
    model = AnalyticVolume(lambda x: 6.0 * torch.sigmoid(8.0 * torch.sin(4.0 * x[:, 0] + 3.0 * x[:, 2])))
    renderer = VolumeRenderer(model, background=Backdrop((0.0, 0.0, 0.0)))
    paths, cells = seen_by(looking_down()), Cells.everywhere(BOX, 32)
    paths.rgb = torch.rand(len(paths), 3)
    known = torch.rand(len(paths), COLUMNS)
    known[:, 2], known[:, 3:] = 1.0, torch.nn.functional.normalize(known[:, 3:], dim=1)
    paths.priors = known
    return renderer, paths, renderer.render(paths, cells.samples(paths, 32, jitter=False)), cells


@pytest.mark.parametrize("losses", SWITCHES, ids=str)
def test_each_switch_adds_its_weight_times_its_loss_and_reaches_what_it_should(losses, trained_on):
    renderer, paths, rendered, cells = trained_on
    torch.manual_seed(1)
    once = added_loss(losses, renderer, paths, rendered, cells, None)
    assert math.isfinite(number(once))
    assert number(once) > 0.0
    (gradient,) = torch.autograd.grad(once, [renderer.model.scale])
    assert torch.isfinite(gradient).all()
    assert number(gradient.abs().max()) > 0.0


def test_without_weights_nothing_is_added_and_nothing_drawn(trained_on):
    state = torch.get_rng_state()
    total = added_loss(Losses(), *trained_on, None)
    assert number(total) == 0.0
    assert not total.requires_grad
    assert torch.equal(torch.get_rng_state(), state)
    assert Losses(distortion=0.1).patch == 1
    assert Losses(ssim=0.1).patch == PATCH_PX
    assert Losses(ssim=0.1, patch_px=6).patch == 6
