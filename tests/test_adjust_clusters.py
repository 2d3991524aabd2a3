"""What neighbouring observations share: the design effect."""

from __future__ import annotations

import numpy as np
import pytest

from survey.adjust.clusters import inflation
from survey.photos.tie_points import TiePoints

SIZES = [(1000, 800)] * 4
STD = np.array([0.5, 0.3])


def spread(rng, per_view: int) -> TiePoints:
    """As many points as observations, anywhere in four photographs."""
    view = np.repeat(np.arange(4), per_view)
    pixel = rng.uniform(0.0, (1000.0, 800.0), (len(view), 2))
    return TiePoints(np.zeros((len(view), 3)), np.arange(len(view)), view, pixel)


def test_independent_residuals_count_in_full(rng):
    ties = spread(rng, 1500)
    found = inflation(ties, rng.normal(0.0, STD[0], (6000, 2)), STD, np.zeros(6000, int), SIZES)
    assert (found >= 1.0).all()
    assert found.max() < 1.3


@pytest.mark.parametrize("rho", [0.3, 1.0])
def test_shared_residuals_count_as_the_design_effect_of_their_squares(rng, rho):
    ties = spread(rng, 1500)
    # The same error for all in a square of 0.16 of the width.
    _, square = np.unique(np.column_stack([ties.view, np.floor(ties.pixel / 160.0)]), axis=0, return_inverse=True)
    square = square.ravel()
    shared = rng.normal(0.0, 1.0, (square.max() + 1, 2))[square]
    residuals = STD[0] * (np.sqrt(rho) * shared + np.sqrt(1.0 - rho) * rng.normal(size=shared.shape))
    found = inflation(ties, residuals, STD, np.zeros(6000, int), SIZES)
    count = np.bincount(square)
    expected = 1.0 + (np.sum(count**2) / count.sum() - 1.0) * rho
    # 140 squares know a correlation to about a tenth.
    assert found[0] == pytest.approx(expected, rel=0.25)


def test_each_kind_has_a_factor_of_its_own(rng):
    ties, kind = spread(rng, 1000), np.tile([0, 1], 2000)
    residuals = rng.normal(0.0, 1.0, (4000, 2)) * STD[kind][:, None]
    cell = np.floor(ties.pixel / 160.0) @ [1.0, 7.0]
    shared = np.where(np.sin(12.9898 * cell + ties.view) > 0.0, 1.0, -1.0)
    residuals[kind == 1] = STD[1] * shared[kind == 1, None]
    found = inflation(ties, residuals, STD, kind, SIZES)
    assert found[kind == 0].max() < 1.5
    assert found[kind == 1].min() > 5.0


def test_alone_in_their_squares_observations_share_nothing():
    ties = TiePoints(np.zeros((2, 3)), np.arange(2), np.array([0, 1]), np.full((2, 2), 50.0))
    np.testing.assert_array_equal(inflation(ties, np.ones((2, 2)), STD, np.zeros(2, int), SIZES), 1.0)
