"""Heads of the field: density coarse and weighted, and colour, against their equations."""

import math

import numpy as np
import pytest
import torch

from fields.device import choose_device
from fields.heads import PART, ColourHead, DensityHead, spherical_harmonics

L, D, F = 3, 2, 4
# Of the largest: normal laws within 1e-7 and sums of a few hundred rows in float32; measured 6e-7.
KERNEL = 1.2e-6


def gelu(x):
    return x * 0.5 * (1.0 + np.vectorize(math.erf)(np.asarray(x) / math.sqrt(2.0)))


def linear(layer: torch.nn.Linear, x: np.ndarray) -> np.ndarray:
    return layer.weight.detach().numpy() @ x + layer.bias.detach().numpy()


def randomised(head: torch.nn.Module) -> torch.nn.Module:
    """The head in float64 with every parameter drawn from a normal law."""
    generator = torch.Generator().manual_seed(3)
    head = head.double()
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator, dtype=torch.float64))
    return head


def features_of(rng, num: int = 6) -> np.ndarray:
    return rng.standard_normal((num, L * D * F))


def test_coarse_density_is_a_linear_map_of_the_sum_over_directions(rng):
    head, features = randomised(DensityHead(L, D, F)), features_of(rng)
    found = head(torch.from_numpy(features)).detach().numpy()
    for value, sample in zip(found, features, strict=True):
        a = sample.reshape(L, D, F)
        total = [sum(a[n, m, k] for m in range(D)) for n in range(L) for k in range(F)]
        assert value == pytest.approx(linear(head.coarse, np.array(total))[0], rel=1e-12)


def test_fine_density_gates_the_features_of_each_scale_by_a_weighting_network(rng):
    head, features = randomised(DensityHead(L, D, F)), features_of(rng)
    head.is_fine = True
    assert head.squeeze.weight.shape == (D * F // 2, D * F)
    found = head(torch.from_numpy(features)).detach().numpy()

    for value, sample in zip(found, features, strict=True):
        total = []
        for a in sample.reshape(L, D * F):
            gate = a
            for name in ("squeeze", "excite", "gate"):
                gate = gelu(linear(getattr(head, name), gate))
            weighted = (gate * a).reshape(D, F)
            total += [sum(weighted[m, k] for m in range(D)) for k in range(F)]
        assert value == pytest.approx(linear(head.fine, np.array(total))[0], rel=1e-12)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 1e-6)])
def test_the_switch_to_fine_leaves_the_density_where_it_stands(dtype, tolerance, rng):
    head = randomised(DensityHead(L, D, F)).to(dtype)
    features = torch.from_numpy(features_of(rng, 50)).to(dtype)
    coarse = head(features)
    head.switch_to_fine()
    assert (head(features) - coarse).abs().max() <= tolerance * coarse.abs().max()


def test_all_of_the_weighting_network_learns_after_the_switch(rng):
    head = randomised(DensityHead(L, D, F))
    head.switch_to_fine()
    features = torch.from_numpy(features_of(rng))
    optimiser = torch.optim.Adam(head.parameters(), lr=1e-2)
    for _ in range(2):  # the gate's map starts at zero: what lies before it hears of the loss one step later
        optimiser.zero_grad()
        head(features).square().sum().backward()
        optimiser.step()
    for name in ("squeeze", "excite", "gate", "fine"):
        assert getattr(head, name).weight.grad.any(), name
    assert head.coarse.weight.grad is None


@pytest.mark.parametrize(("shape", "reduction"), [((L, D, F), 2), ((6, 3, 4), 4), ((2, 1, 8), 2), ((1, 1, 4), 8)])
def test_the_weighting_kernel_is_its_twin_forward_and_backward(device, shape, reduction, rng):
    exact = randomised(DensityHead(*shape, reduction))
    fast = DensityHead(*shape, reduction, device=device)
    fast.load_state_dict(exact.state_dict())
    exact.is_fine = fast.is_fine = True
    features = torch.from_numpy(rng.standard_normal((301, math.prod(shape)))).float()
    weights = torch.from_numpy(rng.standard_normal(301)).float()
    results = []
    for head, dtype in ((fast, torch.float32), (exact, torch.float64)):
        x = features.detach().to(dtype).requires_grad_()
        density = head(x)
        (density * weights.to(dtype)).sum().backward()
        learning = [p.grad for name, p in head.named_parameters() if not name.startswith("coarse")]
        results.append([density.detach(), x.grad, *learning])
    for found, truth in zip(*results, strict=True):
        assert found.shape == truth.shape
        assert (found - truth).abs().max() <= KERNEL * truth.abs().max()


def test_gradients_of_the_weighting_kernel_are_the_same_to_the_last_bit(device, rng):
    head = DensityHead(L, D, F, device=device)
    head.load_state_dict(randomised(DensityHead(L, D, F)).state_dict())
    head.is_fine = True
    features = torch.from_numpy(rng.standard_normal((5003, L * D * F))).float()
    found = []
    for _ in range(5):
        head.zero_grad()
        head(features).square().sum().backward()
        found.append([head.squeeze.weight.grad.clone(), head.gate.bias.grad.clone(), head.fine.weight.grad.clone()])
    assert all(torch.equal(a, b) for other in found for a, b in zip(found[0], other, strict=True))


def test_no_samples_have_no_density(device):
    head = DensityHead(L, D, F, device=device)
    head.switch_to_fine()
    features = torch.zeros(0, L * D * F, requires_grad=True)
    density = head(features)
    assert density.shape == (0,)
    density.sum().backward()
    assert features.grad.shape == features.shape
    assert not head.squeeze.weight.grad.any()


def test_wide_maps_are_left_to_the_twin(rng):
    head = DensityHead(1, 3, 16, 4, device=choose_device("auto"))
    twin = DensityHead(1, 3, 16, 4)
    twin.load_state_dict(head.state_dict())
    head.switch_to_fine()
    twin.switch_to_fine()
    features = torch.from_numpy(rng.standard_normal((5, 48))).float()
    assert torch.equal(head(features), twin(features))


def test_the_weighting_kernel_refuses_other_packets_than_it_reads(device):
    if device.module is None:
        pytest.skip("torch takes any number of channels")
    head = DensityHead(L, D, 3, device=device)
    head.switch_to_fine()
    with pytest.raises(ValueError, match="the head weighs 3 channels, but its kernel reads packets of 4"):
        head(torch.zeros(2, L * D * 3))


def test_colour_weights_each_scale_and_regresses_it_with_the_direction(rng):
    head, features = randomised(ColourHead(L, D, F, hidden=5, degree=2)), features_of(rng)
    directions = rng.standard_normal((len(features), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = head(torch.from_numpy(features), torch.from_numpy(directions)).detach().numpy()
    harmonics = spherical_harmonics(torch.from_numpy(directions), 2).numpy()
    for value, sample, sh in zip(found, features, harmonics, strict=True):
        f = np.concatenate([sample * head.weights.detach().numpy(), sh])
        out = linear(head.last, gelu(linear(head.middle, gelu(linear(head.first, f)))))
        np.testing.assert_allclose(value, np.log1p(np.exp(4.0 * out)) / 4.0, rtol=1e-10)  # softplus, beta 4
    assert (found > 0.0).all()


def test_colours_and_their_gradients_do_not_depend_on_how_many_are_regressed_at_once(rng):
    head, num = randomised(ColourHead(L, D, F, hidden=5, degree=2, extra=3)), 2 * PART + 3
    inputs = [torch.from_numpy(rng.standard_normal((num, n))) for n in (L * D * F, 3, 3)]
    results = []
    for cuts in ([num], [PART - 5, num - PART + 5 - 4000, 4000]):
        head.zero_grad()
        x = inputs[0].clone().requires_grad_()
        colour = torch.cat([head(*of) for of in zip(*(v.split(cuts) for v in (x, *inputs[1:])), strict=True)])
        colour.square().sum().backward()
        results.append([colour.detach(), x.grad, head.weights.grad.clone(), head.first.weight.grad.clone()])
    for found, other in zip(*results, strict=True):
        torch.testing.assert_close(other, found, rtol=1e-11, atol=1e-12 * float(found.abs().max()))


def test_a_bed_that_shines_needs_the_directions_it_is_seen_along(rng):
    with pytest.raises(ValueError, match="harmonics of degree 2 expect the directions"):
        ColourHead(L, D, F, degree=2)(torch.from_numpy(features_of(rng)).float(), None)


def test_spherical_harmonics_are_orthonormal_over_the_sphere():
    # Gauss-Legendre in z and even steps about it integrate polynomials of degree 6 exactly.
    z, weight = np.polynomial.legendre.leggauss(8)
    phi = 2.0 * np.pi * np.arange(12) / 12
    z, phi = (v.ravel() for v in np.meshgrid(z, phi, indexing="ij"))
    r = np.sqrt(1.0 - z * z)
    directions = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)
    area = np.repeat(weight, 12) * 2.0 * np.pi / 12
    assert area.sum() == pytest.approx(4.0 * np.pi, rel=1e-12)
    for degree in (1, 2, 3):
        found = spherical_harmonics(torch.from_numpy(directions), degree).numpy()
        assert found.shape == (len(z), (degree + 1) ** 2 - 1)
        with_constant = np.column_stack([np.full(len(z), 0.5 / math.sqrt(math.pi)), found])
        gram = with_constant.T @ (area[:, None] * with_constant)
        np.testing.assert_allclose(gram, np.eye((degree + 1) ** 2), atol=1e-6)  # constants have seven digits
