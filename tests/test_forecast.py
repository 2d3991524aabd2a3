"""Forecasts of steps and of runs, over paces as they come: within a factor of two once a tenth is done, or nothing."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from survey.forecast import Forecast, StepForecast
from survey.plan.rates import Amounts, parts_s, run_s, sfm_s

SEEDS = st.integers(0, 2**32 - 1)


def uneven(seed: int, number: int) -> list[float]:
    """How many times as long as usual each of so many parts takes."""
    return np.random.default_rng(seed).uniform(0.75, 1.33, number).tolist()


@given(
    start=st.floats(0.0, 1e6),
    loading=st.floats(0.0, 300.0),
    each=st.floats(0.5, 60.0),
    number=st.integers(20, 100),
    seed=SEEDS,
)
def test_a_step_of_an_uneven_pace_is_foreseen_within_a_factor_of_two(start, loading, each, number, seed):
    pace, now, took = StepForecast(start), start + loading, [each * share for share in uneven(seed, number)]
    told = 0
    for done, seconds in enumerate(took, start=1):
        now += seconds
        pace.advance(now, float(done), number)
        left, true = pace.left_s(now, number), sum(took[done:])
        if 10 * done < number:
            assert left is None
        if left is not None:
            assert 0.5 * true <= left <= 2.0 * true + 1e-6
            told += 1
    assert told >= number // 2 or number * each < 20.0


@given(
    slow=st.floats(0.3, 20.0),
    guessed=st.floats(0.3, 20.0),
    number=st.integers(2, 8),
    seed=SEEDS,
    skips=st.sets(st.integers(0, 7)),
)
def test_a_run_is_foreseen_within_a_factor_of_two_once_its_parts_tell_its_pace(slow, guessed, number, seed, skips):
    """Whatever was guessed of the machine; parts that an earlier run has finished do not count."""
    sizes = np.random.default_rng(seed).uniform(5.0, 300.0, number).tolist()
    parts = list(zip(sizes, uneven(seed, number), strict=True))
    forecast, now = Forecast(guessed), 100.0
    forecast.expect({f"part {i}": expected for i, (expected, _) in enumerate(parts)})
    done = {i for i in skips if i < len(parts) - 1}
    for here, (expected, share) in enumerate(parts):
        if here in done:
            continue
        took = slow * expected * share
        forecast.begin(f"part {here}", now)
        for step in range(1, 21):
            left = forecast.left_s(now + took * step / 20, took * (1.0 - step / 20) if step > 2 else None)
            later = sum(slow * e * s for i, (e, s) in enumerate(parts) if i > here and i not in done)
            ahead = sum(slow * e * s for i, (e, s) in enumerate(parts) if i > here)
            true = took * (1.0 - step / 20) + later
            if left is not None and step > 2:
                # What will be found finished is not known beforehand.
                assert 0.5 * true <= left <= 2.0 * (true + ahead - later)
        now += took
        forecast.end(f"part {here}", now)
    assert forecast.left_s(now) in (None, 0.0)


def test_nothing_is_told_of_a_run_that_has_not_begun_or_that_nothing_is_expected_of():
    forecast = Forecast()
    assert forecast.left_s(5.0) is None
    forecast.begin("other", 5.0)
    assert forecast.left_s(50.0) is None
    forecast.expect({"part": 10.0})
    forecast.end("part", 60.0)
    forecast.begin("unheard of", 60.0)
    forecast.begin("part", 60.0)
    assert forecast.left_s(61.0) is None


def test_numbers_of_numpy_do_as_well():
    forecast = Forecast(np.float64(2.0))
    forecast.expect({"part": np.float64(100.0)})
    forecast.begin("part", 0.0)
    assert [forecast.left_s(float(now), np.float64(200.0 - now)) for now in (30, 40, 50)][1:] == [160.0, 150.0]


def test_what_is_expected_anew_leaves_what_has_begun():
    forecast = Forecast()
    forecast.expect({"first": 10.0, "second": 1000.0})
    forecast.begin("first", 0.0)
    forecast.end("first", 20.0)
    forecast.expect({"second": 30.0})
    forecast.begin("second", 20.0)
    for now in range(21, 30):
        forecast.left_s(float(now))
    assert forecast.left_s(30.0) == pytest.approx(50.0)


def test_nothing_is_told_while_the_pace_of_a_small_part_is_all_that_is_known():
    forecast = Forecast()
    forecast.expect({"first": 10.0, "second": 100.0})
    forecast.begin("first", 0.0)
    forecast.end("first", 20.0)
    forecast.begin("second", 20.0)
    assert all(forecast.left_s(now) is None for now in range(21, 60))
    assert all(forecast.left_s(now, 940.0 - now) is None for now in range(60, 90))
    # Ten times as long as expected, where the first took twice as long.
    assert forecast.left_s(150.0, 790.0) == pytest.approx(790.0)


@pytest.mark.parametrize("poses", ["check", "refine", "fixed"])
@pytest.mark.parametrize("solves", [False, True])
def test_the_parts_of_a_run_are_its_stages_and_all_of_its_time_but_the_start(poses, solves):
    amounts = Amounts(20, 8.0, 4e5, 4e6, 3e5, 0.0, poses, solves)
    parts = parts_s(amounts, 2)
    assert {"check": "Poses", "refine": "Adjustment"}.get(poses, "Sweep") in parts
    assert ("Solver" in parts) is solves
    assert all(seconds >= 0.0 for seconds in parts.values())
    assert 0.0 < run_s(amounts, 2) - sum(parts.values()) < 5.0
    more = parts_s(Amounts(20, 8.0, 4e5, 4e6, 3e5, 0.0, poses, solves, first_hypotheses=500.0), 2)
    assert more["Sweep"] > 2.0 * parts["Sweep"] - 5.0
    assert sum(more.values()) > sum(parts.values())


def test_structure_from_motion_grows_with_pixels_pairs_and_photographs():
    parts = sfm_s(10.0, 20, 190, 2)
    assert sfm_s(20.0, 20, 190, 2)["Features"] == pytest.approx(2.0 * parts["Features"])
    assert sfm_s(10.0, 20, 380, 2)["Matches"] == pytest.approx(2.0 * parts["Matches"])
    assert sfm_s(10.0, 40, 190, 2)["Structure from motion"] == pytest.approx(2.0 * parts["Structure from motion"])
    assert sfm_s(10.0, 20, 190, 8)["Features"] < parts["Features"]


@settings(deadline=None)
@given(
    sizes=st.lists(st.floats(5.0, 3000.0), min_size=1, max_size=6),
    foreseen=st.lists(st.booleans(), min_size=6, max_size=6),
    advances=st.lists(st.sampled_from([0, 1, 2, 40]), min_size=6, max_size=6),
    paces=st.lists(st.floats(0.2, 12.0), min_size=1, max_size=4),
    silent=st.floats(0.0, 0.9),
    counts_to_end=st.booleans(),
)
def test_what_is_left_falls_with_time_or_is_not_told(sizes, foreseen, advances, paces, silent, counts_to_end):
    """On slow machines, under loads that change, in parts that say nothing, fall silent, or go on when all is done."""
    forecast, now, paces_in_turn = Forecast(), 0.0, itertools.cycle(paces)
    forecast.expect({f"part {i}": size for i, size in enumerate(sizes) if foreseen[i]} | {"last": 600.0})
    for here, size in enumerate(sizes):
        forecast.begin(f"part {here}", now)
        step, number, done = StepForecast(now), advances[here], 0.0
        rounds = [(0.0, (1.0 - silent) / number)] * number + [(1.0, silent)] if number else [(1.0, 1.0)]
        for is_silent, share in rounds:
            took = size * share * next(paces_in_turn)
            told = [(at, forecast.left_s(now + at, step.left_s(now + at, 1.0))) for at in took * np.linspace(0.1, 1, 8)]
            for (before, left), (later, then) in itertools.pairwise(told):
                if left is not None and then is not None:
                    # The pace of other parts is not told anew while this one is silent, but for the moment from which
                    # its own time counts.
                    assert then - left <= -0.9 * (later - before) + 0.02 * left
            now += took
            if not is_silent:
                done += share if counts_to_end else share / (1.0 - silent)
                step.advance(now, done, 1.0)
        forecast.end(f"part {here}", now)


def test_tiles_that_are_worked_on_at_once_are_one_part():
    forecast = Forecast()
    forecast.expect({"Poses": 20.0, "Sweep, tile 1 of 2": 40.0, "Sweep, tile 2 of 2": 40.0, "Bed": 10.0})
    forecast.begin("Poses", 0.0)
    forecast.end("Poses", 40.0)
    forecast.join(["Sweep, tile 1 of 2", "Sweep, tile 2 of 2"], "Sweep of 1 tiles", 0.5)
    forecast.begin("Sweep of 1 tiles", 40.0)
    assert [forecast.left_s(float(now)) for now in range(60, 66, 2)][1:] == [pytest.approx(78.0), pytest.approx(76.0)]
    assert forecast.left_s(120.0) is None
