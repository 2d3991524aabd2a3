"""How do the published fields get on with time, dry and under water?

    python benchmarks/bench_error_time.py WORK [--models mdw tensorf ...] [--seconds S] [--seeds N] [--draw]

Every model trains on the scene of `bench_switches`, dry and under 2 m of water, for as many steps as take S seconds of
processor time here, measured on some steps before. After 1, 2, 4, ... s and at the end pixels of the photographs that
were held out are rendered: PSNR, and median error of the distance to the surface; of several seeds the mean with its
95 % interval. Trainings are kept in WORK for the same settings and code; prints Markdown; --draw writes
docs/img/field_error_time.png, of the first seed.
"""

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import switch_scene
import torch
from bench_field import DOCS, interval
from gallery_canvas import BLUE, DARK_ORANGE, GREEN, RED, canvas, label, save
from matplotlib.ticker import NullFormatter, StrMethodFormatter
from switch_scene import BOX, WATER, SwitchScene, build

from fields.device import choose_device
from fields.models import MODELS
from fields.volume.model import Setup, build_model
from fields.volume.paths import Paths
from fields.volume.photographs import PriorImages
from fields.volume.renderer import VolumeRenderer
from fields.volume.sampling import Cells
from fields.volume.train import Training, proxy_of, train_volume
from fields.water_column import WaterColumn
from refract import FlatWater
from survey.stage_key import code_hash

CELLS, PATHS, SAMPLES = 64, 600, 48
TRAINING = Training(rays=512, samples=24, cells=48)
COMPILING, TIMED = 2, 4
SCENES = {"dry": None, "wet": WATER}


def kept_result(work: Path, name: str, settings: dict, compute: Callable[[], Any]) -> Any:
    """A result, computed unless ``work`` has one of the same settings, scene and code.

    Parameters
    ----------
    name : str
        Begins the name of the file.
    settings : dict
        All that the result depends on beside code, as values for JSON.
    compute : callable
        Makes the result, of values for JSON.
    """
    digest = hashlib.sha256(json.dumps([settings, code_hash()]).encode())
    for file in (__file__, switch_scene.__file__):
        digest.update(Path(file).read_bytes())
    path = work / f"{name}_{digest.hexdigest()[:12]}.json"
    if not path.is_file():
        path.write_text(json.dumps(compute(), indent=2))
    return json.loads(path.read_text())


def held_paths(scene: SwitchScene) -> Paths:
    """Pixels of the held-out photographs, with the true distances first among their priors."""
    ahead = [camera.directions(camera.pixel_centres()) @ camera.cam_from_local[2] for camera in scene.held.cameras]
    scene.held.priors = [PriorImages(length * cosine) for length, cosine in zip(scene.length, ahead, strict=True)]
    return scene.held.draw(PATHS, BOX, np.random.default_rng(0))


def renderer_of(name: str, water: FlatWater | None, steps: int, seed: int) -> VolumeRenderer:
    """An untrained model of a name."""
    setup = Setup(BOX, CELLS, choose_device("cpu"), steps=steps)
    model = build_model(name, setup, seed=seed)
    column = None if water is None else WaterColumn()
    return VolumeRenderer(model, column=column, proposal=model.proposal(setup))


def steps_for(name: str, scene: SwitchScene, seconds: float) -> int:
    """Number of steps that take so much processor time."""
    for steps in (COMPILING, TIMED):
        renderer = renderer_of(name, scene.train.water, steps, 0)
        start = time.process_time()
        train_volume(renderer, scene.train, replace(TRAINING, steps=steps, refresh=()), lambda *done: None)
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
    """Errors of a model after each time, dry or wet."""
    scene = build(water=SCENES[where], seed=0)
    paths, steps = held_paths(scene), steps_for(name, scene, seconds)
    renderer, looks = renderer_of(name, scene.train.water, steps, seed), []
    start, waited, due = time.process_time(), 0.0, 1.0

    def look(share: float, _errors: list[float]) -> None:
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
    return {"model": name, "scene": where, "seed": seed, "steps": steps, "looks": looks}


def table(rows: list[dict]) -> list[str]:
    """Markdown: each model at the end of its training, dry and wet."""
    lines = ["| model | steps, dry | PSNR | depth error | steps, wet | PSNR | depth error |", "|---" * 7 + "|"]
    for name in dict.fromkeys(row["model"] for row in rows):
        cells = []
        for where in SCENES:
            of = [row for row in rows if (row["model"], row["scene"]) == (name, where)]
            last = [row["looks"][-1] for row in of]
            cells += ["-"] * 3 if not of else [
                interval([row["steps"] for row in of], 0),
                f"{interval([look['psnr_db'] for look in last], 1)} dB",
                f"{interval([1e3 * look['depth_m'] for look in last], 0)} mm",
            ]  # fmt: skip
        lines.append(f"| {MODELS[name].label} | {' | '.join(cells)} |")
    return lines


def draw(rows: list[dict], path: Path) -> None:
    """Errors of distance and PSNR over time, dry and wet."""
    figure, plots = canvas(10.0, 7.2, nrows=2, ncols=2, sharex=True, sharey="row")
    colours, styles = (BLUE, RED, GREEN, DARK_ORANGE, "#5d6a76"), ("-", "--", ":")
    for column, where in enumerate(SCENES):
        for number, name in enumerate(dict.fromkeys(row["model"] for row in rows)):
            of = [r["looks"] for r in rows if (r["model"], r["scene"]) == (name, where)]
            style = {"color": colours[number % 5], "ls": styles[number // 5], "marker": "o", "ms": 2.5, "lw": 1.2}
            for looks in of:
                seconds = [look["seconds"] for look in looks]
                plots[0, column].plot(
                    seconds, [1e3 * look["depth_m"] for look in looks], label=MODELS[name].label, **style
                )
                plots[1, column].plot(seconds, [look["psnr_db"] for look in looks], **style)
        label(plots[0, column], f"{where}: distance", "", "" if column else "median error [mm]")
        label(plots[1, column], f"{where}: photographs held out", "processor time [s]", "" if column else "PSNR [dB]")
    plots[1, 0].set_xscale("log", base=2)
    plots[0, 0].set_yscale("log")
    for axis in (plots[1, 0].xaxis, plots[0, 0].yaxis):
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_formatter(NullFormatter())
    plots[0, 0].set_yticks((10, 20, 50, 100, 200, 500))
    figure.legend(*plots[0, 0].get_legend_handles_labels(), loc="outside right upper", fontsize=8.5, frameon=False)
    save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=list(MODELS))
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--draw", action="store_true")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    rows = []
    for seed, where, name in product(range(options.seeds), SCENES, options.models):
        of = (name, where, options.seconds, seed)
        settings = dict(zip(("model", "scene", "seconds", "seed"), of, strict=True))
        compute = partial(measure, *of)
        rows.append(kept_result(options.work, f"{name}_{where}_{seed}", settings, compute))
        sys.stderr.write(f"{name} {where} {seed} {rows[-1]['looks'][-1]}\n")
    sys.stdout.write("\n".join(table(rows)) + "\n")
    if options.draw:
        draw([row for row in rows if row["seed"] == 0], DOCS / "img" / "field_error_time.png")


if __name__ == "__main__":
    main()
