"""How do the published fields get on with time, dry and under water?

    python benchmarks/bench_error_time.py WORK [--models mdw tensorf ...] [--seconds S] [--seed N] [--draw]

Every model trains on the scene of `bench_switches`, dry and under 2 m of water, for as many steps as take S seconds of
processor time here, measured on some steps before. After 1, 2, 4, ... s and at the end pixels of the photographs that
were held out are rendered: PSNR, and median error of the distance to the surface. Trainings are kept in WORK
for the same settings and code; prints Markdown; --draw writes docs/img/field_error_time.png.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from field_tables import DOCS, LABELS
from kept_results import kept_result
from switch_scene import BOX, WATER, SwitchScene, build

from fields.device import choose_device
from fields.volume.models import MODELS, build_model, proposal_for
from fields.volume.paths import Paths
from fields.volume.photographs import PriorImages
from fields.volume.renderer import VolumeRenderer
from fields.volume.sampling import Cells
from fields.volume.train import Training, proxy_of, train_volume
from fields.water_column import WaterColumn
from refract import FlatWater

CELLS, PATHS, SAMPLES = 64, 600, 48
TRAINING = Training(rays=512, samples=24, cells=48)
COMPILING, TIMED = 2, 4
SCENES = {"dry": None, "wet": WATER}


def held_paths(scene: SwitchScene) -> Paths:
    """Pixels of the held-out photographs, with the true distances as their priors."""
    ones = np.ones_like(scene.length[0])
    scene.held.priors = [PriorImages(length=length, spread=ones) for length in scene.length]
    return scene.held.draw(PATHS, BOX, np.random.default_rng(0))


def renderer_of(name: str, water: FlatWater | None, steps: int, seed: int) -> VolumeRenderer:
    """An untrained model of a name."""
    model = build_model(name, BOX, CELLS, choose_device("cpu"), seed=seed, steps=steps)
    column = None if water is None else WaterColumn()
    return VolumeRenderer(model, column=column, proposal=proposal_for(name, BOX, CELLS, steps))


def steps_for(name: str, scene: SwitchScene, seconds: float) -> int:
    """Number of steps that take so much processor time."""
    for steps in (COMPILING, TIMED):
        renderer = renderer_of(name, scene.train.water, steps, 0)
        start = time.process_time()
        train_volume(renderer, scene.train, replace(TRAINING, steps=steps, refresh=()), lambda share: None)
        spent = time.process_time() - start
    return max(round(seconds * TIMED / spent), TIMED)


@torch.no_grad()
def errors(renderer: VolumeRenderer, paths: Paths) -> dict:
    """PSNR [dB], and median error [m] of the distance to the median of the weights."""
    cells = proxy_of(renderer, Cells.everywhere(BOX, TRAINING.cells), 0.1)
    if not cells.occupied.any():
        cells = Cells.everywhere(BOX, TRAINING.cells)
    seen = renderer.render(paths, renderer.samples(paths, cells, SAMPLES, jitter=False))
    error = float(((seen.rgb - paths.rgb) ** 2).mean())
    return {
        "psnr_db": -10.0 * float(np.log10(error)),
        "depth_m": float((seen.depth - paths.priors[:, 0]).abs().nanmedian()),
    }


def measure(name: str, where: str, seconds: float, seed: int) -> dict:
    """Errors after each time."""
    scene = build(water=SCENES[where], seed=0)
    paths, steps = held_paths(scene), steps_for(name, scene, seconds)
    renderer, looks = renderer_of(name, scene.train.water, steps, seed), []
    start, waited, due = time.process_time(), 0.0, 1.0

    def look(share: float) -> None:
        nonlocal waited, due
        spent = time.process_time() - start - waited
        if spent < due and share < 1.0:
            return
        before = time.process_time()
        state = torch.get_rng_state()
        looks.append({"seconds": spent, "steps": round(share * steps)} | errors(renderer, paths))
        torch.set_rng_state(state)
        waited += time.process_time() - before
        due *= 2.0

    train_volume(renderer, scene.train, replace(TRAINING, steps=steps), look, seed=seed)
    return {"model": name, "scene": where, "steps": steps, "looks": looks}


def table(rows: list[dict]) -> list[str]:
    """Markdown: each model at the end of its training, dry and wet."""
    lines = ["| model | steps, dry | PSNR | depth error | steps, wet | PSNR | depth error |", "|---" * 7 + "|"]
    for name in dict.fromkeys(row["model"] for row in rows):
        cells = []
        for where in SCENES:
            row = next((r for r in rows if (r["model"], r["scene"]) == (name, where)), None)
            last = None if row is None else row["looks"][-1]
            cells += ["-"] * 3 if last is None else [
                f"{row['steps']}", f"{last['psnr_db']:.1f} dB", f"{1e3 * last['depth_m']:.0f} mm"
            ]  # fmt: skip
        lines.append(f"| {LABELS[name]} | {' | '.join(cells)} |")
    return lines


def draw(rows: list[dict], path: Path) -> None:
    """Errors of distance and PSNR over time, dry and wet."""
    from gallery_canvas import BLUE, DARK_ORANGE, GREEN, RED, canvas, label, save

    figure, plots = canvas(10.0, 7.2, nrows=2, ncols=2)
    colours, styles = (BLUE, RED, GREEN, DARK_ORANGE, "#5d6a76"), ("-", "--", ":")
    for column, where in enumerate(SCENES):
        for number, name in enumerate(dict.fromkeys(row["model"] for row in rows)):
            of = [r["looks"] for r in rows if (r["model"], r["scene"]) == (name, where)]
            style = {"color": colours[number % 5], "ls": styles[number // 5], "marker": "o", "ms": 2.5, "lw": 1.2}
            for looks in of:
                seconds = [look["seconds"] for look in looks]
                plots[0, column].plot(seconds, [1e3 * look["depth_m"] for look in looks], label=LABELS[name], **style)
                plots[1, column].plot(seconds, [look["psnr_db"] for look in looks], **style)
        for axes in plots[:, column]:
            axes.set_xscale("log")
        plots[0, column].set_yscale("log")
        label(plots[0, column], f"{where}: distance", "", "median error [mm]")
        label(plots[1, column], f"{where}: photographs held out", "processor time [s]", "PSNR [dB]")
    figure.legend(*plots[0, 0].get_legend_handles_labels(), loc="outside right center", fontsize=8.5, frameon=False)
    save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=list(MODELS))
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--draw", action="store_true")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    rows = []
    for where in SCENES:
        for name in options.models:
            of = (name, where, options.seconds, options.seed)
            settings = dict(zip(("model", "scene", "seconds", "seed"), of, strict=True))
            rows.append(kept_result(options.work, f"{name}_{where}", settings, __file__, partial(measure, *of)))
            sys.stderr.write(f"{rows[-1]['model']} {where} {rows[-1]['looks'][-1]}\n")
    sys.stdout.write("\n".join(table(rows)) + "\n")
    if options.draw:
        draw(rows, DOCS / "img" / "field_error_time.png")


if __name__ == "__main__":
    main()
