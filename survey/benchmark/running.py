"""Run time, processor time and memory of one process, and the machine it runs on."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import psutil

import survey
from survey.benchmark.records import Cost
from survey.code_hash import code_hash
from survey.machine import memory_bytes, num_cores

_BATHYNERF = (sys.executable, "-c", "from survey.commands.app import main; main()")
_ROOT = Path(survey.__file__).resolve().parent.parent
# Between two looks at the memory [s].
_LOOK_S = 0.1


def run_bathynerf(arguments: list[str], home: Path, *, under: tuple[str, ...] = ()) -> tuple[int, Cost, str]:
    """Run the command line in a process of its own, with its compiled kernels in `home`.

    Parameters
    ----------
    arguments : list of str
    home : Path
    under : tuple of str
        A command that runs the command after it, e.g. ("timeout", "60").

    Returns
    -------
    exit code, cost, last line of standard error
    """
    environment = {**os.environ, "HOME": str(home), "PYTHONPATH": os.pathsep.join([str(_ROOT), *sys.path])}
    log = home / "stderr.txt"
    start, before = time.monotonic(), os.times()
    with log.open("wb") as errors:
        process = subprocess.Popen(
            [*under, *_BATHYNERF, *arguments], env=environment, stdout=subprocess.DEVNULL, stderr=errors
        )
        peak = _Peak(process.pid)
        try:
            code = process.wait()
        except BaseException:
            process.terminate()
            process.wait()
            raise
        finally:
            peak.stop()
    wall, after = time.monotonic() - start, os.times()
    processor = (after.children_user - before.children_user) + (after.children_system - before.children_system)
    words = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return code, Cost(wall, processor, peak.bytes), words[-1] if words else ""


class _Peak:
    """Watches the resident memory of a process and its children, in a thread."""

    def __init__(self, pid: int):
        self.bytes = 0
        self._process, self._ended = psutil.Process(pid), threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(_LOOK_S):
            self.bytes = max(self.bytes, _tree_bytes(self._process))


def _tree_bytes(process: psutil.Process) -> int:
    total = 0
    # Some may have just ended.
    with suppress(psutil.Error):
        for member in (process, *process.children(recursive=True)):
            with suppress(psutil.Error):
                total += member.memory_info().rss
    return total


def machine() -> dict[str, str]:
    """Processor, cores, memory and system, in words."""
    return {
        "processor": _processor(),
        "cores": str(num_cores()),
        "memory": f"{memory_bytes() / 1024**3:.1f} GiB",
        "gpu": _gpu(),
        "system": platform.system(),
        "python": platform.python_version(),
    }


def commit() -> str:
    """The commit of the working tree, with + where files differ; the hash of the code where there is no repository."""
    git = shutil.which("git")
    if git is not None and (_ROOT / ".git").exists():
        words = [git, "-C", str(_ROOT), "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"]
        found = subprocess.run(words, capture_output=True, text=True, check=False)
        if found.returncode == 0:
            return found.stdout.strip()
    return code_hash("survey.run.process")[:12]


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    flags = next((line.partition(":")[2].split() for line in lines if line.startswith("flags")), [])
    width = next((text for flag, text in (("avx512f", "AVX-512"), ("avx2", "AVX2")) if flag in flags), "")
    return ", ".join(filter(None, [named[0] if named else platform.machine(), width]))


def _gpu() -> str:
    nvidia = shutil.which("nvidia-smi")
    if nvidia is None:
        return "none"
    words = [nvidia, "--query-gpu=name", "--format=csv,noheader"]
    found = subprocess.run(words, capture_output=True, text=True, check=False)
    return found.stdout.strip().replace("\n", ", ") or "none"
