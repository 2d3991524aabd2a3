"""What the cloud states of itself: LE95 and the orders of IHO S-44, against their formulas."""

from __future__ import annotations

import numpy as np
import pytest
from small_bed import plane_bed
from small_report import facts_of

from survey.report.checkpoints import CE95, LE95, stated_of, table
from survey.report.figures import figures_of
from survey.report.page import cards


def test_le95_and_ce95_hold_95_percent_of_normal_errors(rng):
    errors = rng.standard_normal((200_000, 2))
    # One share of 200 000 has a standard deviation of 0.0007.
    assert (np.abs(errors[:, 0]) < LE95).mean() == pytest.approx(0.95, abs=0.003)
    assert (np.hypot(*errors.T) < CE95).mean() == pytest.approx(0.95, abs=0.003)


def test_orders_are_those_of_the_stated_uncertainty_at_95_percent():
    depth = np.full(100, 2.0)
    # At 2 m the orders allow 0.1508, 0.2504, 0.5007 and 1.0011 m, which is 1.96 standard deviations.
    std = np.r_[np.full(90, 0.15 / 1.96), np.full(6, 0.25 / 1.96), np.full(4, 3.0)]
    found = stated_of(std, depth)
    assert [(order.name, order.share_within) for order in found.orders] == [
        ("Exclusive", pytest.approx(0.90)),
        ("Special", pytest.approx(0.96)),
        ("1a and 1b", pytest.approx(0.96)),
        ("2", pytest.approx(0.96)),
    ]
    assert found.strictest.name == "Special"
    assert found.le95_m == pytest.approx(LE95 * 0.15 / 1.96)
    assert stated_of(np.full(10, 3.0), depth[:10]).strictest is None
    assert table(found)[0].rows[2][0] == "IHO S-44, vertical, Special"


def test_dry_points_and_unknown_ones_count_for_no_order():
    found = stated_of(np.array([0.05, 0.07, np.nan]), np.array([np.nan, 1.0, 1.0]))
    assert (found.points_wet, found.orders[0].share_within) == (1, 1.0)
    assert stated_of(np.array([0.05]), np.array([np.nan])).orders == ()
    assert stated_of(np.array([np.nan]), np.array([1.0])) is None
    assert table(None) == []


def test_without_a_reference_the_stated_order_is_among_the_main_figures(shallow_survey):
    figures = figures_of(facts_of(shallow_survey, plane_bed(shallow_survey, num=20)))
    (card,) = [card for card in cards(figures) if "S-44" in card.label]
    assert (card.label, card.value) == ("IHO S-44, vertical, stated", figures["stated"].strictest.name)
