"""The water column: its equation, its ends, and what of it is learned."""

from __future__ import annotations

import numpy as np
import torch

from fields.water_column import WaterColumn


def test_the_water_column_absorbs_and_veils_and_its_surface_reflects(rng):
    column = WaterColumn().double()
    with torch.no_grad():
        for parameter in column.parameters():
            parameter.copy_(torch.from_numpy(rng.standard_normal(3)))
    bed, length, r = torch.tensor([[0.6, 0.4, 0.2]]).double(), torch.tensor([2.5]).double(), torch.tensor([0.03])
    a, veil, sky = (
        np.log1p(np.exp(p.detach().numpy())) for p in (column.raw_absorption, column.raw_veil, column.raw_sky)
    )
    kept = np.exp(-a * 2.5)
    below = kept * (0.6, 0.4, 0.2) + (1.0 - kept) * veil
    np.testing.assert_allclose(column(bed, length, r.double())[0].detach(), 0.97 * below + 0.03 * sky, rtol=1e-6)


def test_of_each_pair_what_is_given_is_a_constant_and_what_is_not_is_learned():
    known = {"absorption": (0.2, 0.1, 0.3), "veil": (0.0, 0.1, 0.2)}
    for given in ({}, {"absorption": known["absorption"]}, {"veil": known["veil"]}, known):
        column = WaterColumn(**given)
        learned = {f"raw_{name}" for name in known.keys() - given.keys()} | {"raw_sky"}
        assert {name for name, _ in column.named_parameters()} == learned
        assert column.state_dict().keys() == learned | {f"given_{name}" for name in given}
        for name, value in given.items():
            torch.testing.assert_close(getattr(column, name), torch.tensor(value))


def test_no_water_shows_the_bed_and_endless_water_the_veil():
    column = WaterColumn()
    bed = torch.rand(4, 3)
    dark = torch.zeros(4)
    torch.testing.assert_close(column(bed, torch.zeros(4), dark), bed)
    veil = torch.nn.functional.softplus(column.raw_veil).expand(4, 3)
    torch.testing.assert_close(column(bed, torch.full((4,), 1e4), dark), veil)


def test_water_begins_as_clear_coastal_water_and_takes_red_first():
    torch.testing.assert_close(WaterColumn().absorption.detach(), torch.tensor([0.3, 0.07, 0.05]))
