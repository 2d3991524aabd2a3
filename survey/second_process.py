"""Calls shared with a second Python process, for work that holds Python's lock, such as matplotlib's drawing.

The other process takes calls and gives results as pickles, one at a time. It is a help, not a need: what it does not
answer, because it cannot be started, ends early or fails, is done here, where errors have their place.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import TypeVar

from survey.machine import num_cores

Found = TypeVar("Found")

# Numbers of the open files that every process has.
_OUTPUT, _ERRORS = 1, 2
# All that ends a conversation: the other process ends, or what is sent cannot be pickled.
_SILENCE = (OSError, EOFError, ValueError, AttributeError, TypeError, pickle.PickleError)


class SecondProcess:
    """A process that takes a part of independent calls; it ends with the ``with`` block at the latest."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> SecondProcess:
        return self

    def __exit__(self, *_exception) -> None:
        if self._process is not None:
            self._process.kill()
            # Closes the pipes; what was not sent is no loss.
            with suppress(OSError), self._process:
                pass

    def start(self, module: str) -> None:
        """Start it, to import a module that the calls need while this process goes on.

        It is not started where there is no second core, or where the program that runs is not Python's own.
        """
        if self._process is not None or num_cores() < 2 or not Path(sys.executable or "").name.startswith("python"):
            return
        # The same modules from the same places, and nothing from the working folder.
        code = f"import sys; sys.path[:] = {sys.path!r}; import {module}; from {__name__} import answer; answer()"
        pipe, nothing = subprocess.PIPE, subprocess.DEVNULL
        with suppress(OSError):
            self._process = subprocess.Popen([sys.executable, "-c", code], stdin=pipe, stdout=pipe, stderr=nothing)

    def share(self, calls: Mapping[str, Callable[[], Found]], advance: Callable[[], None]) -> dict[str, Found]:
        """Results of calls by name: this process takes them from the front, the other one from the back.

        Parameters
        ----------
        calls : mapping
            Functions without arguments; where they cannot be pickled, all are called here.
        advance : callable
            Called once for each call.
        """
        waiting = deque(calls)
        found: dict[str, Found] = {}
        answered: dict[str, Found] = {}
        asking = Thread(target=self._ask, args=(calls, waiting, answered))
        asking.start()
        try:
            while (name := _taken(waiting.popleft)) is not None:
                found[name] = calls[name]()
                advance()
        except BaseException:
            if self._process is not None:
                self._process.kill()
            raise
        finally:
            asking.join()
        for name, call in calls.items():
            if name not in found:
                found[name] = answered[name] if name in answered else call()
                advance()
        return {name: found[name] for name in calls}

    def _ask(self, calls: Mapping[str, Callable[[], Found]], waiting: deque[str], answered: dict[str, Found]) -> None:
        """Let the other process answer calls from the back, while it does."""
        process = self._process
        if process is None or process.stdin is None or process.stdout is None:
            return
        with suppress(*_SILENCE):
            pickle.dump(dict(calls), process.stdin, protocol=pickle.HIGHEST_PROTOCOL)
            while (name := _taken(waiting.pop)) is not None:
                pickle.dump(name, process.stdin)
                process.stdin.flush()
                answered[name] = pickle.load(process.stdout)


def _taken(take: Callable[[], str]) -> str | None:
    """The next of what is waiting; None where nothing is left."""
    try:
        return take()
    except IndexError:
        return None


def answer() -> None:
    """What the other process does: it answers calls by name, until nobody asks."""
    answers = os.fdopen(os.dup(_OUTPUT), "wb")
    # What a library prints is no answer.
    os.dup2(_ERRORS, _OUTPUT)
    with suppress(EOFError):
        calls = pickle.load(sys.stdin.buffer)
        while True:
            pickle.dump(calls[pickle.load(sys.stdin.buffer)](), answers)
            answers.flush()
