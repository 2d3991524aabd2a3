"""The estimate of the time left, by a clock that the test turns."""

from __future__ import annotations

import io

import pytest

from survey.forecast import Forecast
from survey.progress import Progress, Step


class Clock:
    """A clock that stands still until it is turned."""

    def __init__(self):
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def stage(clock):
    """A stage of 100 parts."""
    with Progress(verbosity=-1, now=clock.monotonic) as progress, progress.stage("sweep", total=100) as stage:
        yield stage


def work(stage: Step, clock: Clock, parts: int, seconds_each: float) -> None:
    """Do so many parts, each in the same time."""
    for _ in range(parts):
        clock.now += seconds_each
        stage.advance()


def test_an_even_pace_tells_the_time_that_is_left(stage, clock):
    work(stage, clock, 20, 2.0)
    assert stage.seconds_left == pytest.approx(160.0)
    work(stage, clock, 80, 2.0)
    assert stage.seconds_left == 0.0


def test_nothing_is_told_from_too_small_a_share_or_too_short_a_time(stage, clock):
    work(stage, clock, 9, 60.0)
    assert stage.seconds_left is None
    work(stage, clock, 1, 60.0)
    assert stage.seconds_left == pytest.approx(90 * 60.0)


def test_a_stage_that_is_quick_so_far_tells_nothing_in_its_first_seconds(stage, clock):
    work(stage, clock, 20, 0.2)
    assert stage.seconds_left is None
    work(stage, clock, 5, 0.2)
    assert stage.seconds_left == pytest.approx(15.0)


def test_what_a_stage_needs_to_begin_is_forgotten(stage, clock):
    clock.now += 10.0  # images are loaded, kernels compiled
    work(stage, clock, 20, 1.0)
    assert stage.seconds_left == pytest.approx(80.0)


def test_a_first_advance_tells_no_pace(stage, clock):
    clock.now += 30.0
    stage.advance(10.0)
    assert stage.seconds_left is None
    work(stage, clock, 1, 1.0)
    assert stage.seconds_left is None
    work(stage, clock, 1, 1.0)
    assert stage.seconds_left == pytest.approx(88.0)


def test_nothing_is_told_while_the_pace_changes(stage, clock):
    work(stage, clock, 20, 0.5)
    assert stage.seconds_left == pytest.approx(40.0)
    work(stage, clock, 2, 10.0)
    assert stage.seconds_left is None
    work(stage, clock, 30, 10.0)
    assert stage.seconds_left == pytest.approx(48 * 10.0)


def test_one_slow_part_moves_the_estimate_by_its_share_of_the_later_half(stage, clock):
    work(stage, clock, 40, 1.0)
    work(stage, clock, 1, 4.0)
    assert stage.seconds_left == pytest.approx(59 * 23 / 20, rel=0.1)


def test_the_time_runs_down_while_a_part_is_worked_on_and_ends_where_it_takes_longer(stage, clock):
    work(stage, clock, 50, 1.0)
    clock.now += 10.0
    assert stage.seconds_left == pytest.approx(40.0)
    clock.now += 100.0
    assert stage.seconds_left is None


def test_a_stage_whose_parts_are_done_and_that_goes_on_has_nothing_left(clock):
    stream = io.StringIO()
    with Progress(stream=stream, now=clock.monotonic) as progress, progress.stage("sweep", total=100) as stage:
        work(stage, clock, 100, 1.0)
        clock.now += 65.0
        assert stage.seconds_left == 0.0
        stage.say_if_due()
    assert "sweep: 100 %, 2 min 45 s so far" in stream.getvalue()
    assert " -" not in stream.getvalue()


def test_a_stage_without_a_total_tells_nothing(clock):
    with Progress(verbosity=-1, now=clock.monotonic) as progress, progress.stage("reading") as stage:
        work(stage, clock, 50, 1.0)
        assert stage.seconds_left is None


def test_a_terminal_shows_the_same_estimate_beside_the_bar(clock, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    progress = Progress(stream=io.StringIO(), now=clock.monotonic)
    with progress, progress.stage("sweep", total=100) as stage:
        work(stage, clock, 40, 1.0)
        (task,) = progress._bars.tasks
        shown = [column(task) for column in progress._bars.columns]
    assert str(shown[-1]) == "1 min 00 s left"


def test_a_run_with_a_forecast_says_when_it_will_end(clock):
    stream = io.StringIO()
    with Progress(stream=stream, now=clock.monotonic) as progress:
        progress.forecast = Forecast()
        progress.forecast.expect({"sweep": 100.0, "report": 50.0})
        with progress.stage("sweep", total=100) as stage:
            work(stage, clock, 40, 3.0)
            assert stage.seconds_left == pytest.approx(180.0)
            with progress.stage("a part of it", total=10) as part:
                work(part, clock, 2, 0.0)
            work(stage, clock, 60, 3.0)
        clock.now += 10.0
        with progress.stage("report"):
            clock.now += 150.0
    said = stream.getvalue()
    assert "sweep:  20 %, 4 min 00 s left, about 6 minutes to the end of the run" in said
    assert "sweep: done in 5 min 00 s, about 2 minutes to the end of the run" in said
    assert said.rstrip().endswith("report: done in 2 min 30 s")


def test_nothing_is_told_of_the_run_while_the_pace_of_what_goes_on_contradicts_what_was_expected(clock):
    progress = Progress(verbosity=-1, now=clock.monotonic)
    progress.forecast = Forecast()
    progress.forecast.expect({"first": 100.0, "sweep": 50.0})
    with progress:
        with progress.stage("first"):
            clock.now += 100.0
        with progress.stage("sweep", total=100) as stage:
            work(stage, clock, 20, 0.5)
            assert progress.look_ahead() == pytest.approx(40.0)
            work(stage, clock, 2, 10.0)
            assert stage.seconds_left is None
            assert progress.look_ahead() is None
            work(stage, clock, 30, 10.0)
            assert stage.seconds_left == pytest.approx(48 * 10.0)
