"""Kernels of one view while another is prepared: jobs that take turns, in one thread.

Dr.Jit starts kernels and goes on; what is read back waits for all that were started. So a job tells what it would
start and is handed what that gave: between the two another job starts its own kernels and this thread works beside
them. Several threads would share Python's lock, and wait for each other.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from itertools import count
from typing import Any, TypeVar

from fields.device import Device
from fields.sweep.kernels.arrays import results

Found = TypeVar("Found")


@dataclass(frozen=True)
class Launched:
    """Kernels that may still run.

    Attributes
    ----------
    results : flat arrays of the device
    held : what they read
        The threads of Dr.Jit that let go of memory of numpy need Python's lock for it: not while other work has that.
    """

    results: list[Any]
    held: Any = None


# Gives what is to be launched, each time is handed the results as flat arrays, and returns what it found.
Job = Generator[Callable[[], Launched], list[Any], Found]


def alone(device: Device, job: Job[Found]) -> Found:
    """What a job finds."""
    (found,) = in_turn(device, [job])
    return found


def in_turn(device: Device, jobs: Iterable[Job[Found]], most: int = 2) -> Iterator[Found]:
    """What jobs find, in their order. At most so many are under way, of which one has kernels that run."""
    numbered, turn = enumerate(jobs), _Turn({}, deque())
    running: tuple[int, Job, Launched] | None = None
    for wanted in count():
        while wanted not in turn.found:
            landed = None
            if running is not None:
                number, job, launched = running
                # Waits; from here to the next launch no kernel runs, and what the last ones read is let go.
                landed = number, job, results(device, launched.results)
                running = None
                del launched
            if turn.ready:
                number, job, launch = turn.ready.popleft()
                running = number, job, launch()
            if landed is not None:
                turn.go_on(*landed)
            if len(turn.ready) + (running is not None) < most:
                following = next(numbered, None)
                if following is not None:
                    turn.go_on(*following, None)
                elif not turn.ready and running is None and wanted not in turn.found:
                    return
        yield turn.found.pop(wanted)


@dataclass(frozen=True)
class _Turn:
    """What jobs have found, by number, and those that wait for their turn, with what they launch then."""

    found: dict[int, Any]
    ready: deque[tuple[int, Job, Callable[[], Launched]]]

    def go_on(self, number: int, job: Job, results: list[Any] | None) -> None:
        """Hand a job its results, and take what it launches next or what it found."""
        try:
            self.ready.append((number, job, next(job) if results is None else job.send(results)))
        except StopIteration as end:
            self.found[number] = end.value
