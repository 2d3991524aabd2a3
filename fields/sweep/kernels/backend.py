"""The backends of the kernels, Dr.Jit and torch: two modules with the same functions; queue of jobs.

Only the backend that a device needs is imported. One view's kernels run while another view is prepared, in one thread:
Dr.Jit launches kernels asynchronously; reading a result waits for all that were launched. So a job yields what it would
launch and receives the results: between the two another job launches its own kernels, and this thread prepares the next
ones. Several threads would wait for each other at the GIL.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from itertools import count
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from fields.device import Device
from fields.sweep.kernels.arrays import host


def kernels(device: Device) -> ModuleType:
    """The kernels of a device: `torch_kernels`, or `drjit_kernels`, which with `drjit_scoring` says what each does."""
    if device.module is None:
        from fields.sweep.kernels import torch_kernels

        return torch_kernels
    from fields.sweep.kernels import drjit_kernels

    return drjit_kernels


Found = TypeVar("Found")


@dataclass(frozen=True)
class Launch:
    """Kernels that may still be running."""

    results: list[Any]  # flat arrays of the device
    # arrays that they read: threads of Dr.Jit that free memory of numpy need the GIL: it must not happen while this
    # thread holds it
    inputs: Any = None


# Yields what is to be launched, receives the results as flat arrays of the host each time, and returns what it found.
Job = Generator[Callable[[], Launch], list[np.ndarray], Found]


def run_job(device: Device, job: Job[Found]) -> Found:
    """Result of a single job."""
    (found,) = run_jobs(device, [job])
    return found


def run_jobs(device: Device, jobs: Iterable[Job[Found]], most: int = 2) -> Iterator[Found]:
    """Results of jobs in their order; at most ``most`` are under way, one of which has kernels running."""
    numbered, turn = enumerate(jobs), _Queue({}, deque())
    running: tuple[int, Job, Launch] | None = None
    for next_number in count():
        while next_number not in turn.found:
            finished = None
            if running is not None:
                number, job, launched = running
                # Waits; no kernel runs until the next launch, and the inputs of the last ones are freed.
                finished = number, job, [host(device, each) for each in launched.results]
                running = None
                del launched
            if turn.ready:
                number, job, launch = turn.ready.popleft()
                running = number, job, launch()
            if finished is not None:
                turn.advance(*finished)
            if len(turn.ready) + (running is not None) < most:
                following = next(numbered, None)
                if following is not None:
                    turn.advance(*following, None)
                elif not turn.ready and running is None and next_number not in turn.found:
                    return
        yield turn.found.pop(next_number)


@dataclass(frozen=True)
class _Queue:
    """Results by job number, and the jobs that wait, with their next launch."""

    found: dict[int, Any]
    ready: deque[tuple[int, Job, Callable[[], Launch]]]

    def advance(self, number: int, job: Job, results: list[np.ndarray] | None) -> None:
        """Send a job its results and queue its next launch, or store what it returns."""
        try:
            self.ready.append((number, job, next(job) if results is None else job.send(results)))
        except StopIteration as end:
            self.found[number] = end.value
