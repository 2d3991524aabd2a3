"""Calls shared with a second process: it takes its part, and what it cannot do is done here."""

from __future__ import annotations

import os
import time
from functools import partial
from pathlib import Path

import pytest

from survey import second_process
from survey.second_process import SecondProcess

LONG_S = 60.0


@pytest.fixture
def helper(monkeypatch):
    monkeypatch.setattr(second_process, "num_cores", lambda: 2)
    with SecondProcess() as process:
        yield process


def number_once_there(path: Path) -> int:
    """The number of this process, once a file is there."""
    start = time.monotonic()
    while not path.exists() and time.monotonic() < start + LONG_S:
        time.sleep(0.01)
    return os.getpid()


def number_after_making(path: Path) -> int:
    """The number of this process, which makes a file first."""
    path.touch()
    return os.getpid()


def test_the_other_process_takes_calls_from_the_back(helper, tmp_path):
    steps = []
    helper.start("json")
    calls = {
        "front": partial(number_once_there, tmp_path / "made"),
        "back": partial(number_after_making, tmp_path / "made"),
    }
    found = helper.share(calls, lambda: steps.append(1))
    assert list(found) == ["front", "back"]
    assert found["front"] == os.getpid()
    assert found["back"] != os.getpid()
    assert len(steps) == 2


@pytest.mark.parametrize("module", ["json", "no_such_module"])
def test_calls_that_the_other_process_cannot_do_are_done_here(helper, module):
    helper.start(module)
    numbers = [3, 4, 5]
    # A local function cannot be sent.
    calls = {str(number): lambda number=number: number**2 for number in numbers}
    assert helper.share(calls, lambda: None) == {"3": 9, "4": 16, "5": 25}


def test_what_ends_the_other_process_is_done_here(helper):
    helper.start("json")
    here = os.getpid()
    calls = {"front": partial(pow, 3, 2), "back": partial(end_unless, here)}
    assert helper.share(calls, lambda: None) == {"front": 9, "back": here}


def end_unless(number: int) -> int:
    """End this process at once, unless it has this number."""
    if os.getpid() != number:
        os._exit(1)
    return number


def test_an_error_of_a_call_is_raised_here_whoever_took_it(helper):
    helper.start("json")
    calls = {"front": partial(pow, 3, 2), "back": partial(int, "seven")}
    with pytest.raises(ValueError, match="seven"):
        helper.share(calls, lambda: None)


def test_without_a_second_core_all_is_done_here(monkeypatch):
    monkeypatch.setattr(second_process, "num_cores", lambda: 1)
    with SecondProcess() as alone:
        alone.start("json")
        assert alone.share({"a": os.getpid, "b": os.getpid}, lambda: None) == dict.fromkeys("ab", os.getpid())
