"""Memory, cores and free disk space of this machine."""

from __future__ import annotations

import os
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from survey.control_groups import group_memories

# Probes of work, of so many steps each, and how long an idle core with AVX-512 takes for one [s].
_PROBE_SIZE, _STEPS, _PROBES = 1_000_000, 15, 15
PROBE_S = 7e-4 * _STEPS
# What a process did longer ago than this says nothing of how busy the machine is now [s].
_RECENT_S = 60.0
# Of Linux, which psutil does not read.
_TURNS = Path("/proc/self/schedstat")
# Address space that libraries and kernels map and do not fill, on one core.
_MAPPED_BYTES = 2.4e9


def memory_bytes() -> int:
    """Memory that this process may take at most: of the machine, or of the job or container that it runs in."""
    return min([psutil.virtual_memory().total, *(group.limit for group in group_memories())])


def free_memory_bytes() -> int:
    """Memory available without swapping, of the machine and of the job."""
    return min([psutil.virtual_memory().available, *(group.free for group in group_memories())])


def limit_bytes(kind: str) -> float:
    """Limit of this process on its address space ("AS", ulimit -v) or data ("DATA", ulimit -d).

    Infinite without one, and on systems other than Linux and FreeBSD, which keep no such limits.
    """
    number = getattr(psutil, f"RLIMIT_{kind}", None)
    limit = -1 if number is None else psutil.Process().rlimit(number)[0]
    return float("inf") if limit in (-1, getattr(psutil, "RLIM_INFINITY", -1)) else float(limit)


def allowed_memory_bytes() -> float:
    """Memory that the limits of this process leave to its data; infinite without limits."""
    return min(limit_bytes("DATA"), limit_bytes("AS") - _MAPPED_BYTES)


def num_cores() -> int:
    """Cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def free_disk_bytes(folder: Path) -> int:
    """Room on the disk of a folder, or of the nearest one above it that exists."""
    folder = folder.absolute()
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free


def process_age_s() -> float:
    """Seconds since this process started; systems count in whole seconds since 1970, so it may be one off."""
    return max(time.time() - psutil.Process().create_time(), time.process_time())


@dataclass(frozen=True)
class Load:
    """How long work takes now, against an idle core of the kind that rates were measured on.

    Attributes
    ----------
    work : float
        Processor time of known work: below 1 on faster cores, above it where another program shares the core's units.
    turns : float
        Wall clock for each second of processor time: above 1 where other programs take turns.
    """

    work: float
    turns: float

    @classmethod
    def of(cls, probes_s: list[float], wall_s: float, ran_and_waited: tuple[int, int] | None) -> Load:
        """From the processor times of probes and the wall clock of all of them.

        Work is the median of probes. Turns follow from how long the process has run and waited, where the system counts
        it, else from wall clock over processor time.
        """
        turns = wall_s / sum(probes_s) if ran_and_waited is None else sum(ran_and_waited) / ran_and_waited[0]
        return cls(float(np.median(probes_s)) / PROBE_S, max(turns, 1.0))

    @property
    def slowness(self) -> float:
        """How many times as long work takes; at least 1, so that a faster machine has a reserve."""
        return max(self.work * self.turns, 1.0)

    def __str__(self) -> str:
        return (
            f"{self.slowness:.1f} times as long as on an idle core: known work takes {self.work:.1f} times the "
            f"processor time, and a second of that takes {self.turns:.1f} s"
        )


def load() -> Load:
    """Of this machine now; takes 0.2 s of processor time.

    Turns of other programs come and go within seconds: they are counted since the process started, unless that is long
    ago.
    """
    values = np.linspace(0.0, 1.0, _PROBE_SIZE, dtype=np.float32)
    np.exp(values)
    before = (0, 0) if process_age_s() < _RECENT_S else _ran_and_waited()
    wall, processor = time.monotonic(), []
    for _ in range(_PROBES):
        start = time.thread_time()
        for _ in range(_STEPS):
            np.exp(values)
            np.sqrt(values)
        processor.append(time.thread_time() - start)
    wall = time.monotonic() - wall
    after = _ran_and_waited()
    between = None if before is None or after is None else (after[0] - before[0], after[1] - before[1])
    return Load.of(processor, wall, between)


def _ran_and_waited() -> tuple[int, int] | None:
    """How long the first thread of the process has run, and waited for its turn [ns]; None where it is not counted."""
    try:
        ran, waited = (int(word) for word in _TURNS.read_text(encoding="ascii").split()[:2])
    except (OSError, ValueError):
        return None
    return (ran, waited) if ran > 0 else None
