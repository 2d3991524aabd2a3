"""Memory, cores and free disk space of this machine.

The memory that may be used is also limited by the Linux control groups that hold this process, as Slurm, systemd and
containers set them. Groups are nested, and each limits all below it: the smallest limit on the way from the own group
up to the mount counts. A process is in one group of version 2 (cgroups(7)), and in one of the hierarchy "memory" of
version 1 where that is mounted; both hierarchies stand where systemd and containers mount them.
"""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import psutil

from survey.errors import SurveyError

# File that names the groups of this process, and the folder of all of them.
PROCESS, GROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
# Files with limits, the file with what is used, and the word for cached files in memory.stat that the system drops
# before it refuses memory: of version 2 and 1.
_FILES_OF_2 = (("memory.max", "memory.high"), "memory.current", "inactive_file")
_FILES_OF_1 = (("memory.limit_in_bytes",), "memory.usage_in_bytes", "total_inactive_file")


# Limits of a process as psutil has them, what they are called, what of them libraries and kernels map and do not fill,
# and below how much Dr.Jit's kernels crash instead of ending with an error [bytes].
_LIMITS = (("RLIMIT_AS", "ulimit -v", 2.4e9, 3e9), ("RLIMIT_DATA", "ulimit -d", 0.0, 4e8))


def memory_bytes() -> int:
    """Memory that this process may take at most: of the machine, or of the job or container that it runs in."""
    return min([psutil.virtual_memory().total, *(group.limit for group in group_memories())])


def free_memory_bytes() -> int:
    """Memory available without swapping, of the machine, of the job and by the limits of this process."""
    free = [psutil.virtual_memory().available, *(group.free for group in group_memories())]
    return int(min(*free, allowed_memory_bytes()))


def allowed_memory_bytes() -> float:
    """Memory that limits of this process leave to its data; infinite without limits."""
    return min((max(limit - mapped, 0.0) for _, limit, mapped, _ in _process_limits()), default=float("inf"))


def require_memory() -> None:
    """Raise SurveyError with the message of `memory_shortage`, if there is one."""
    if (shortage := memory_shortage()) is not None:
        raise SurveyError(shortage)


def memory_shortage() -> str | None:
    """The message where limits of this process leave less memory than kernels need; else None."""
    for command, limit, _, least in _process_limits():
        if limit < least:
            return (
                f"the memory of this process is limited to {limit / 1e9:.1f} GB ({command}), expected at least "
                f"{least / 1e9:.1g} GB; raise the limit"
            )
    return None


def _process_limits() -> list[tuple[str, float, float, float]]:
    """Limits that are set: command, limit, mapped and least bytes; none on systems other than Linux and FreeBSD."""
    numbered = [(getattr(psutil, name, None), *others) for name, *others in _LIMITS]
    known = [(psutil.Process().rlimit(number)[0], *others) for number, *others in numbered if number is not None]
    return [
        (command, limit, mapped, least)
        for limit, command, mapped, least in known
        if limit not in (-1, getattr(psutil, "RLIM_INFINITY", -1))
    ]


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


@dataclass(frozen=True)
class GroupMemory:
    limit: int  # [bytes]
    # [bytes]: by all processes in it and below, without cached files that are not in use; 0 where the system does not
    # tell
    used: int

    @property
    def free(self) -> int:
        """Memory left to its processes [bytes]."""
        return max(self.limit - self.used, 0)


def group_memories(process: Path = PROCESS, groups: Path = GROUPS) -> list[GroupMemory]:
    """Control groups with a memory limit around a process, the innermost first; none where there are no groups."""
    found = []
    for line in _lines(process):
        _, controllers, path = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        # Beside version 1, version 2 limits no memory, or lies in a folder of its own.
        mounts = [groups / "memory"] if controllers else [groups, groups / "unified"]
        limits, usage, cached = _FILES_OF_1 if controllers else _FILES_OF_2
        # Of a group beyond its mount (a container that shares the names of its host) only the mount is to be seen.
        inside = Path(path.lstrip("/")) if ".." not in path else Path()
        for folder in (mount / part for mount in mounts for part in (inside, *inside.parents)):
            known = [limit for name in limits if (limit := _number(folder / name)) is not None]
            if known:
                rows = (row.split() for row in _lines(folder / "memory.stat"))
                unused = next((int(row[1]) for row in rows if len(row) == 2 and row[0] == cached), 0)
                used = (_number(folder / usage) or 0) - unused
                found.append(GroupMemory(min(known), max(used, 0)))
    return found


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    except OSError:
        return []


def _number(path: Path) -> int | None:
    """The number in a file; None without the file, or where it says "max"."""
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
