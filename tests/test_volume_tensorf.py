"""TensoRF at full strength: its equations transcribed, its refinements, and a state that comes back at any level."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from volume_models import check_interface, check_learning, directions, positions
from volume_scenes import BOX

from fields.device import choose_device
from fields.factors import Factors, Grid
from fields.volume import tensorf

TORCH = choose_device("torch")
SMALL = tensorf.TensorfSettings(4, 8, features=5, hidden=16, n_min=6, n_max=24, refined_at=(0.25, 0.5), steps=8)


def volume(settings: tensorf.TensorfSettings = SMALL, *, appearance: int = 0, seed: int = 0) -> tensorf.TensorfVolume:
    torch.manual_seed(seed)
    return tensorf.TensorfVolume(BOX, settings, TORCH, appearance=appearance)


def linear(table: np.ndarray, at: float) -> np.ndarray:
    """Value of a table (cells, ...) at a coordinate from 0 to 1; values lie in the middle of the cells."""
    place = min(max(at * len(table) - 0.5, 0.0), len(table) - 1.0)
    left = min(int(place), len(table) - 2)
    return (1.0 - (place - left)) * table[left] + (place - left) * table[left + 1]


def products(factors: Factors, u: np.ndarray) -> np.ndarray:
    """v_m(x_m) M_m(x_a, x_b) of each direction (3, channels)."""
    found = []
    for m, plane, vector in zip(range(3), tensorf.planes_of(factors), tensorf.vectors_of(factors), strict=True):
        a, b = (k for k in range(3) if k != m)
        rows = linear(plane.detach().double().numpy(), u[b])
        found.append(linear(vector.detach().double().numpy(), u[m]) * linear(rows, u[a]))
    return np.stack(found)


def test_density_and_colour_are_those_of_the_equations():
    model = volume().double()
    x, d = positions(6, dtype=torch.float64), directions(6, dtype=torch.float64)
    density, features = model.evaluate(x)
    colour = model.radiance(features, d, None).detach().numpy()
    weights = [(k.weight.detach().numpy(), k.bias.detach().numpy()) for k in model.network if hasattr(k, "weight")]
    for i in range(6):
        u = (x[i].numpy() - BOX.low) / BOX.size
        raw = products(model.density, u).sum() + np.log(np.expm1(1.0 / 24))
        assert density[i].item() == pytest.approx(np.log1p(np.exp(raw)) * 24 / BOX.edge, rel=1e-6)
        feature = model.basis.weight.detach().numpy() @ products(model.colour, u).ravel()
        h = np.concatenate(
            [np.concatenate([v, np.sin(v), np.cos(v), np.sin(2 * v), np.cos(2 * v)]) for v in (feature, -d[i].numpy())]
        )
        for number, (weight, bias) in enumerate(weights):
            h = weight @ h + bias
            h = np.maximum(h, 0.0) if number < 2 else np.log1p(np.exp(4.0 * h)) / 4.0
        np.testing.assert_allclose(colour[i], h, rtol=1e-6)


def test_the_penalty_is_that_of_the_equation():
    torch.manual_seed(3)
    factors = Factors([Grid(3, 4, 5)], "xyz", 4, TORCH)
    planes = [t.detach().numpy() for t in tensorf.planes_of(factors)]
    expected = 0.01 * sum(2.0 * (((p[1:] - p[:-1]) ** 2).mean() + ((p[:, 1:] - p[:, :-1]) ** 2).mean()) for p in planes)
    assert tensorf.total_variation(factors).item() == pytest.approx(expected, rel=1e-5)


def test_smaller_cells_hold_the_same_linear_function():
    factors = Factors([Grid(6, 6, 6)], "xyz", 4, TORCH)
    with torch.no_grad():
        middle = (torch.arange(6) + 0.5) / 6
        factors.vectors.fill_(1.0)
        for plane in tensorf.planes_of(factors):
            plane.copy_((2.0 * middle[:, None] - middle[None, :])[..., None].expand(-1, -1, 4))
    u = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) * 0.6 + 0.2
    torch.testing.assert_close(tensorf.resampled(factors, Grid(12, 15, 18))(u), factors(u), rtol=0, atol=1e-5)


def test_cells_become_smaller_at_their_shares_of_the_training():
    model, losses, levels = volume(), [], []
    for step in range(8):
        losses.append(1.0)
        changed = model.observe(losses)
        levels.append(model.density.grids[0].nx)
        assert changed == (step + 1 in (2, 4))
    assert levels == [6, 12, 12, 24, 24, 24, 24, 24]
    assert {id(p) for g in model.rates() for p in g.parameters} == {id(p) for p in model.parameters()}


def test_cells_do_not_become_larger_again_where_a_training_goes_on_for_more_steps():
    short, longer = volume(), volume(replace(SMALL, steps=10 * SMALL.steps))
    short.observe([1.0] * SMALL.steps)
    longer.load_state_dict(short.state_dict())
    assert not longer.observe([1.0] * (SMALL.steps + 1))
    assert longer.density.grids[0].nx == short.density.grids[0].nx == 24


def test_a_state_comes_back_at_any_level():
    first = volume(seed=1)
    first.observe([1.0] * 5)
    second = volume(seed=2)
    second.load_state_dict(first.state_dict())
    x = positions(20)
    assert torch.equal(first.evaluate(x)[0], second.evaluate(x)[0])
    assert torch.equal(first.penalty(x), second.penalty(x))


def test_the_weight_of_the_penalty_falls_to_a_tenth():
    model = volume(tensorf.TensorfSettings(4, 4, n_min=6, n_max=6, refined_at=(), tv_colour=0.0, steps=10))
    before = model.penalty(positions(1)).item()
    model.observe([1.0] * 10)
    assert model.penalty(positions(1)).item() == pytest.approx(0.1 * before, rel=1e-6)


def test_it_is_a_volume_model():
    check_interface(lambda appearance: tensorf.TensorfVolume(BOX, SMALL, TORCH, appearance=appearance))


def test_it_learns_a_bed_under_water():
    settings = tensorf.TensorfSettings(4, 12, n_min=12, n_max=24, steps=40)
    check_learning(
        lambda appearance: tensorf.TensorfVolume(BOX, settings, TORCH, appearance=appearance), steps=40, share=0.6
    )
