"""Planes times vectors: the equations against loops, the fused lookup against torch."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from fields.device import choose_device
from fields.factors import Factors, Grid, anisotropic_grids, geometric_scales, lookup_torch

GRIDS = [Grid(3, 2, 2), Grid(5, 7, 3), Grid(1, 4, 6)]
TORCH = choose_device("torch")
# A coordinate of 7 cells in float32 misses its share by 4e-7, times steps of some 3 between nodes; measured 1.3e-6.
VALUE = 2e-6
# Of the largest gradient: sums of some 200 samples in float32, in any order; measured 6e-7.
GRADIENT = 1.2e-6


def factors_of(device, directions: str, *, grids=GRIDS, channels: int = 4) -> Factors:
    """Factors whose entries are all of size one, so that no term hides."""
    factors = Factors(grids, directions, channels, device)
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for table in (factors.planes, factors.vectors):
            table.copy_(torch.randn(table.shape, generator=generator))
    return factors


def coordinates(rng, num: int = 200) -> np.ndarray:
    """Inside the box, outside it, on its faces, and on nodes."""
    inside, around = rng.uniform(0.0, 1.0, (num, 3)), rng.uniform(-0.5, 1.5, (num, 3))
    faces = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    nodes = (rng.integers(0, 7, (20, 3)) + 0.5) / 7.0
    return np.concatenate([inside, around, faces, nodes]).astype(np.float32).astype(np.float64)


def along(u: float, cells: int) -> list[tuple[int, float]]:
    """Nodes about a coordinate with their weights; cell i has its node at (i + 0.5) / cells."""
    x = u * cells - 0.5
    if x <= 0.0:
        return [(0, 1.0)]
    if x >= cells - 1:
        return [(cells - 1, 1.0)]
    return [(math.floor(x), 1.0 - x % 1.0), (math.floor(x) + 1, x % 1.0)]


def slow_features(factors: Factors, u: np.ndarray) -> np.ndarray:
    """G_n of the docstring, one number after the other: tables lie one behind the other, scale by scale, x y z."""
    planes, vectors = (t.detach().numpy().astype(float).tolist() for t in (factors.planes, factors.vectors))
    rows = []
    for x in u:
        first_plane = first_vector = 0
        features = []
        for grid in factors.grids:
            cells = (grid.nx, grid.ny, grid.nz)
            for m in factors.directions:
                axis = "xyz".index(m)
                a, b = (k for k in range(3) if k != axis)
                for channel in range(factors.channels):
                    v = sum(w * vectors[first_vector + i][channel] for i, w in along(x[axis], cells[axis]))
                    plane = 0.0
                    for j, w_j in along(x[b], cells[b]):
                        for i, w_i in along(x[a], cells[a]):
                            plane += w_j * w_i * planes[first_plane + j * cells[a] + i][channel]
                    features.append(v * plane)
                first_plane += cells[a] * cells[b]
                first_vector += cells[axis]
        rows.append(features)
    return np.array(rows)


def test_scales_are_geometric_from_the_coarsest_to_the_finest():
    scales = geometric_scales(64, 256, 6)
    b = (256 / 64) ** (1 / (6 - 1))
    assert scales == pytest.approx([64 * b ** (n - 1) for n in range(1, 7)], rel=1e-15)
    assert (scales[0], scales[-1]) == (64.0, 256.0)
    assert geometric_scales(64, 256, 1) == [256.0]


def test_grids_of_a_box_have_cells_of_the_asked_size_and_coarser_ones_in_even_steps():
    grids = anisotropic_grids(np.array([8.0, 4.0, 0.2]), np.array([0.02, 0.02, 0.025]), 8.0, 4)
    assert [(g.nx, g.ny, g.nz) for g in grids] == [(50, 25, 2), (100, 50, 2), (200, 100, 4), (400, 200, 8)]


@pytest.mark.parametrize("directions", ["z", "xyz", "zx"])
def test_features_are_the_products_that_the_equation_names(directions, rng):
    factors = factors_of(TORCH, directions).double()
    u = coordinates(rng, 30)
    found = lookup_torch(factors, torch.from_numpy(u)).detach().numpy()
    assert found.shape == (len(u), factors.num_features) == (len(u), 3 * len(directions) * 4)
    np.testing.assert_allclose(found, slow_features(factors, u), atol=1e-13)


@pytest.mark.parametrize(("directions", "channels"), [("z", 4), ("xyz", 4), ("zx", 8), ("xyz", 16)])
def test_the_lookup_of_each_device_is_the_twin_forward_and_backward(device, directions, channels, rng):
    fast = factors_of(device, directions, channels=channels)
    exact = factors_of(TORCH, directions, channels=channels).double()
    u = coordinates(rng)
    weights = torch.from_numpy(rng.standard_normal((len(u), fast.num_features)))
    features, truth = fast(torch.from_numpy(u).float()), exact(torch.from_numpy(u))
    np.testing.assert_allclose(features.detach().numpy(), truth.detach().numpy(), atol=VALUE)
    (features * weights.float()).sum().backward()
    (truth * weights).sum().backward()
    for name in ("planes", "vectors"):
        gradient = getattr(exact, name).grad.numpy()
        assert (np.abs(gradient).max(axis=1) > 0.0).all(), f"some rows of {name} were never read"
        np.testing.assert_allclose(getattr(fast, name).grad.numpy(), gradient, atol=GRADIENT * np.abs(gradient).max())


def gradients(factors: Factors, u: torch.Tensor, weights: torch.Tensor) -> list[torch.Tensor]:
    factors.zero_grad()
    (factors(u) * weights).sum().backward()
    return [factors.planes.grad.clone(), factors.vectors.grad.clone()]


def in_order(device) -> None:
    if device.name != "llvm":
        pytest.skip("sums are in the order of the samples on LLVM alone")


def test_gradients_are_the_same_to_the_last_bit_on_any_number_of_threads(device, rng):
    in_order(device)
    import drjit as dr

    factors = factors_of(device, "xyz")
    u = torch.from_numpy(rng.uniform(0.0, 1.0, (3001, 3)).astype(np.float32))
    weights = torch.from_numpy(rng.standard_normal((len(u), factors.num_features)).astype(np.float32))
    before, found = dr.thread_count(), []
    for threads in (1, 2, 3, 8):
        dr.set_thread_count(threads)
        found.append(gradients(factors, u, weights))
    dr.set_thread_count(before)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_sums_in_any_order_as_cuda_has_them_are_the_same_but_for_rounding(device, rng):
    in_order(device)
    factors = factors_of(device, "xyz", channels=8)
    u = torch.from_numpy(coordinates(rng)).float()
    weights = torch.from_numpy(rng.standard_normal((len(u), factors.num_features))).float()
    ordered = gradients(factors, u, weights)
    factors.device = replace(factors.device, name="cuda")
    for found, truth in zip(gradients(factors, u, weights), ordered, strict=True):
        assert (found - truth).abs().max() <= GRADIENT * truth.abs().max()


def test_no_samples_give_no_features_and_no_gradient(device):
    factors = factors_of(device, "xyz")
    to_planes, to_vectors = gradients(factors, torch.zeros(0, 3), torch.zeros(0, factors.num_features))
    assert to_planes.shape == factors.planes.shape
    assert not to_planes.any()
    assert not to_vectors.any()


@pytest.mark.parametrize("directions", ["z", "xyz"])
def test_gradients_of_the_twin_are_those_of_differences(directions, rng):
    factors = factors_of(TORCH, directions, grids=GRIDS[:2], channels=2).double()
    u = torch.from_numpy(coordinates(rng, 3))

    def features(planes, vectors):
        return torch.func.functional_call(factors, {"planes": planes, "vectors": vectors}, (u,))

    assert torch.autograd.gradcheck(features, (factors.planes, factors.vectors))


def test_outside_the_box_the_value_is_that_of_its_border(device, rng):
    factors = factors_of(device, "xyz")
    u = torch.from_numpy(rng.uniform(-3.0, 4.0, (200, 3)).astype(np.float32))
    assert torch.equal(factors(u), factors(u.clamp(0.0, 1.0)))


def test_the_fused_lookup_refuses_other_packets_than_its_kernel_reads(device):
    if device.module is None:
        pytest.skip("torch takes any number of channels")
    with pytest.raises(ValueError, match="the field has 3 channels, but the fused lookup reads packets of 4"):
        factors_of(device, "z", channels=3)(torch.rand(2, 3))
