"""What each line of the plan that leaves something out saves, and what it costs in error.

    python benchmarks/bench_plan.py SURVEY ... [--quality Q]

Runs `bathynerf process` with everything left out that a scene does not need, then once with each of these things put
back, then with nothing left out, and once with each of what was tried and is not left out. Each is a process by itself.
Prints a table in Markdown. Times are processor time, all cores together: other programs on the
machine do not count. Surveys need reference.ply and visible.ply, in their folder or in its folder truth/.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np

from fields.skips import NOTHING, SKIPS
from fields.solver import gauss_newton
from fields.solver.appearance import Appearance
from fields.sweep import views
from fields.sweep.passes import PASSES
from survey.folder.survey import load_survey
from survey.plan import plan as planning
from survey.run import process as running
from survey.run import stage_sweep


def same_light(_tile, grey: np.ndarray) -> Appearance:
    """All photographs are equally bright."""
    return Appearance(np.ones(len(grey), dtype=np.float32), np.zeros_like(grey))


def but_for_one_cell(seen: np.ndarray, chosen: list[int], times: int) -> list[int]:
    """As `views._greedy`, without the views that are needed for a single cell."""
    chosen = list(chosen)
    need = np.minimum(seen.sum(axis=0), times)
    while True:
        gain = (seen & (seen[chosen].sum(axis=0) < need)).sum(axis=1)
        gain[chosen] = 0
        if gain.max() <= 1:
            return chosen
        chosen.append(int(gain.argmax()))


def put_back(**names: bool) -> AbstractContextManager:
    return patch.object(planning, "SKIPS", replace(SKIPS, **names))


# What is changed beside the usual plan, and the words of --poses.
VARIANTS: dict[str, tuple[Callable[[], AbstractContextManager], dict[str, str]]] = {
    "the plan": (nullcontext, {}),
    "refraction by an index of 1": (partial(put_back, air=False), {}),
    "all terms of the lens": (partial(put_back, lens=False), {}),
    "pixels beyond the area": (partial(put_back, area=False), {}),
    "the whole range of heights first": (partial(put_back, heights=False), {}),
    "all pixels in the finer passes": (partial(put_back, points=False), {}),
    "poses adjusted without asking": (nullcontext, {"poses": "refine"}),
    "nothing left out": (partial(patch.object, planning, "SKIPS", NOTHING), {"poses": "refine"}),
    "tried: no check of the poses": (nullcontext, {"poses": "fixed"}),
    "tried: no gain and offset of photographs": (partial(patch.object, gauss_newton, "appearance_of", same_light), {}),
    "tried: no last pass": (partial(patch.object, stage_sweep, "PASSES", PASSES[:-1]), {}),
    "tried: no views for one cell alone": (partial(patch.object, views, "_greedy", but_for_one_cell), {}),
}


@dataclass(frozen=True)
class Row:
    """Processor time [s], and errors of the inner 90 % and of all points [mm], completeness at 0.05 m [%]."""

    seconds: float
    std_mm: float
    rms_mm: float
    complete: float


def measured(survey: Path, quality: str, name: str) -> Row:
    """A run in a process of its own."""
    truth = survey / "truth" if (survey / "truth").is_dir() else survey
    with tempfile.TemporaryDirectory() as folder:
        call = [sys.executable, __file__, str(survey), "--quality", quality, "--only", name, "--run", folder]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(call, check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        found = Path(folder) / "compared.json"
        compare = "from survey.commands.app import main; main()"
        options = ["--visible", str(truth / "visible.ply"), "--tolerance", "0.05", "--json", str(found), "-qq"]
        bounds = load_survey(survey).bounds
        options += [] if bounds is None else ["--bounds", *map(str, bounds)]
        cloud, reference = str(Path(folder) / "run" / "cloud.las"), str(truth / "reference.ply")
        subprocess.run([sys.executable, "-c", compare, "compare", cloud, reference, *options], check=True)
        figures = json.loads(found.read_text())
    seconds = sum(getattr(after, each) - getattr(before, each) for each in ("ru_utime", "ru_stime"))
    return Row(seconds, 1e3 * figures["std_inner90_m"], 1e3 * figures["rms_m"], 100.0 * figures["completeness_visible"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("surveys", type=Path, nargs="+", metavar="SURVEY")
    parser.add_argument("--quality", default="standard")
    parser.add_argument("--only", choices=VARIANTS, help=argparse.SUPPRESS)
    parser.add_argument("--run", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only is not None:
        change, words = VARIANTS[options.only]
        with change():
            running.process(options.surveys[0], options.run / "run", quality=options.quality, **words)
        return
    for survey in options.surveys:
        rows = {}
        sys.stdout.write(f"\n| {survey.name}, {options.quality} | processor time | std | rms | at 0.05 m |\n")
        sys.stdout.write("|---|---|---|---|---|\n")
        for name in VARIANTS:
            row = rows[name] = measured(survey, options.quality, name)
            ratios = [getattr(row, each) / getattr(rows["the plan"], each) for each in ("seconds", "std_mm", "rms_mm")]
            beside = "" if len(rows) == 1 else " ({:+.0f} %)"
            cells = [
                f"{value:.{digits}f} {unit}{beside.format(100.0 * (ratio - 1.0))}"
                for value, digits, unit, ratio in zip(
                    (row.seconds, row.std_mm, row.rms_mm), (1, 2, 1), ("s", "mm", "mm"), ratios, strict=True
                )
            ]
            sys.stdout.write(f"| {name} | {' | '.join(cells)} | {row.complete:.2f} % |\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
