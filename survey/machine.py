"""What this machine has: memory, cores, room on a disk."""

from __future__ import annotations

import os
import resource
import shutil
import time
from pathlib import Path

import numpy as np

_CGROUP = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
# Work that one idle core with AVX-512 does in so long [s]; done so often that the turns of other programs average out.
_PROBE_SIZE, _PROBE_S, _PROBES = 1_000_000, 7e-4, 300
_MEMINFO = Path("/proc/meminfo")
_STAT, _UPTIME = Path("/proc/self/stat"), Path("/proc/uptime")
# Of the words of `_STAT` behind the name of the program: when the process started [ticks].
_STARTED = 19
# Address space that libraries and kernels map and do not fill, on one core.
_MAPPED_BYTES = 2.4e9
_UNLIMITED = (resource.RLIM_INFINITY, -1)


def memory_bytes() -> int:
    """Memory that this process may take at most: of the machine, or of the container that it runs in."""
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for path in _CGROUP:
        try:
            total = min(total, int(path.read_text(encoding="ascii")))
        except (OSError, ValueError):
            # No container, or one without a limit ("max").
            continue
    return total


def free_memory_bytes() -> int:
    """Memory available without swapping; all of it if the system does not report this."""
    try:
        for line in _MEMINFO.read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return min(int(line.split()[1]) * 1024, memory_bytes())
    except (OSError, ValueError):
        pass
    return memory_bytes()


def allowed_memory_bytes() -> float:
    """Memory that the limits of this process leave to its data (ulimit -d, ulimit -v); infinite without limits."""
    data, space = (resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_DATA, resource.RLIMIT_AS))
    allowed = float("inf") if data in _UNLIMITED else float(data)
    return allowed if space in _UNLIMITED else min(allowed, space - _MAPPED_BYTES)


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
    """Seconds since this process started; of its processor time, which is less, if the system does not report this."""
    try:
        words = _STAT.read_text(encoding="ascii").rpartition(")")[2].split()
        since_boot = float(_UPTIME.read_text(encoding="ascii").split()[0])
        return max(since_boot - int(words[_STARTED]) / os.sysconf("SC_CLK_TCK"), 0.0)
    except (OSError, ValueError, IndexError):
        return time.process_time()


def slowness() -> float:
    """How many times as long work takes now as on the idle core that rates were measured on; takes 0.2 s there."""
    values = np.linspace(0.0, 1.0, _PROBE_SIZE, dtype=np.float32)
    np.exp(values)
    start = time.monotonic()
    for _ in range(_PROBES):
        np.exp(values)
        np.sqrt(values)
    return (time.monotonic() - start) / (_PROBES * _PROBE_S)
