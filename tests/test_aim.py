"""What a run may be asked for in place of a quality: its recipes, the next round, the time that is left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fields.sweep.bed import BedPoints
from survey.errors import SurveyError
from survey.plan.plan import image_scale
from survey.plan.recipe import Aim, aim_of, recipes_for
from survey.run.aimed_run import (
    DEPTH,
    FEW,
    NOISE,
    AimedRun,
    CellStd,
    FullSizeAmounts,
    RoundRates,
    samples,
    std_cells,
)
from survey.run.clock import Clock, OutOfTimeError

GROUND = FullSizeAmounts(photographs_mpx=10.0, map_px=10e6, points=1e6, poses="fixed", num_views=10)
# A machine on which all rates are easy to count with.
PACE = RoundRates(sample_s=1e-8, images_s=1.0, slowdown=1.0, point_s=1e-5)
RECIPES = recipes_for([(1024, 768)])
SCALES = (0.25, 0.25, 0.5, 0.5, 1.0, 1.0)


class Hand:
    """A clock that a test sets."""

    def __init__(self):
        self.seconds = 1000.0

    def __call__(self) -> float:
        return self.seconds


def aimed(aim: Aim, *, number: int, left_s: float | None = None) -> AimedRun:
    clock = None if left_s is None else Clock(left_s, now=Hand())
    return AimedRun(aim, RECIPES, SCALES, GROUND, clock, number, PACE)


def cells(std: list[float], *, num_views: float = 8.0, depth: list[float] | None = None) -> CellStd:
    count = len(std)
    depth = [2.0] * count if depth is None else depth
    return CellStd(np.zeros((count, 3)), np.array(std), np.full(count, num_views), np.array(depth))


def bed(xyz: np.ndarray, std: np.ndarray, num_views: list[int], depth: list[float]) -> BedPoints:
    count = len(xyz)
    rgb, wet = np.zeros((count, 3), dtype=np.uint8), np.ones(count, dtype=bool)
    return BedPoints(xyz, rgb, std, np.array(num_views), np.array(depth), np.zeros(count), wet)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"std_m": 0.0}, "--target-std is 0, expected a number above zero, in m"),
        ({"seconds": -5.0}, "--time-budget is -5, expected a number above zero, in s"),
        ({"seconds": float("nan")}, "--time-budget is nan"),
        ({"std_m": 0.01, "quality": "fine"}, "--quality fine is a fixed recipe"),
        ({"std_m": 0.01, "field": "slab"}, "--field slab and an aim"),
        ({"std_m": 0.01, "scale": 0.5}, "--image-scale 0.5 and an aim"),
    ],
)
def test_an_aim_that_cannot_be_is_refused(options, words):
    with pytest.raises(SurveyError, match=words):
        aim_of(**({"std_m": None, "seconds": None, "quality": None, "field": "auto"} | options))


def test_without_a_target_or_a_time_there_is_no_aim():
    assert aim_of(None, None, quality="fine", field="slab") is None
    assert str(aim_of(0.01, 120.0, quality=None, field="auto")) == (
        "a standard deviation of 10.0\u00a0mm on 95 % of the ground in at most 120 s"
    )


def test_recipes_halve_the_images_down_to_what_can_be_matched():
    found = [(image_scale(1024, 768, recipe.megapixels), recipe.field) for recipe in RECIPES]
    assert found == [(scale, field) for scale in (0.25, 0.5, 1.0) for field in ("off", "solver")]
    assert len(recipes_for([(160, 120)])) == 2
    assert len({recipe.times_seen for recipe in RECIPES}) == 1


def test_recipes_for_several_sizes_are_those_of_the_smallest_in_which_all_are_matched():
    found = recipes_for([(4000, 3000), (1024, 768)])
    assert len(found) == len(RECIPES)
    assert found[-1].megapixels == pytest.approx(12.0)


def test_a_round_goes_on_where_the_ground_is_above_the_target_and_as_far_as_it_needs():
    halved = aimed(Aim(std_m=0.01), number=3)
    assert halved.next_recipe(cells([0.009] * 96 + [0.03] * 4))[0] is None
    assert halved.next_recipe(cells([0.015] * 100))[0] == 5
    quarter = aimed(Aim(std_m=0.01), number=1)
    assert quarter.next_recipe(cells([0.015] * 100))[0] == 3
    assert quarter.next_recipe(cells([0.03] * 100))[0] == 5


def test_a_target_that_no_round_comes_near_to_ends_the_work():
    following, why = aimed(Aim(std_m=0.001), number=3).next_recipe(cells([0.1] * 100, num_views=2.0))
    assert following is None
    assert why.endswith(f"further rounds would not help, the rest is limited by {FEW}")
    assert aimed(Aim(std_m=0.001), number=5).next_recipe(cells([0.0015] * 100))[0] is None


def test_a_time_takes_the_best_that_fits_and_ends_where_nothing_is_left_to_win():
    budget = Aim(seconds=500.0)
    assert aimed(budget, number=0, left_s=1000.0).next_recipe(None)[0] == 5
    state = aimed(budget, number=0, left_s=1000.0)
    needed = [state.round_s(number) for number in range(6)]
    assert needed[1] < needed[2] < needed[3] < needed[4] < needed[5]
    for number in range(1, 6):
        assert aimed(budget, number=0, left_s=needed[number] + 1e-3).next_recipe(None)[0] == number
    following, why = aimed(budget, number=0, left_s=needed[1] - 1e-3).next_recipe(None)
    assert (following, why) == (None, f"the next round does not fit into the {needed[1]:.0f} s left")
    assert aimed(budget, number=5, left_s=1000.0).next_recipe(None) == (None, "further rounds would not improve it")


def test_a_target_in_a_time_goes_as_far_as_both_allow():
    both = Aim(std_m=0.01, seconds=500.0)
    above = cells([0.03] * 100)
    assert aimed(both, number=1, left_s=1000.0).next_recipe(above)[0] == 5
    short = aimed(both, number=1, left_s=1000.0).round_s(3)
    assert aimed(both, number=1, left_s=short + 1e-3).next_recipe(above)[0] == 3


def test_going_on_costs_only_the_passes_that_are_finer():
    whole, later = samples(GROUND, 1.0, lowest_scale=0.25), samples(GROUND, 1.0, lowest_scale=0.25, earlier_scale=0.5)
    assert 0.5 * whole < later < whole
    # A round at a quarter, where the whole bound is searched at once, costs a quarter beside.
    assert (
        samples(GROUND, 0.25, lowest_scale=0.25) + samples(GROUND, 1.0, lowest_scale=0.25, earlier_scale=0.25)
        < 1.3 * whole
    )


def test_poses_that_are_checked_or_adjusted_take_time_first():
    least = {
        poses: PACE.least_s(replace(GROUND, poses=poses), 0.25, lowest_scale=0.25)
        for poses in ("fixed", "check", "refine")
    }
    assert least["fixed"] < least["check"] < least["refine"]
    # Only some photographs are checked, however many there are.
    many = replace(GROUND, photographs_mpx=1000.0, num_views=1000)
    checked, fixed = (PACE.least_s(replace(many, poses=p), 0.25, lowest_scale=0.25) for p in ("check", "fixed"))
    assert checked - fixed == pytest.approx(least["check"] - least["fixed"])


def test_a_slow_machine_shows_in_the_first_round():
    slow = PACE.after_sweep(3.0 * PACE.sample_s * 1e6, 1e6, 2.0)
    compared = samples(GROUND, 1.0, lowest_scale=0.25, earlier_scale=0.5)
    assert slow.sweep_s(GROUND, 1.0, lowest_scale=0.25, earlier_scale=0.5) == pytest.approx(
        2.0 + 3.0 * compared * PACE.sample_s
    )
    assert slow.tail_s(GROUND, 1.0) == pytest.approx(3.0 * PACE.tail_s(GROUND, 1.0))
    assert slow.solver_s(GROUND, 1.0) == pytest.approx(3.0 * PACE.solver_s(GROUND, 1.0))
    assert PACE.after_solver(2.0 + 50.0, 1_000_000).solver_s(GROUND, 1.0) == pytest.approx(52.0)


def test_the_clock_counts_down_from_when_the_time_began():
    hand = Hand()
    clock = Clock(100.0, gone_s=10.0, now=hand)
    hand.seconds += 50.0
    assert clock.left_s == pytest.approx(40.0)
    clock.require(39.0)
    with pytest.raises(OutOfTimeError):
        clock.require(41.0)


def test_cells_have_the_median_of_their_points():
    gsd = 0.1
    xyz = np.array([[0.5, 0.5, 0.0], [0.6, 0.5, 0.0], [0.7, 0.5, 0.0], [1.5, 0.5, 0.0], [1.6, 0.5, 0.0]])
    std = np.array([0.01, 0.05, 0.02, 0.04, np.nan])
    found = std_cells(bed(xyz, std, [3, 9, 5, 7, 7], [1.0, 2.0, 3.0, 4.0, 4.0]), gsd)
    np.testing.assert_allclose(found.std, [0.02, 0.04])
    np.testing.assert_allclose(found.num_views, [5.0, 7.0])
    assert found.reached(0.03) == 0.5
    assert found.reached(0.03, factor=0.5) == 1.0


def test_what_limits_the_rest_is_said():
    assert cells([0.01, 0.03, 0.03], num_views=3.0).limit(0.02) == FEW
    assert cells([0.01, 0.01, 0.03, 0.03], depth=[1.0, 1.1, 4.0, 5.0]).limit(0.02) == DEPTH
    assert cells([0.01, 0.01, 0.03], depth=[2.0, 2.2, 2.1]).limit(0.02) == NOISE
    assert cells([0.03], depth=[float("nan")]).limit(0.02) == NOISE


def test_ground_without_points_is_above_no_target():
    nothing = std_cells(bed(np.empty((0, 3)), np.empty(0), [], []), 0.1)
    assert nothing.reached(0.01) == 1.0
    assert nothing.in_words(0.01) == "no ground has points"
