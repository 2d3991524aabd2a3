"""Ground planes and the perceptron beside them: equations against loops, the second stage, learning."""

from __future__ import annotations

import numpy as np
import torch
from volume_models import check_learning, directions, positions, require_rates
from volume_scenes import BOX

from fields.device import choose_device
from fields.heads import spherical_harmonics
from fields.volume.ground_plane import GRID_EVERY, GroundPlaneSettings, GroundPlaneVolume
from fields.volume.mlp import frequency_encoding

SMALL = {"scales": 2, "channels": 4, "n_min": 4, "n_max": 8, "hidden": 6, "steps": 10}


def volume(appearance: int = 0, **changes) -> GroundPlaneVolume:
    torch.manual_seed(0)
    model = GroundPlaneVolume(
        BOX, GroundPlaneSettings(**(SMALL | changes)), choose_device("torch"), appearance=appearance
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
    sines = frequency_encoding(BOX.centred(x), 6).numpy()
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
    model = GroundPlaneVolume(BOX, GroundPlaneSettings(**SMALL), choose_device("torch"))
    x = positions(20)
    before = model.evaluate(x)[0]
    assert [model.observe([0.1] * step) for step in range(1, 6)] == [False, False, False, True, False]
    assert torch.equal(model.evaluate(x)[0], before)
    for parameter in model.nerf_density.parameters():
        torch.nn.init.normal_(parameter)
    alone = []
    for step in range(4, 4 + 2 * GRID_EVERY):
        model.observe([0.1] * step)
        thickness = model.thickness(x, directions(20), torch.ones(20))[0]
        alone.append(torch.allclose(thickness, before))
    assert alone == [step % GRID_EVERY == 0 for step in range(4, 4 + 2 * GRID_EVERY)]
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
    def make(appearance: int) -> GroundPlaneVolume:
        settings = GroundPlaneSettings(scales=2, n_min=8, n_max=24, hidden=16, degree=0, steps=60)
        return GroundPlaneVolume(BOX, settings, choose_device("torch"), appearance=appearance)

    assert check_learning(make, steps=60, share=0.5).model.is_joint
