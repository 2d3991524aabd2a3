"""What trainings share: groups of parameters with rates of their own, and when losses have converged."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from fields.training import Rates, adam, descend, has_converged, psnr_db, set_rates


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
