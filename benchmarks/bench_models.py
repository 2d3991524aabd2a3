"""What do the published radiance fields find of a surveyed bed, in equal processor time?

    python benchmarks/bench_models.py SURVEY [RUN] -o WORK [--models mdw tensorf ...] [--seconds S] [--seeds N]
                                      [--cells N] [--rays N] [--samples N] [--about-bed]

SURVEY is a folder with known truth (reference.ply and visible.ply in it, or in truth/), RUN a run of it, by default
SURVEY/bathynerf. Each model is trained from the poses and the water of the run, with rays bent and with straight ones,
for as many steps as take the processor time on this machine, measured on some steps before; one photograph in eight is
held out. It begins anywhere in a box about the bed, or with --about-bed within two cells of the run's bed. Every row is
a file in WORK; what is there is not computed again. Prints Markdown; the last row is the run's own cloud.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from fields.volume.models import MODELS
from survey.compare.comparison import compare_files
from survey.compare.figures import numbers_of
from survey.compare.options import CompareOptions
from survey.export.loaded import LoadedRun, flight_of
from survey.files.json_values import write_json
from survey.folder.survey import load_survey
from survey.volume.field import train_field
from survey.volume.options import VolumeOptions
from survey.volume.scene import load_scene
from survey.volume.training import train

# Steps whose processor time is measured, after those that compile.
COMPILING, TIMED = 4, 24
# Fewer steps show nothing.
LEAST_STEPS = 50
TOLERANCES_M = (0.05, 0.2)
HEAD = (
    "| model | rays | steps | processor time | held-out PSNR | mean | std | at 0.05 m | at 0.2 m |",
    "|---|---|---|---|---|---|---|---|---|",
)


def steps_for(run: Path, options: VolumeOptions, seconds: float) -> int:
    """Number of steps that take so many seconds of processor time here."""
    with LoadedRun(run) as loaded:
        flight = flight_of(loaded, options.survey)
        scene = load_scene(loaded, flight, replace(options.scene, monocular=None), lambda: None)
        train(scene, flight, replace(options, steps=COMPILING))
        start = time.process_time()
        train(scene, flight, replace(options, steps=TIMED))
        return max(int(seconds * TIMED / (time.process_time() - start)), LEAST_STEPS)


def row(run: Path, truth: Path, work: Path, options: VolumeOptions, seconds: float) -> dict:
    """Figures of one model, trained with the options."""
    steps = steps_for(run, options, seconds)
    start = time.process_time()
    report = train_field(run, work, replace(options, steps=steps))
    spent = time.process_time() - start
    compared = of_cloud(work / "cloud.las", truth, options.bounds) if report["points"] else None
    return {"steps": steps, "processor_s": spent, "held_out_db": report["held_out_psnr_db"], "compared": compared}


def of_cloud(cloud: Path, truth: Path, bounds: tuple[float, float, float, float] | None) -> dict:
    """The figures of `bathynerf compare` of a cloud with the truth."""
    options = CompareOptions(tolerances_m=TOLERANCES_M, visible=truth / "visible.ply", bounds=bounds)
    return numbers_of(compare_files(cloud, truth / "reference.ply", options=options))


def cells_of(rows: list[dict]) -> list[str]:
    """The columns of a row: means over seeds, with their range where there are several."""

    def over(values: list[float], digits: int, unit: str) -> str:
        known = [v for v in values if np.isfinite(v)]
        if not known:
            return "-"
        spread = f" ({min(known):.{digits}f} to {max(known):.{digits}f})" if len(known) > 1 else ""
        return f"{np.mean(known):.{digits}f}{spread} {unit}".rstrip()

    def compared(key: str, factor: float) -> list[float]:
        return [factor * r["compared"][key] for r in rows if r["compared"] is not None]

    def complete(tolerance: float) -> list[float]:
        place = TOLERANCES_M.index(tolerance)
        known = (r["compared"] for r in rows)
        return [100.0 * (0.0 if each is None else each["tolerances"][place]["completeness_visible"]) for each in known]

    held = [float(np.mean(list(r["held_out_db"].values()))) for r in rows if r.get("held_out_db")]
    return [
        over([r["steps"] for r in rows if "steps" in r], 0, ""),
        over([r["processor_s"] for r in rows if "processor_s" in r], 0, "s"),
        over(held, 1, "dB"),
        over(compared("mean_inner90_m", 1e3), 0, "mm"),
        over(compared("std_inner90_m", 1e3), 0, "mm"),
        *(over(complete(tolerance), 1, "%") for tolerance in TOLERANCES_M),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("survey", type=Path)
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="WORK")
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=list(MODELS))
    parser.add_argument("--seconds", type=float, default=60.0, help="processor time of each training")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--cells", type=int, default=128)
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument("--samples", type=int, default=48)
    parser.add_argument("--about-bed", action="store_true")
    given = parser.parse_args()
    run = given.run or given.survey / "bathynerf"
    truth = given.survey / "truth" if (given.survey / "truth").is_dir() else given.survey
    bounds = load_survey(given.survey).bounds
    given.output.mkdir(parents=True, exist_ok=True)
    lines = [*HEAD]
    for model in given.models:
        for straight in (False, True):
            rows = []
            for seed in range(given.seeds):
                options = VolumeOptions(
                    model=model, rays=given.rays, samples=given.samples, cells=given.cells, held_every=8, seed=seed,
                    from_scratch=not given.about_bed, straight=straight, bounds=bounds, survey=str(given.survey),
                )  # fmt: skip
                name = f"{model}_{'straight' if straight else 'bent'}_{seed}"
                path = given.output / f"{name}.json"
                if not path.exists():
                    write_json(path, row(run, truth, given.output / name, options, given.seconds))
                rows.append(json.loads(path.read_text()))
            lines.append(f"| {model} | {'straight' if straight else 'bent'} | {' | '.join(cells_of(rows))} |")
    own = [{"compared": of_cloud(run / "cloud.las", truth, bounds)}]
    lines.append(f"| this run | bent | {' | '.join(cells_of(own))} |")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
