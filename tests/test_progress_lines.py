"""The lines of progress where there is no terminal, and durations as people read them."""

from __future__ import annotations

import io

import pytest

from survey import progress as progress_room
from survey.progress import Progress, clock


def test_stages_are_plain_lines_with_the_time_left_where_there_is_no_terminal(monkeypatch, tmp_path):
    now = [0.0]
    monkeypatch.setattr(progress_room.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    with Progress(stream=stream, log_path=tmp_path / "run" / "log.txt") as progress:
        assert progress_room.current() is progress
        with progress.stage("sweep", total=4) as stage:
            assert stage.seconds_left is None
            for _ in range(3):
                now[0] += 15.0
                stage.advance(detail="0001.jpg")
        progress.detail("a detail")
        progress.warn("a doubt")
    assert stream.getvalue().splitlines() == [
        "sweep ...",
        "sweep:  50 %, 30 s left, 0001.jpg",
        "sweep: done in 45 s",
        "warning: a doubt",
    ]
    lines = [line.split(" ", 2)[2] for line in (tmp_path / "run" / "log.txt").read_text().splitlines()]
    assert lines == [*stream.getvalue().splitlines()[:3], "a detail", "warning: a doubt"]
    assert progress_room.current() is not progress


def test_a_stage_that_fails_is_not_said_to_be_done():
    stream = io.StringIO()
    with Progress(stream=stream) as progress, pytest.raises(RuntimeError), progress.stage("sweep"):
        raise RuntimeError
    assert stream.getvalue() == "sweep ...\n"


def test_a_quiet_run_says_only_warnings():
    stream = io.StringIO()
    with Progress(stream=stream, verbosity=-1) as progress, progress.stage("sweep"):
        progress.note("a note")
        progress.warn("a doubt")
    assert stream.getvalue() == "warning: a doubt\n"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.04, "0.0 s"), (9.94, "9.9 s"), (9.96, "10 s"), (59.6, "1 min 00 s"), (185, "3 min 05 s"), (7800, "2 h 10 min")],
)
def test_durations_are_for_people(seconds, text):
    assert clock(seconds) == text
