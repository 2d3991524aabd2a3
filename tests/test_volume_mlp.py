"""Perceptrons: the encoding in closed form, networks and ground planes against slow ones, two stages, learning."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from volume_models import check_interface, check_learning, directions, positions, require_rates
from volume_scenes import BOX

from fields.device import choose_device
from fields.heads import spherical_harmonics
from fields.volume import mlp
from fields.volume.model import density_of

SMALL = mlp.MlpSettings(layers=3, width=48, skip=1, frequencies=5, direction_frequencies=2)
TINY = replace(mlp.tinynerf.keywords["settings"], width=64)


def encoded(p, frequencies: int) -> np.ndarray:
    waves = [p] + [f(2.0**k * math.pi * p) for f in (np.sin, np.cos) for k in range(frequencies)]
    return np.concatenate(waves)


def linear(layer: torch.nn.Linear, x: np.ndarray) -> np.ndarray:
    return layer.weight.detach().numpy() @ x + layer.bias.detach().numpy()


def test_the_encoding_is_the_position_and_its_waves(rng):
    p = rng.uniform(-1.0, 1.0, (20, 3))
    found = mlp.frequency_encoding(torch.from_numpy(p), 4).numpy()
    assert found.shape == (20, mlp.encoded_length(4)) == (20, 27)
    for value, one in zip(found, p, strict=True):
        np.testing.assert_allclose(value, encoded(one, 4), atol=1e-14)  # of sines of up to 8 pi


@pytest.mark.parametrize("settings", [SMALL, TINY], ids=["nerf", "tiny"])
def test_density_and_colour_are_those_of_a_slow_twin(settings):
    torch.manual_seed(0)
    model = mlp.MlpVolume(BOX, settings, appearance=2).double()
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
    check_interface(lambda appearance: mlp.MlpVolume(BOX, settings, appearance=appearance))


@pytest.mark.parametrize("settings", [SMALL, TINY], ids=["nerf", "tiny"])
def test_it_learns_a_bed_under_water(settings):
    check_learning(lambda appearance: mlp.MlpVolume(BOX, settings, appearance=appearance), steps=60, share=0.5)


SMALL_GROUND = {"scales": 2, "channels": 4, "n_min": 4, "n_max": 8, "hidden": 6, "steps": 10}


def volume(appearance: int = 0, **changes) -> mlp.GroundPlaneVolume:
    torch.manual_seed(0)
    model = mlp.GroundPlaneVolume(
        BOX, mlp.GroundPlaneSettings(**(SMALL_GROUND | changes)), choose_device("torch"), appearance=appearance
    )
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return model


def relu_network(layers, x: np.ndarray) -> np.ndarray:
    maps = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
    for index, layer in enumerate(maps):
        x = layer.weight.detach().numpy() @ x + layer.bias.detach().numpy()
        if index < len(maps) - 1:
            x = np.maximum(x, 0.0)
    return x


def test_both_branches_are_their_equations():
    model = volume(appearance=2)
    x, way, looks = positions(10), directions(10), torch.randn(10, 2)
    planes = model.factors(BOX.unit(x)).detach().numpy()
    sines = mlp.frequency_encoding(BOX.centred(x), 6).numpy()
    harmonics = spherical_harmonics(-way, 2).numpy()
    for joint in (False, True):
        model.is_joint = joint
        density, features = model.evaluate(x)
        colour = model.radiance(features, way, looks).detach().numpy()
        for k in range(10):
            beside = np.concatenate([harmonics[k], looks[k].numpy()])
            raw = relu_network([model.density], planes[k])[0] + np.log(np.expm1(1.0 / 8))
            light = relu_network(model.colour, np.concatenate([planes[k], beside]))
            if joint:
                hidden = np.maximum(relu_network(model.nerf, np.concatenate([planes[k], sines[k]])), 0.0)
                raw += relu_network([model.nerf_density], hidden)[0]
                light = light + relu_network(model.nerf_colour, np.concatenate([hidden, beside]))
            np.testing.assert_allclose(density[k].item(), np.log1p(np.exp(raw)) * 8 / BOX.edge, rtol=2e-5)
            np.testing.assert_allclose(colour[k], np.log1p(np.exp(4.0 * light)) / 4.0, rtol=2e-5)


def test_planes_lie_over_the_ground_with_a_vector_along_z():
    model = volume()
    assert [(axis, a, b) for axis, a, b, *_ in model.factors.cells()] == [(2, 0, 1), (2, 0, 1)]


def test_the_second_stage_begins_where_the_first_ends_and_planes_are_rendered_alone_now_and_then():
    torch.manual_seed(0)
    model = mlp.GroundPlaneVolume(BOX, mlp.GroundPlaneSettings(**SMALL_GROUND), choose_device("torch"))
    x = positions(20)
    before = model.evaluate(x)[0]
    assert [model.observe([0.1] * step) for step in range(1, 6)] == [False, False, False, True, False]
    assert torch.equal(model.evaluate(x)[0], before)
    for parameter in model.nerf_density.parameters():
        torch.nn.init.normal_(parameter)
    alone = []
    for step in range(4, 4 + 2 * mlp.GRID_EVERY):
        model.observe([0.1] * step)
        thickness = model.thickness(x, directions(20), torch.ones(20))[0]
        alone.append(torch.allclose(thickness, before))
    assert alone == [step % mlp.GRID_EVERY == 0 for step in range(4, 4 + 2 * mlp.GRID_EVERY)]
    with torch.no_grad():
        assert not torch.allclose(model.thickness(x, directions(20), torch.ones(20))[0], before)


def test_every_parameter_has_a_rate_and_learns_in_the_second_stage():
    model = volume()
    model.is_joint, model._step = True, 1
    x, way = positions(60), directions(60)
    thickness, features = model.thickness(x, way, torch.ones(60))
    (thickness.sum() + model.radiance(features, way, None).sum()).backward()
    assert [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()] == []
    require_rates(model)


def test_it_learns_a_bed_in_both_stages():
    def make(appearance: int) -> mlp.GroundPlaneVolume:
        settings = mlp.GroundPlaneSettings(scales=2, n_min=8, n_max=24, hidden=16, degree=0, steps=60)
        return mlp.GroundPlaneVolume(BOX, settings, choose_device("torch"), appearance=appearance)

    assert check_learning(make, steps=60, share=0.5).model.is_joint
