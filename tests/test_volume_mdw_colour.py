"""MDW-NeRF as printed: colour weights of the position, five maps, and L1 of the density features."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from volume_models import directions, positions
from volume_scenes import BOX

from fields.device import choose_device
from fields.factors import Grid
from fields.heads import spherical_harmonics
from fields.volume.tensor import PrintedColour, ScaleWeights, TensorSettings, TensorVolume

GRIDS, DIRECTIONS, CHANNELS = [Grid(3, 4, 2), Grid(6, 8, 4)], "xyz", 4


def volume(**changes) -> TensorVolume:
    settings = TensorSettings.published(n_min=8, n_max=16, scales=2, **changes)
    return TensorVolume(BOX, settings, choose_device("torch"), appearance=2)


def test_colour_weights_are_linear_between_the_middles_of_cells_along_each_direction():
    weights = ScaleWeights(GRIDS, DIRECTIONS, CHANNELS).double()
    torch.nn.init.normal_(weights.vectors)
    u = torch.rand(20, 3, dtype=torch.float64)
    found = weights(u).detach().numpy().reshape(20, len(GRIDS), 3, CHANNELS)
    first = 0
    for n, grid in enumerate(GRIDS):
        for m in range(3):
            cells = grid.along(m)
            table = weights.vectors[first : first + cells].detach().numpy()
            middles = (np.arange(cells) + 0.5) / cells
            for k in range(CHANNELS):
                expected = np.interp(u[:, m].numpy(), middles, table[:, k])
                np.testing.assert_allclose(found[:, n, m, k], expected, rtol=1e-12, atol=1e-14)
            first += cells
    assert first == len(weights.vectors)


def test_the_colour_network_is_one_map_three_with_gelu_and_one():
    head = PrintedColour(8, hidden=5, degree=2, extra=3).double()
    features, looks, way = torch.randn(4, 8).double(), torch.randn(4, 3).double(), directions(4).double()
    found = head(features, way, looks).detach().numpy()
    maps = [layer for layer in head.network if isinstance(layer, torch.nn.Linear)]
    assert len(maps) == 5
    for k in range(4):
        x = torch.cat([features[k], spherical_harmonics(way[k : k + 1], 2)[0], looks[k]]).numpy()
        for index, layer in enumerate(maps):
            x = layer.weight.detach().numpy() @ x + layer.bias.detach().numpy()
            if 1 <= index <= 3:
                x = np.array([v * 0.5 * (1.0 + math.erf(v / math.sqrt(2.0))) for v in x])
        np.testing.assert_allclose(found[k], np.log1p(np.exp(4.0 * x)) / 4.0, rtol=1e-10)


def test_the_regulariser_is_the_mean_size_of_the_density_features_and_not_of_colours():
    model = volume(features_l1=0.5)
    torch.nn.init.normal_(model.weights.vectors)
    x = positions(30)
    expected = 0.5 * model.factors(BOX.unit(x)).abs().mean().item()
    assert model.penalty(x).item() == pytest.approx(expected)
    assert not volume(features_l1=0.0).penalty(x).any()


def test_all_of_the_printed_model_learns_and_weights_touch_colour_alone():
    model = volume()
    x, way, looks = positions(100), directions(100), torch.randn(100, 2)
    density, features = model.evaluate(x)
    (density.sum() + model.radiance(features, way, looks).square().sum()).backward()
    still = {n for n, p in model.named_parameters() if p.grad is None or not p.grad.any()}
    assert still == {f"regression.{n}.{k}" for n in ("squeeze", "excite", "gate", "fine") for k in ("weight", "bias")}
    learning = [p for group in model.rates() for p in group.parameters]
    assert {id(p) for p in learning} == {id(p) for p in model.parameters()}
    with torch.no_grad():
        model.weights.vectors.mul_(2.0)
    again, doubled = model.evaluate(x)
    assert torch.equal(again, density)
    torch.testing.assert_close(doubled, 2.0 * features)
