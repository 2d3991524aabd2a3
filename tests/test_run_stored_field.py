"""A trained field on disk: bit for bit there and back, and one sentence where it is damaged."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
import pytest
import torch
from plane_field import field_over, level_slab, rays_at
from plane_survey import TILTED, PlaneBed, ring

from fields.slab.tensor_field import FieldFigures, TensorField
from survey.errors import SurveyError
from survey.run.stored import FIELD_FILE, FIGURES_FILE
from survey.run.stored_field import load_field, save_field

FIGURES = FieldFigures(300, 614400, 101, 31.5, 0.01, 26383)


def learned(device, **settings) -> TensorField:
    """A field in its fine stage with something in every parameter."""
    slab = level_slab(-2.0, slope_x=0.1)
    slab.known[3, 4] = False
    field = field_over(slab, device, **settings)
    field.density.switch_to_fine()
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape))
    return field


GIVEN = {"given": {"absorption": (0.3, 0.1, 0.05), "veil": (0.0, 0.1, 0.2)}}


@pytest.mark.parametrize(
    "settings",
    [{}, {"samples": 5, "water": False}, {"scales": 2, "coarsening": 4.0}, GIVEN],
    ids=["wet", "dry", "small", "given"],
)
def test_a_field_comes_back_bit_for_bit(tmp_path, device, settings):
    field = learned(device, **settings)
    save_field(tmp_path, field, FIGURES)
    back = load_field(tmp_path, device)
    assert back.settings == field.settings
    assert back.density.is_fine
    assert (back.column is None) == (field.column is None)
    state = field.state_dict()
    assert back.state_dict().keys() == state.keys()
    for name, value in back.state_dict().items():
        assert torch.equal(value, state[name]), name
    for name in ("low", "proxy", "known"):
        found, stored = getattr(back.slab, name), getattr(field.slab, name)
        assert found.dtype == stored.dtype
        np.testing.assert_array_equal(found, stored)
    assert (back.slab.cell, back.slab.half) == (field.slab.cell, field.slab.half)
    rays = rays_at(PlaneBed(TILTED, -2.0), ring(2)[1], -2.0)
    for one, other in zip(field.render(rays, jitter=False), back.render(rays, jitter=False), strict=True):
        assert torch.equal(one, other)


def test_a_field_in_its_coarse_stage_stays_there(tmp_path, device):
    field = field_over(level_slab(-2.0), device)
    save_field(tmp_path, field, FIGURES)
    assert not load_field(tmp_path, device).density.is_fine


def test_the_figures_lie_beside_it_as_json(tmp_path, device):
    save_field(tmp_path, learned(device), FIGURES)
    assert json.loads((tmp_path / FIGURES_FILE).read_text(encoding="utf-8")) == asdict(FIGURES)
    assert sorted(p.name for p in tmp_path.iterdir()) == [FIGURES_FILE, FIELD_FILE]


def flipped(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes(b ^ 0xFF for b in data[middle : middle + 16]) + data[middle + 16 :]


DAMAGES = {
    "cut short": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
    "another file": lambda data: b"not a field at all",
    "flipped bits": flipped,
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_a_damaged_file_is_named_with_the_mend(tmp_path, device, damage):
    save_field(tmp_path, learned(device), FIGURES)
    path = tmp_path / FIELD_FILE
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(SurveyError, match=r"field\.pt cannot be read .*; delete its folder and run `bathynerf") as info:
        load_field(tmp_path, device)
    assert "\n" not in str(info.value)


@pytest.mark.parametrize("change", [{"settings": {"unknown": 1}}, {"state": {}}, {"slab": {"cell": 1.0}}])
def test_a_field_of_another_make_is_refused(tmp_path, device, change):
    save_field(tmp_path, learned(device), FIGURES)
    path = tmp_path / FIELD_FILE
    torch.save(torch.load(path, weights_only=True) | change, path)
    with pytest.raises(SurveyError, match=r"field\.pt cannot be read"):
        load_field(tmp_path, device)


def test_a_missing_file_is_named(tmp_path, device):
    with pytest.raises(SurveyError, match=r"field\.pt cannot be read"):
        load_field(tmp_path, device)
