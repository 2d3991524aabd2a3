"""VM, DW, M and MDW-NeRF as one model: what differs, the switch from coarse to fine and what is stored."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from volume_models import positions, store_and_load
from volume_scenes import BOX

from fields.device import choose_device
from fields.factors import Grid
from fields.volume.paths import Box
from fields.volume.tensor import TensorSettings, TensorVolume, dw, grid_of, m, mdw, vm

KINDS = {name: make.keywords["settings"] for name, make in (("vm", vm), ("dw", dw), ("m", m), ("mdw", mdw))}
SMALL = {"n_min": 8, "n_max": 32}


def volume(kind: str = "mdw", *, appearance: int = 0, seed: int = 0, **changes) -> TensorVolume:
    torch.manual_seed(seed)
    return TensorVolume(BOX, replace(KINDS[kind], **(SMALL | changes)), choose_device("torch"), appearance=appearance)


def test_the_four_models_differ_by_scales_and_weighting_alone():
    table = {kind: (s.scales, s.weighting) for kind, s in KINDS.items()}
    assert table == {"vm": (1, False), "dw": (1, True), "m": (6, False), "mdw": (6, True)}
    assert (TensorSettings().n_min, TensorSettings().n_max) == (64, 256)


def test_grids_follow_the_box():
    assert grid_of(Box(np.zeros(3), np.array([4.0, 2.0, 0.01])), 64.0) == Grid(64, 32, 2)
    cells = volume().factors.grids
    assert [g.nx for g in cells] == [8, 11, 14, 18, 24, 32]
    assert [g.nz for g in cells] == [6, 8, 10, 14, 18, 24]


def test_density_is_the_sum_over_directions_regressed_as_the_docstring_says():
    model = volume(scales=2, channels=4)
    x = positions(20)
    density, features = model.evaluate(x)
    a = features.detach().numpy().astype(np.float64).reshape(20, 2, 3, 4)  # scales, directions, channels
    weight = model.regression.coarse.weight.detach().numpy().astype(np.float64)[0]
    raw = a.sum(axis=2).reshape(20, 8) @ weight + np.log(np.expm1(1.0 / 32))
    np.testing.assert_allclose(density.detach(), np.log1p(np.exp(raw)) * 32 / BOX.edge, rtol=1e-5)


def test_the_weighting_network_takes_over_without_a_step_and_with_its_own_rates():
    model = volume(switch_window=5, fine_rate=0.003)
    x = positions(200)
    before = model.evaluate(x)[0].detach()
    coarse = {id(p): g.rate for g in model.rates() for p in g.parameters}
    still = [1.0, 2.0, 1.0, 2.0, 1.0]
    assert not model.observe(still)
    assert not model.observe([*still, 1.0, 1.1, 1.0, 1.1, 1.0])  # noise of 1 % of the variance is 0.0024
    assert model.observe([*still, 1.0, 1.01, 1.0, 1.01, 1.0])
    assert model.regression.is_fine
    torch.testing.assert_close(model.evaluate(x)[0], before, rtol=1e-4, atol=0)
    fine = {id(p): g.rate for g in model.rates() for p in g.parameters}
    assert set(fine) == set(coarse) == {id(p) for p in model.parameters()}
    planes = id(model.factors.planes)
    assert (coarse[planes], fine[planes]) == (0.02, 0.003)
    assert TensorSettings().fine_rate == 0.001
    assert not model.observe(still * 4)


@pytest.mark.parametrize("kind", ["m", "vm"])
def test_models_without_weighting_never_switch(kind):
    model = volume(kind, switch_window=5)
    assert not model.observe([1.0, 2.0, 1.0, 2.0, 1.0] + [1.0] * 5)


def test_every_parameter_learns_before_or_after_the_switch():
    model = volume(appearance=3)
    x, looks = positions(200), torch.randn(200, 3)
    direction = torch.nn.functional.normalize(torch.randn(200, 3), dim=1)
    for fine in (False, True):
        if fine:
            model.regression.switch_to_fine()
            with torch.no_grad():  # the gates start without weights, behind which nothing would learn in the first step
                model.regression.gate.weight.normal_(std=0.1)
        model.zero_grad()
        density, features = model.evaluate(x)
        (density.sum() + model.radiance(features, direction, looks).sum()).backward()
        still = {n for n, p in model.named_parameters() if p.grad is None or not p.grad.any()}
        expected = {f"regression.{n}.{k}" for n in (("coarse",) if fine else ("squeeze", "excite", "gate", "fine"))
                    for k in ("weight", "bias")}  # fmt: skip
        assert still == expected


def test_colour_depends_on_the_direction_unless_the_scene_is_matt():
    x = positions(200)
    down, aside = (torch.tensor([d]).expand(200, 3) for d in ([0.0, 0.0, -1.0], [0.6, 0.0, -0.8]))
    for degree, changes in ((0, False), (2, True)):
        model = volume(degree=degree)
        _, features = model.evaluate(x)
        differs = not torch.equal(model.radiance(features, down, None), model.radiance(features, aside, None))
        assert differs is changes


def test_a_stored_model_comes_back_bit_for_bit_with_its_stage():
    model, other = volume(), volume(seed=7)
    model.regression.switch_to_fine()
    store_and_load(model, other)
    x = positions(200)
    assert other.regression.is_fine
    assert torch.equal(model.evaluate(x)[0], other.evaluate(x)[0])
    assert torch.equal(copy.deepcopy(model).evaluate(x)[1], other.evaluate(x)[1])
