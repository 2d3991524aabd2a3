"""Does a run that is killed at any moment end, when it is given again, with the same cloud?

    python benchmarks/soak_kills.py [--kills 100] [--seed 0] [--only adjusted ...] [--out FOLDER]

A small survey is drawn and processed: in one piece, in two tiles, and with poses adjusted. Each is done again on one
core (Linux), which has to give the same cloud. Then each is started again and again, killed (SIGKILL) after a random
time up to that of the whole run, until enough kills are made; whenever a run is done, its cloud is compared to the
byte, nothing half written may lie beside it, and the next one starts from nothing. Prints one row for each way of
processing, and exits 1 if a cloud differs or a run ends with an error.
"""

import argparse
import hashlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from survey.simulate.drawn import DrawnScene, draw_survey

COMMAND = [sys.executable, "-c", "from survey.commands.app import main; main()", "process"]
WAYS = {"one piece": (), "two tiles": ("--tiles", "2"), "adjusted": ("--poses", "refine")}


def on_one_core() -> None:
    """Let this process, and what it starts, use one core alone."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def run_for(
    folder: Path, options: tuple[str, ...], seconds: float | None, before: Callable[[], None] | None = None
) -> subprocess.CompletedProcess | None:
    """Process a survey; None if it was killed before it was done. ``before`` is called in the process."""
    command = [*COMMAND, str(folder), *options, "-q"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, preexec_fn=before) as run:
        try:
            said, _ = run.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            run.kill()
            run.communicate()
            return None
        return subprocess.CompletedProcess(run.args, run.returncode, said)


def cloud_of(folder: Path) -> str:
    return hashlib.sha256((folder / "bathynerf" / "cloud.las").read_bytes()).hexdigest()


def left_over(folder: Path) -> list[str]:
    """Files that are written and then renamed, which nobody renamed."""
    return [str(path) for path in (folder / "bathynerf").rglob("*.part")]


def soak(folder: Path, options: tuple[str, ...], kills: int, chance: random.Random) -> tuple[int, list[str]]:
    """How many runs ended after kills, and what was wrong."""
    begin = time.monotonic()
    first = run_for(folder, options, None)
    whole_s = time.monotonic() - begin
    if first is None or first.returncode not in (0, 3):
        return 0, [f"the run that nobody killed failed: {first}"]
    expected, faults, ended = cloud_of(folder), [], 0
    shutil.rmtree(folder / "bathynerf")
    if hasattr(os, "sched_setaffinity"):
        run_for(folder, options, None, on_one_core)
        faults += [] if cloud_of(folder) == expected else ["another cloud on one core"]
        shutil.rmtree(folder / "bathynerf")
    made = 0
    while made < kills or (folder / "bathynerf").exists():
        result = run_for(folder, options, chance.uniform(0.0, whole_s) if made < kills else None)
        if result is None:
            made += 1
            continue
        ended += 1
        if result.returncode != first.returncode:
            faults.append(f"exit {result.returncode}: {result.stdout.decode()[-300:]}")
        elif cloud_of(folder) != expected:
            faults.append("another cloud")
        faults += [f"left over: {path}" for path in left_over(folder)]
        shutil.rmtree(folder / "bathynerf")
    return ended, faults


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--only", nargs="*", choices=WAYS, default=list(WAYS))
    given = parser.parse_args()
    chance, is_whole = random.Random(given.seed), True
    sys.stdout.write("| run | kills | runs that ended after them | faults |\n|---|---|---|---|\n")
    with tempfile.TemporaryDirectory() as place:
        for name in given.only:
            options = WAYS[name]
            folder = (given.out or Path(place)) / name.replace(" ", "_")
            draw_survey(folder, DrawnScene.tiny())
            kills = -(-given.kills // len(given.only))
            ended, faults = soak(folder, options, kills, chance)
            is_whole &= not faults
            sys.stdout.write(f"| {name} | {kills} | {ended} | {'; '.join(faults) or 'none'} |\n")
            sys.stdout.flush()
    return 0 if is_whole else 1


if __name__ == "__main__":
    sys.exit(main())
