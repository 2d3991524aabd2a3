"""NeuS: the light that a signed distance stops in closed form, unbiased surfaces, exact normals, learning."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.special import expit, log_expit
from volume_models import check_interface, check_learning, directions, positions
from volume_scenes import BOX

from fields.compositing import quantile_height, render_weights
from fields.volume.sdf import CHUNK, DistanceNetwork, SdfSettings, SdfVolume

SMALL = SdfSettings.small(layers=3, width=32, frequencies=3, direction_frequencies=2)
MIDDLE = torch.tensor(0.5 * (BOX.low + BOX.high))
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


class Sphere(torch.nn.Module):
    """Distance to a sphere of 0.3 about the origin, in box coordinates, and one feature."""

    def forward(self, p):
        return torch.stack([p.norm(dim=1) - 0.3, p[:, 0]], dim=1)


class Plane(torch.nn.Module):
    """Distance over a level plane 0.1 over the origin, in box coordinates, and one feature."""

    def forward(self, p):
        return torch.stack([p[:, 2] - 0.1, p[:, 0]], dim=1)


HEIGHT = float(MIDDLE[2]) + 0.1 * BOX.edge / 2


def volume_of(shape: torch.nn.Module, s: float) -> SdfVolume:
    """A volume in float64 with a known distance and sharpness s [1/m]."""
    model = SdfVolume(BOX, SMALL).double()
    model.network = shape
    with torch.no_grad():
        model.raw_sharpness.fill_(np.log(s * BOX.edge / 2) / 10.0)
    return model


def slanted(edges: torch.Tensor, incidence: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Middles (K, 3), directions (K, 3) and lengths (K,) of pieces of a path that meets `HEIGHT` at path length 0."""
    direction = torch.tensor([np.sin(incidence), 0.0, -np.cos(incidence)], dtype=torch.float64)
    at = torch.tensor([float(MIDDLE[0]), float(MIDDLE[1]), HEIGHT], dtype=torch.float64)
    x = at + (0.5 * (edges[1:] + edges[:-1]))[:, None] * direction
    return x, direction.expand_as(x), edges[1:] - edges[:-1]


@pytest.mark.parametrize("s", [8.0, 300.0])
@pytest.mark.parametrize("incidence", [0.0, 0.9])
def test_pieces_stop_what_the_logistic_law_says(s, incidence):
    edges = torch.linspace(-0.4, 0.4, 28, dtype=torch.float64)
    model = volume_of(Plane(), s)
    found = model.thickness(*slanted(edges, incidence))[0].detach().numpy()
    f = -np.cos(incidence) * edges.numpy()
    np.testing.assert_allclose(found, log_expit(s * f[:-1]) - log_expit(s * f[1:]), rtol=1e-9, atol=1e-12)
    alpha = np.maximum((expit(s * f[:-1]) - expit(s * f[1:])) / expit(s * f[:-1]), 0.0)  # equation 13 itself
    np.testing.assert_allclose(1.0 - np.exp(-found), alpha, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("incidence", [0.0, 0.9])
def test_light_that_leaves_a_surface_passes(incidence):
    x, direction, length = slanted(torch.linspace(-0.4, 0.4, 9, dtype=torch.float64), incidence)
    assert not volume_of(Plane(), 30.0).thickness(x, -direction, length)[0].any()


@pytest.mark.parametrize("s", [50.0, 1000.0])
@pytest.mark.parametrize("incidence", [0.0, 0.6])
def test_the_median_is_unbiased_wherever_the_plane_cuts_a_piece(s, incidence):
    model, piece, misses = volume_of(Plane(), s), 0.8 / 64, []
    for shift in (np.arange(20) + 0.5) / 20 - 0.5:
        edges = torch.linspace(-0.4, 0.4, 65, dtype=torch.float64) + shift * piece
        weights = render_weights(model.thickness(*slanted(edges, incidence))[0].detach()[None])
        misses.append(quantile_height(weights, edges[None])[0].item())
    assert np.abs(misses).max() < 0.5 * piece
    assert abs(np.mean(misses)) < 1e-5 * piece  # shifts come in pairs; the path begins exp(-16) off the law's end


def test_density_is_that_of_short_pieces_seen_head_on():
    model, x = volume_of(Plane(), 40.0), positions(50, dtype=torch.float64)
    length = torch.full((50,), 1e-6, dtype=torch.float64)
    thickness, features = model.thickness(x, (-UP).expand(50, 3), length)
    density, same = model.evaluate(x)
    # The law bends by half a length times s, 2e-5, inside a piece; differences of logarithms round at 1e-16 / 1e-6.
    torch.testing.assert_close(thickness / length, density, rtol=1e-4, atol=1e-7)
    assert torch.equal(features, same)


def test_the_eikonal_term_is_zero_for_a_distance_and_counts_the_excess_of_another():
    x = positions(200, dtype=torch.float64)
    for shape in (Plane(), Sphere()):
        assert volume_of(shape, 30.0).penalty(x).item() < 1e-28  # squares of roundings of 1

    class Steep(Plane):
        def forward(self, p):
            return 1.5 * super().forward(p)

    assert volume_of(Steep(), 30.0).penalty(x).item() == pytest.approx(SMALL.eikonal * 0.25, rel=1e-12)


def test_normals_point_out_of_a_sphere_and_distances_are_in_metres():
    model, x = volume_of(Sphere(), 30.0), positions(50, dtype=torch.float64)
    out = x - MIDDLE
    length = out.norm(dim=1)
    torch.testing.assert_close(model.distance(x)[0], length - 0.3 * BOX.edge / 2, rtol=0.0, atol=1e-14)
    torch.testing.assert_close(model.normals(x, 0.1), out / length[:, None], rtol=0.0, atol=1e-12)


def test_the_gradient_of_the_network_and_of_density_is_that_of_finite_differences():
    torch.manual_seed(0)
    model = SdfVolume(BOX, SMALL).double()
    x, step = positions(20, dtype=torch.float64), 1e-6
    gradient, slope = model.distance(x)[1].detach(), model.density_gradient(x, step).detach()
    for axis in range(3):
        aside = step * torch.eye(3, dtype=torch.float64)[axis]
        (f1, _, _), (f0, _, _) = model.distance(x + aside), model.distance(x - aside)
        d1, d0 = model.evaluate(x + aside)[0], model.evaluate(x - aside)[0]
        # Softplus of beta 100 bends within hundredths: the third derivative times the squared step, and rounding.
        torch.testing.assert_close(gradient[:, axis], (f1 - f0).detach() / (2 * step), rtol=1e-6, atol=1e-7)
        torch.testing.assert_close(slope[:, axis], (d1 - d0).detach() / (2 * step), rtol=1e-6, atol=1e-6)


def test_the_eikonal_term_and_the_weights_reach_the_network_through_the_gradient():
    torch.manual_seed(0)
    model = SdfVolume(BOX, SdfSettings.small(layers=2, width=8, frequencies=1)).double()
    x, d = positions(6, dtype=torch.float64), -directions(6, dtype=torch.float64)
    length = torch.full((6,), 0.2, dtype=torch.float64)
    weight = model.network.layers[1].parametrizations.weight.original1

    def loss():
        return model.penalty(x) + model.thickness(x, d, length)[0].square().sum()

    (gradient,) = torch.autograd.grad(loss(), weight)
    step = 1e-6
    for row, column in ((0, 0), (3, 5), (7, 2)):
        ends = []
        for sign in (1.0, -1.0):
            with torch.no_grad():
                weight[row, column] += sign * step
            ends.append(loss().item())
            with torch.no_grad():
                weight[row, column] -= sign * step
        assert (ends[0] - ends[1]) / (2.0 * step) == pytest.approx(gradient[row, column].item(), rel=1e-5, abs=1e-8)


def test_without_training_it_is_the_same_in_pieces():
    torch.manual_seed(0)
    model, x = SdfVolume(BOX, SdfSettings.small(layers=1, width=8, frequencies=0, start="plane")), positions(CHUNK + 7)
    with torch.no_grad():
        found = model.evaluate(x)
    assert not found[1].requires_grad
    # Blocks of another size sum in another order: some roundings of float32.
    torch.testing.assert_close(found[0], model.evaluate(x)[0].detach(), rtol=1e-4, atol=1e-6)


def test_it_starts_as_a_sphere_or_as_a_plane():
    torch.manual_seed(0)
    sphere = DistanceNetwork(SdfSettings.neus())
    out = torch.nn.functional.normalize(torch.randn(200, 3), dim=1)
    means = [sphere(r * out)[:, 0].mean().item() for r in (0.1, 0.3, 0.9)]
    # About one: the radius is right to a third, and distances rise from the inside, negative, to the outside.
    assert means[0] < means[1] < 0.0 < means[2]
    plane = DistanceNetwork(SdfSettings.small(start="plane", start_at=-0.2))
    p = 2.0 * torch.rand(200, 3) - 1.0
    # 64 weights of 1e-4 on activations of order 1.
    assert (plane(p)[:, 0] - p[:, 2] - 0.2).abs().max() < 0.01
    assert SdfVolume(BOX, SMALL).sharpness.item() == pytest.approx(np.exp(3.0) * 2.0 / BOX.edge, rel=1e-6)


def test_the_default_networks_have_the_sizes_of_the_paper():
    model = SdfVolume(BOX, SdfSettings.neus())
    assert [layer.in_features for layer in model.network.layers] == [39, *[256] * 8]
    assert [layer.out_features for layer in model.network.layers] == [*[256] * 3, 217, *[256] * 4, 257]
    layers = [layer for layer in model.colour if isinstance(layer, torch.nn.Linear)]
    assert [layer.in_features for layer in layers] == [3 + 3 + 256 + 27, *[256] * 4]
    assert model.rates()[0].rate == 5e-4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": "cube"}, "start is 'cube', expected 'sphere' or 'plane'"),
        ({"skip": 8}, "skip is 8, expected a layer from 1 to 7, or None"),
        ({"width": 39}, "width is 39, but at the skip 39 of it hold the encoded position"),
    ],
)
def test_settings_that_cannot_be_built_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        SdfSettings.neus(**change)


@pytest.mark.parametrize("skip", [None, 2])
def test_it_is_a_volume_model(skip):
    settings = SdfSettings.small(layers=3, width=32, frequencies=3, skip=skip)
    check_interface(lambda appearance: SdfVolume(BOX, settings, appearance=appearance))


@pytest.mark.parametrize(("start", "at", "share"), [("plane", 0.0, 0.7), ("sphere", 0.3, 0.7)])
def test_it_learns_a_bed_under_water(start, at, share):
    settings = SdfSettings.small(layers=3, width=32, frequencies=4, start=start, start_at=at)
    check_learning(lambda appearance: SdfVolume(BOX, settings), steps=40, share=share)


def test_the_cosine_is_annealed_from_half_of_it_and_a_half_to_itself():
    model = volume_of(Plane(), 20.0)
    model.settings = SdfSettings.small(layers=3, width=32, annealed=0.5, steps=10)
    cos = torch.tensor([-1.0, -0.5, 0.5], dtype=torch.float64)
    torch.testing.assert_close(model._annealed(cos), torch.tensor([-1.0, -0.75, -0.25], dtype=torch.float64))
    model.observe([0.1])
    torch.testing.assert_close(model._annealed(cos), torch.tensor([-1.0, -0.8 * 0.75 - 0.1, -0.2], dtype=torch.float64))
    model.observe([0.1] * 5)
    assert torch.equal(model._annealed(cos), cos)
    # Head-on both are the same: from any step on, a level surface is where it was.
    edges = torch.linspace(-0.4, 0.4, 28, dtype=torch.float64)
    after = model.thickness(*slanted(edges, 0.0))[0]
    model.observe([])
    torch.testing.assert_close(model.thickness(*slanted(edges, 0.0))[0], after)
