"""A machine that fails a run: little memory, a small disk, kill -9; and whether the run continues as if nothing was.

A fault is a command that runs another one: `run_bathynerf(..., under=fault(value, folder, usual_s))`.
"""

import hashlib
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bench_methods import run_bathynerf
from method_records import Cost

# What a resumed run must have again, byte by byte.
PRODUCTS = ("cloud.las", "plan.json", "settings.toml")
_CRASHED = "crashed"
# A disk on which a run starts, and when others fill it, as a share of the usual time.
_ROOMY_MB, _FILLED = 80, 0.3
# Exit code where this system lets no user mount a file system.
NOT_POSSIBLE = 99

# Of a value, the folder that holds the run, and the time [s] that the run takes without the fault.
Fault = Callable[[float, Path, float], tuple[str, ...]]


def little_memory(gigabytes: float, _folder: Path, _usual_s: float) -> tuple[str, ...]:
    """Data of the process that are limited."""
    return ("sh", "-c", f'ulimit -c 0; ulimit -d {int(gigabytes * 1e6)} && exec "$@"', "sh")


def little_address_space(gigabytes: float, _folder: Path, _usual_s: float) -> tuple[str, ...]:
    """An address space that is limited."""
    return ("sh", "-c", f'ulimit -c 0; ulimit -v {int(gigabytes * 1e6)} && exec "$@"', "sh")


def little_disk(megabytes: float, folder: Path, _usual_s: float) -> tuple[str, ...]:
    """A small file system of its own."""
    return _on_disk(megabytes, folder, '"$@"')


def filling_disk(megabytes: float, folder: Path, usual_s: float) -> tuple[str, ...]:
    """A file system that others fill while the run writes, so that it gets no more than so much."""
    others = f'head -c {int((_ROOMY_MB - megabytes) * 1e6)} /dev/zero > "{folder}/others"'
    return _on_disk(_ROOMY_MB, folder, f'(sleep {_FILLED * usual_s:.2f}; {others}) & "$@"')


def _on_disk(megabytes: float, folder: Path, command: str) -> tuple[str, ...]:
    """A command on a file system in a user namespace; what is there at the end is kept beside it."""
    mount = f'mount -t tmpfs -o size={int(megabytes * 1e6)} small "{folder}" || exit {NOT_POSSIBLE}'
    keep = f'rm -f "{folder}/others"; cp -a "{folder}" "{folder}.kept"'
    return ("unshare", "-rm", "sh", "-c", f"{mount}; {command}; code=$?; {keep}; exit $code", "sh")


def killed(share: float, _folder: Path, usual_s: float) -> tuple[str, ...]:
    """A death without warning after a share of the usual time."""
    return ("timeout", "-s", "KILL", f"{share * usual_s:.2f}")


@dataclass(frozen=True)
class Resumed:
    """How a run ended under a fault, and what came of it without.

    Attributes
    ----------
    exit_code : int
        Under the fault.
    words : str
        Its last line.
    run : Path
        The run folder, complete; that of the undisturbed run where this one was refused before it began.
    cost : Cost
        Of the run under the fault.
    is_same : bool
        Whether all of `PRODUCTS` are those of a run that nothing disturbed.
    """

    exit_code: int
    words: str
    run: Path
    cost: Cost
    is_same: bool

    @property
    def verdict(self) -> str:
        """Whether it ended in a sentence and lost nothing."""
        if self.exit_code == NOT_POSSIBLE or self.words.startswith("unshare:"):
            return "not measured: this system lets no user mount a file system"
        if self.exit_code not in (0, 2) and not self.is_killed:
            return f"{_CRASHED} (exit code {self.exit_code})"
        ending = "done" if self.exit_code == 0 else "killed" if self.is_killed else "refused"
        return ending + (", same bytes" if self.is_same else ", OTHER BYTES") + ("" if ending == "done" else " resumed")

    @property
    def is_killed(self) -> bool:
        """Whether the fault was the killing itself."""
        return self.exit_code in (-9, 137)


def resumed(fault: Fault, value: float, survey: Path, place: Path, whole: tuple[Path, Cost], home: Path,
            options: list[str]) -> Resumed:  # fmt: skip
    """Run under a fault, then again without.

    Parameters
    ----------
    fault, value : the fault and how bad it is
    survey : Path
    place : Path
        A new folder that will hold the run.
    whole : (Path, Cost)
        The folder of a run that nothing disturbed, and its cost.
    home : Path
    options : list of str
        Of `process`.
    """
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    run, kept = place / "run", place.with_name(f"{place.name}.kept")
    shutil.rmtree(kept, ignore_errors=True)
    command = ["process", str(survey), "-o", str(run), *options]
    code, cost, words = run_bathynerf(command, home, under=fault(value, place, whole[1].wall_s))
    if kept.is_dir():
        place.rmdir()
        kept.rename(place)
    if code != 0 and not (run / "stages").is_dir():
        # Refused before it began: there is nothing that could have been lost.
        return Resumed(code, words, whole[0], cost, is_same=True)
    if code != 0:
        run_bathynerf(command, home)
    return Resumed(code, words, run, cost, _digests(run) == _digests(whole[0]))


def _digests(run: Path) -> dict[str, str]:
    return {name: hashlib.sha256((run / name).read_bytes()).hexdigest() for name in PRODUCTS if (run / name).is_file()}
