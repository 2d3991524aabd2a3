"""Parts of the training of fields: groups, losses, and the water in front of the bed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from fields.volume.model import Rates, has_converged
from fields.volume.train import adam, descend, psnr_db, set_rates
from fields.water_column import WaterColumn


def test_groups_move_by_their_share():
    bed, colour = (nn.Parameter(torch.zeros(1)) for _ in range(2))
    optimiser = adam([Rates([bed], 0.1), Rates([], 1.0), Rates([colour], 0.4)], eps=1e-15)
    set_rates(optimiser, 0.5)
    descend(optimiser, (bed - 1.0).square().sum() + (colour - 1.0).square().sum())
    # The first step of Adam is its rate, whatever the slope.
    assert (bed.item(), colour.item()) == (pytest.approx(0.05), pytest.approx(0.2))
    set_rates(optimiser, 1.0)
    assert [group["lr"] for group in optimiser.param_groups] == [0.1, 0.4]


def test_losses_have_converged_once_they_vary_little_against_the_first_ones():
    falling, even = [1.0 - 0.1 * k for k in range(10)], [0.1, 0.11] * 5
    assert not has_converged(falling + even[:-1], 10, 0.01)  # too few to compare
    assert has_converged(falling + even, 10, 0.01)
    assert not has_converged(falling + falling, 10, 0.01)


def test_an_error_of_a_tenth_is_twenty_decibels():
    assert psnr_db([0.02, 0.0]) == pytest.approx(20.0)


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
