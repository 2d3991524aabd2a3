"""What memory do the points of a bed take while they are merged, written as LAS, reported and made triangles of?

    python benchmarks/bench_points.py SURVEY RUN [--times 1 4 16] [-o FILE.json]

RUN is a finished `process SURVEY --tiles N -o RUN` with poses as given. The points of its tiles are repeated beside
each other so many times; then each step is done in a process of its own. Prints and writes the number of points and
the peak of anonymous memory [bytes] of each step, less that of the process before it: what is mapped from files the
system may drop at any time, and does not count.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from threading import Event, Thread

import numpy as np

from survey.folder.survey import load_survey
from survey.plan.choices import Choices
from survey.progress import Progress
from survey.run.folder import RunDir
from survey.run.job import Job
from survey.run.stored import load_arrays, save_arrays

STEPS = ("merge", "cloud", "report", "mesh")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("survey", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--times", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("-o", "--output", type=Path)
    asked = parser.parse_args()
    rows = []
    for times in asked.times:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            row = {"points": _repeated(asked.run, folder, times)}
            for step in STEPS:
                with get_context("spawn").Pool(1) as pool:
                    row[step] = pool.apply(_peak, (step, asked.survey, asked.run, folder))
            rows.append(row)
            print(json.dumps(row), flush=True)  # noqa: T201
    if asked.output is not None:
        asked.output.write_text(json.dumps(rows, indent=2) + "\n")


def _repeated(run: Path, folder: Path, times: int) -> int:
    """Write the points of the tiles of a run so many times, side by side; their number."""
    stages = RunDir(run).result()["stages"]
    count = 0
    for name in sorted(each for each in stages if each.startswith("bed_tile")):
        points = load_arrays(RunDir(run).load_stage(name) / "points.npz")
        width = 1.05 * np.ptp(points["xyz"][:, 0]) if len(points["xyz"]) else 0.0
        for number in range(times):
            xyz = points["xyz"] + [number * width, 0.0, 0.0]
            count += len(xyz)
            (folder / f"{name}-{number}").mkdir()
            save_arrays(folder / f"{name}-{number}" / "points.npz", **(points | {"xyz": xyz}))
    return count


def _peak(step: str, survey: Path, run: Path, folder: Path) -> int:
    """Peak of anonymous memory of a step, less that before it [bytes]."""
    with Progress(verbosity=-1) as progress:
        job = Job(load_survey(survey), Choices(quality="draft"), progress)
        work = {"merge": _merge, "cloud": _cloud, "report": _report, "mesh": _mesh}[step](job, run, folder)
        before, peak, ended = _anonymous(), [0], Event()

        def look() -> None:
            while not ended.wait(0.01):
                peak[0] = max(peak[0], _anonymous())

        thread = Thread(target=look)
        thread.start()
        work()
        ended.set()
        thread.join()
    return peak[0] - before


def _anonymous() -> int:
    text = Path("/proc/self/status").read_text(encoding="ascii")
    return 1024 * int(text.split("RssAnon:")[1].split()[0])


def _merge(job: Job, _run: Path, folder: Path) -> Callable[[], None]:
    from survey.run.merged import merge_points

    tiles = sorted(folder.glob("bed_tile*"))
    (folder / "bed").mkdir()
    return lambda: merge_points(job, folder / "bed", [], {"bed": tiles}, {})


def _cloud(_job: Job, _run: Path, folder: Path) -> Callable[[], None]:
    from survey.run.products import write_bed_las
    from survey.run.stored import load_bed

    return lambda: write_bed_las(folder / "cloud.las", load_bed(folder / "bed"))


def _mesh(_job: Job, _run: Path, folder: Path) -> Callable[[], None]:
    from geo.ply import write_ply
    from survey.export.bed_surface import bed_surface
    from survey.run.stored import load_bed

    def work() -> None:
        stored = load_bed(folder / "bed")
        bed, spacing_m = stored.bed, stored.gsd_m
        mesh = bed_surface(bed.xyz, bed.rgb, bed.std, spacing_m=spacing_m, method="delaunay", path="mesh")
        write_ply(folder / "mesh.ply", mesh.vertices, rgb=mesh.rgb, scalars={}, faces=mesh.faces)

    return work


def _report(job: Job, run: Path, folder: Path) -> Callable[[], None]:
    from survey.run import products
    from survey.run.repeat import Truth

    done = {name: RunDir(run).load_stage(name) for name in RunDir(run).result()["stages"] if "tile" not in name}
    shutil.copy(next(iter(done.values())) / "stage.json", folder / "bed" / "stage.json")
    (folder / "result").mkdir()
    # The cloud has a row of its own.
    products.write_bed_las = lambda path, stored: None
    stages = done | {"bed": folder / "bed"}
    finished = products.FinishedRun(RunDir(run), job, stages, Truth(None, None), folder / "result")
    return lambda: products.write_products(finished) and None


if __name__ == "__main__":
    start = time.monotonic()
    main()
    print(f"{time.monotonic() - start:.0f} s", file=sys.stderr)  # noqa: T201
