"""The share of a run that is done and the time that is left, by a clock that the test turns."""

import io
import re

import pytest
from command_line import Terminal, without_times
from hypothesis import given
from hypothesis import strategies as st

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


def share_of(progress: Progress) -> float:
    """Of the run, as its bar shows it."""
    return progress._bars.tasks[0].percentage / 100.0


def work(step: Step, clock: Clock, parts: int, seconds_each: float) -> None:
    """Do so many parts, each in the same time."""
    for _ in range(parts):
        clock.now += seconds_each
        step.advance()


def test_a_run_says_its_share_and_the_time_left_each_minute(clock):
    stream = io.StringIO()
    with Progress(stream=stream, now=clock.monotonic) as progress, progress.run():
        progress.expect({"sweep": 100.0, "report": 50.0})
        with progress.stage("sweep", total=100) as step:
            work(step, clock, 40, 3.0)
            with progress.stage("a part of it", total=10) as part:
                work(part, clock, 2, 0.0)
            work(step, clock, 60, 3.0)
        with progress.stage("report"):
            clock.now += 150.0
    lines = without_times(stream.getvalue()).splitlines()
    # 20 and 40 of 150 expected seconds are done after one minute and two; 6.5 and 5.5 of 7.5 minutes are left.
    assert lines[:2] == ["sweep: 13 % of the run, about 6 minutes left", "sweep: 27 % of the run, about 6 minutes left"]
    # A line a minute, and none for the beginnings and ends of stages.
    assert len(lines) == 5


def test_a_stage_outside_a_run_says_its_own_share(clock):
    stream = io.StringIO()
    with Progress(stream=stream, now=clock.monotonic) as progress, progress.stage("sweep", total=100) as step:
        work(step, clock, 40, 3.0)
    assert "sweep: 40 %, about 3 minutes left" in stream.getvalue()


def test_a_stage_without_a_total_says_how_long_it_has_gone_on(clock):
    stream = io.StringIO()
    with Progress(stream=stream, now=clock.monotonic) as progress, progress.stage("reading") as step:
        clock.now += 65.0
        progress.say_if_due(step)
    assert "reading: 1 min 05 s so far" in stream.getvalue()


@given(begun=st.lists(st.booleans(), min_size=5, max_size=5), tiles=st.integers(1, 3), advances=st.integers(1, 4))
def test_the_share_of_a_run_only_rises_and_ends_at_all_of_it(begun, tiles, advances):
    """Stages that are used again do not begin; those of tiles come in turn."""
    clock = Clock()
    expected = {f"stage {number}": 10.0 * (number + 1) for number in range(5)}
    with Progress(verbosity=-1, now=clock.monotonic) as progress, progress.run():
        progress.expect(expected)
        shares = []
        for name, is_begun in [*zip(list(expected)[:-1], begun, strict=False), ("stage 4", True)]:
            for tile in range(tiles if is_begun else 0):
                with progress.stage(name, advances, part=(tile, tiles)) as step:
                    for _ in range(advances):
                        clock.now += 1.0
                        step.advance()
                        shares.append(share_of(progress))
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)


def test_times_expected_later_take_the_place_of_those_that_have_not_begun(clock):
    with Progress(verbosity=-1, now=clock.monotonic) as progress, progress.run():
        progress.expect({"features": 10.0, "sweep": 1000.0})
        with progress.stage("features", total=10) as step:
            work(step, clock, 10, 2.0)
        progress.expect({"sweep": 30.0})
        assert share_of(progress) == pytest.approx(0.25)
        # At the pace that is known already.
        assert progress._bars.tasks[0].time_remaining == pytest.approx(60.0, rel=0.15)


def test_a_terminal_shows_one_line(clock, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    stream = Terminal()
    with Progress(stream=stream, now=clock.monotonic) as progress, progress.run():
        progress.expect({"Boxes beside edges": 100.0, "Report": 100.0})
        with progress.stage("Boxes beside edges", total=100, part=(98, 100)) as step:
            work(step, clock, 100, 2.0)
            progress._bars.refresh()
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", stream.getvalue())
    lines = [line for line in re.split(r"[\r\n]+", shown) if " 50% " in line]
    assert lines
    assert all(len(line) <= 80 and re.search(r"\d:\d\d:\d\d left *$", line) for line in lines)
