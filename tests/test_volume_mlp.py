"""NeRF and TinyNeRF: the encoding in closed form, the networks against a slow one, sizes of the papers, learning."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from volume_models import check_interface, check_learning, directions, positions
from volume_scenes import BOX

from fields.volume.mlp import MlpSettings, MlpVolume, encoded_length, frequency_encoding, tinynerf
from fields.volume.model import density_of

SMALL = MlpSettings(layers=3, width=48, skip=1, frequencies=5, direction_frequencies=2)
TINY = replace(tinynerf.keywords["settings"], width=64)


def encoded(p, frequencies: int) -> np.ndarray:
    waves = [p] + [f(2.0**k * math.pi * p) for f in (np.sin, np.cos) for k in range(frequencies)]
    return np.concatenate(waves)


def linear(layer: torch.nn.Linear, x: np.ndarray) -> np.ndarray:
    return layer.weight.detach().numpy() @ x + layer.bias.detach().numpy()


def test_the_encoding_is_the_position_and_its_waves(rng):
    p = rng.uniform(-1.0, 1.0, (20, 3))
    found = frequency_encoding(torch.from_numpy(p), 4).numpy()
    assert found.shape == (20, encoded_length(4)) == (20, 27)
    for value, one in zip(found, p, strict=True):
        np.testing.assert_allclose(value, encoded(one, 4), atol=1e-14)  # of sines of up to 8 pi


@pytest.mark.parametrize("settings", [SMALL, TINY], ids=["nerf", "tiny"])
def test_density_and_colour_are_those_of_a_slow_twin(settings):
    torch.manual_seed(0)
    model = MlpVolume(BOX, settings, appearance=2).double()
    x, d = positions(5, dtype=torch.float64), directions(5, dtype=torch.float64)
    look = torch.tensor([[0.5, -1.0]]).double().expand(5, -1)
    density, features = model.evaluate(x)
    colour = model.radiance(features, d, look)
    middle, half = 0.5 * (BOX.low + BOX.high), 0.5 * BOX.edge
    for i in range(5):
        position = encoded((x[i].numpy() - middle) / half, settings.frequencies)
        h = position
        for index, layer in enumerate(model.trunk):
            h = np.maximum(linear(layer, h), 0.0)
            if index == settings.skip:
                h = np.concatenate([position, h])
        cells = 2.0**settings.frequencies
        raw = linear(model.density, h)[0] + math.log(math.exp(1.0 / cells) - 1.0)
        assert density[i].item() == pytest.approx(math.log1p(math.exp(raw)) * cells / BOX.edge, rel=1e-10)
        if settings.direction_frequencies:
            way = encoded(d[i].numpy(), settings.direction_frequencies)
            first, _, last = model.colour
            seen = np.concatenate([linear(model.bottleneck, h), way, look[i]])
            out = linear(last, np.maximum(linear(first, seen), 0.0))
        else:
            out = linear(model.colour, np.concatenate([h, look[i]]))
        np.testing.assert_allclose(colour[i].detach(), np.log1p(np.exp(4.0 * out)) / 4.0, rtol=1e-10)


@pytest.mark.parametrize("cells", [1, 64, 2048])
def test_raw_numbers_of_zero_let_a_share_of_one_by_e_through_the_edge(cells):
    density = density_of(torch.zeros(1, dtype=torch.float64), cells, 3.7)
    assert math.exp(-float(density) * 3.7) == pytest.approx(math.exp(-1.0), rel=1e-12)


@pytest.mark.parametrize("settings", [SMALL, TINY], ids=["nerf", "tiny"])
def test_it_is_a_volume_model(settings):
    check_interface(lambda appearance: MlpVolume(BOX, settings, appearance=appearance))


@pytest.mark.parametrize("settings", [SMALL, TINY], ids=["nerf", "tiny"])
def test_it_learns_a_bed_under_water(settings):
    check_learning(lambda appearance: MlpVolume(BOX, settings, appearance=appearance), steps=60, share=0.5)
