"""Which field draws a scene best, how true is its surface, and what does it cost?

    python benchmarks/bench_field.py WORK [--objects wreck ship hull] [--models vm dw m mdw ...] [--seeds N]
                                     [--steps N | --seconds S] [--scale S] [--cells N_MAX] [--rays N]
                                     [--device auto|cpu|cuda|torch] [--draw]

VM (planes times vectors, TensoRF's decomposition), DW, M and MDW-NeRF are one code with four settings, compared with
TensoRF as published, NeRF, TinyNeRF and hash grids with proposals (Nerfacto, and one for processors). All see the same
photographs and paths and sample alike (hash grids by their proposals), for as many steps, or with --seconds for as many
as take that time here. One photograph in eight is held out. Every row is a file in WORK; what is there is not computed
again. With --draw the pictures of docs/field.md are drawn. The defaults are for two cores; full size is --scale 1
--cells 256 --steps 30000 --rays 4096.
"""

import argparse
import json
import os
import pickle
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from gallery_canvas import canvas, px_per_m, save, scale_bar
from object_scenes import NAMES, ObjectScene, chamfer, load_scene
from PIL import Image
from scipy.special import stdtrit
from study import thinned
from switch_scene import Backdrop

from evaluation import image_quality
from fields.device import choose_device, tensor_place
from fields.models import MODELS
from fields.volume.model import Setup, build_model
from fields.volume.renderer import VolumeRenderer, render_volume
from fields.volume.sampling import Cells
from fields.volume.tensor import TensorVolume
from fields.volume.train import POOL_STEPS, Training, train_volume
from fields.water_column import WaterColumn
from survey.display.palette import INK, SOFT

ABLATION = ("vm", "dw", "m", "mdw")
# Steps of each model in turn, to compare their times: (rounds, steps of a round). After the switch from coarse to fine
# density, where a model has one: most steps of a training are such.
TIMED = (4, POOL_STEPS)
# Of glibc: freed memory is given back at once. Otherwise peaks of one training lie between 100 and 450 MB, by what the
# allocator keeps.
GIVEN_BACK = {"MALLOC_ARENA_MAX": "1", "MALLOC_MMAP_THRESHOLD_": "262144", "MALLOC_TRIM_THRESHOLD_": "262144"}
# Fewer steps show nothing.
LEAST_STEPS = 50
DOCS = Path(__file__).resolve().parents[1] / "docs"
# What the object fills of its held-out photograph, in shares of its sides: left, right, top, bottom.
PARTS = {"wreck": (0.28, 0.74, 0.24, 0.74), "ship": (0.38, 0.66, 0.05, 0.92), "hull": (0.15, 0.85, 0.24, 0.70)}
# By which differences are enlarged, and how high a picture of a row may be [inch].
TIMES, _HIGHEST_IN = 4.0, 3.2
HEAD = (
    "| object | model | held-out PSNR | SSIM | Chamfer distance | parameters | memory | steps | a step | rays/s |",
    "|---|---|---|---|---|---|---|---|---|---|",
)
CONFIDENCE = 0.95


def table_of(rows: list[dict]) -> str:
    """Markdown: each object's models; of several seeds the mean, and half of the 95 % interval of the mean.

    Of PSNR and distance the difference and the ratio to the first model of the object stand in brackets, by seed.
    """
    lines = []
    for name in dict.fromkeys(r["object"] for r in rows):
        of = [r for r in rows if r["object"] == name]
        models = list(dict.fromkeys(r["model"] for r in of))
        base = [r for r in of if r["model"] == models[0]]
        for model in models:
            cells = _columns([r for r in of if r["model"] == model], None if model == models[0] else base)
            lines.append("| " + " | ".join([name, MODELS[model].label, *cells]) + " |")
    return "\n".join([*HEAD, *lines])


def _columns(rows: list[dict], base: list[dict] | None) -> list[str]:
    psnr, distance = ([f * r[key] for r in rows] for key, f in (("held_out_psnr_db", 1.0), ("chamfer_m", 1e3)))
    gain = ratio = ""
    if base is not None:
        gain = f" ({interval([r - b['held_out_psnr_db'] for r, b in zip(psnr, base, strict=True)], 2, sign=True)})"
        ratio = f" (x {interval([1e-3 * r / b['chamfer_m'] for r, b in zip(distance, base, strict=True)], 2)})"
    memory = statistics.fmean(r["train_mb"] or r["steps_mb"] for r in rows)
    return [
        f"{interval(psnr, 2)} dB{gain}",
        interval([r["held_out_ssim"] for r in rows], 3),
        f"{interval(distance, 1)} mm{ratio}",
        f"{rows[0]['parameters_mb']:.2f} MB",
        f"{memory:.0f} MB",
        f"{statistics.fmean(r['steps'] for r in rows):.0f}",
        f"{1e3 * rows[0]['step_s']:.1f} ms",
        f"{statistics.fmean(r['rays_per_s'] for r in rows) / 1e3:.0f} k",
    ]


def interval(values: list[float], digits: int, *, sign: bool = False) -> str:
    """The mean, and where there are several values half of the interval that holds it with `CONFIDENCE` (Student)."""
    mean = f"{statistics.fmean(values):{'+' if sign else ''}.{digits}f}"
    if len(values) == 1:
        return mean
    half = stdtrit(len(values) - 1, 0.5 + 0.5 * CONFIDENCE) * statistics.stdev(values) / len(values) ** 0.5
    return f"{mean} ± {half:.{digits}f}"


def draw_objects(work: Path, rows: list[dict]) -> None:
    """The pictures of docs/field.md, one for each object."""
    for each in dict.fromkeys(r["object"] for r in rows):
        of = {r["model"]: r for r in rows if r["object"] == each and r["seed"] == 0}
        draw_row(work, each, of, DOCS / "img" / f"field_{each}.png")


def draw_row(work: Path, name: str, rows: dict[str, dict], path: Path) -> None:
    """A held-out photograph beside what the models render of the object, and below how far each is from it."""
    photograph = _part(work / f"{name}_photograph.png", name)
    models = [model for model in rows if (work / f"{name}_{model}.png").exists()]
    height_over_width = photograph.shape[0] / photograph.shape[1]
    width = min(2.0, _HIGHEST_IN / height_over_width)
    size = (width * (len(models) + 1), 2.0 * width * height_over_width + 0.6)
    figure, plots = canvas(*size, nrows=2, ncols=len(models) + 1)
    for axes in plots.flat:
        axes.axis("off")
    plots[0, 0].imshow(photograph)
    scale_bar(plots[0, 0], next(iter(rows.values()))["px_per_m"])
    plots[0, 0].set_title("photograph", loc="left", color=INK, fontsize=9.5)
    plots[1, 0].text(
        0.0, 0.5, f"difference,\ntimes {TIMES:g}", transform=plots[1, 0].transAxes, color=SOFT, va="center"
    )
    for (above, below), model in zip(plots.T[1:], models, strict=True):
        rendered = _part(work / f"{name}_{model}.png", name)
        above.imshow(rendered)
        psnr = rows[model]["held_out_psnr_db"]
        above.set_title(f"{MODELS[model].label}, {psnr:.1f} dB", loc="left", color=INK, fontsize=9.5)
        apart = np.abs(rendered.astype(float) - photograph.astype(float)).mean(axis=2) / 255.0
        below.imshow(apart, cmap="gray_r", vmin=0.0, vmax=1.0 / TIMES)
    save(figure, path)


def _part(file: Path, name: str) -> np.ndarray:
    """The part of a picture (rows, columns, 3) that the object fills."""
    picture = np.asarray(Image.open(file).convert("RGB"))
    height, width = picture.shape[:2]
    x0, x1, y0, y1 = PARTS[name]
    return picture[round(y0 * height) : round(y1 * height), round(x0 * width) : round(x1 * width)]


def build(model: str, scene: ObjectScene, options, *, steps: int, seed: int = 0) -> VolumeRenderer:
    """An untrained scene of one of the models, where the options place it."""
    column = WaterColumn() if scene.train.water is not None else None
    # What an orbit sees beside the box is black; from above, every path ends in it.
    background = Backdrop((0.0, 0.0, 0.0)) if scene.name == "ship" else None
    device = choose_device(options.device)
    setup = Setup(scene.box, options.cells, device, steps=steps)
    volume = build_model(model, setup, seed=seed)
    renderer = VolumeRenderer(volume, column=column, background=background, proposal=volume.proposal(setup))
    return renderer.to(tensor_place(device))


def switch_to_fine(scene: VolumeRenderer) -> None:
    """Let the density weighting network run, where a model has one: only from then on it takes memory and time."""
    if isinstance(scene.model, TensorVolume) and scene.model.settings.weighting:
        scene.model.regression.switch_to_fine()


def scene_of(name: str, options) -> ObjectScene:
    """An object as it was drawn for this folder; drawn now if it was not."""
    path = options.work / f"{name}_{options.scale:g}.pickle"
    if not path.exists():
        path.write_bytes(pickle.dumps(load_scene(name, options.data, options.scale)))
    return pickle.loads(path.read_bytes())


def row(model: str, scene: ObjectScene, options, steps: int, seed: int, clock=time.perf_counter) -> dict:
    """Train one model on one object, and measure it, times by a clock of seconds."""
    device_mb(options.device)
    built = build(model, scene, options, steps=steps, seed=seed)
    training = Training(steps=steps, rays=options.rays, samples=options.samples)
    start = clock()
    cells, figures = train_volume(built, scene.train, training, lambda *done: None, seed=seed)
    seconds, memory = clock() - start, device_mb(options.device)
    rate, error, alike = [], [], []
    for number, camera in enumerate(scene.held.cameras):
        start = clock()
        view = render_volume(built, camera, scene.held.water, cells, samples=options.samples)
        rate.append(view.rgb[..., 0].size / (clock() - start))
        quality = held_quality(scene, number, view.rgb)
        error.append(10.0 ** (-0.1 * quality["psnr_db"]))
        alike.append(quality.get("ssim", float("nan")))
        if number == len(scene.held.cameras) // 2 and seed == 0:
            picture = np.round(255.0 * np.clip(view.rgb, 0.0, 1.0)).astype(np.uint8)
            Image.fromarray(picture).save(options.work / f"{scene.name}_{model}.png")
    return asdict(figures) | {
        "object": scene.name,
        "model": model,
        "seed": seed,
        "held_out_psnr_db": float(-10.0 * np.log10(np.mean(error))),
        "held_out_ssim": float(np.nanmean(alike)),
        "chamfer_m": chamfer(surface_of(built, scene, cells, options.samples), scene.surface),
        "parameters_mb": sum(p.numel() * p.element_size() for p in built.parameters()) / 1e6,
        "train_s": seconds,
        "train_mb": memory,
        "rays_per_s": statistics.median(rate),
        "px_per_m": scale_of(scene),
        "settings": settings_of(options),
    }


def held_quality(scene: ObjectScene, number: int, rgb: np.ndarray) -> dict[str, float]:
    """PSNR and SSIM of the rendering (H, W, 3) of a photograph that is held out, where it shows the object's box."""
    mask = np.zeros(rgb.shape[:2], dtype=bool)
    mask.flat[scene.held.pixels[number]] = True
    return image_quality(scene.held.images[number] / 255.0, rgb.clip(0.0, 1.0), mask=mask)


def scale_of(scene: ObjectScene) -> float:
    """Pixels that a metre covers along a row of the photograph that is shown, level in the middle of the box."""
    camera, water = scene.held.cameras[len(scene.held.cameras) // 2], scene.held.water
    middle = 0.5 * (scene.box.low + scene.box.high)
    level = 0.0 if water is None else water.point[2]
    u, v = camera.project(middle, water)
    return px_per_m(camera, water, (u, v), middle[2] - level)


def settings_of(options) -> dict:
    """What a row depends on beside object, model and seed."""
    names = ("scale", "cells", "rays", "samples", "steps", "seconds", "device")
    return {name: getattr(options, name) for name in names}


def device_mb(wanted: str) -> float | None:
    """Most memory [MB] that torch and Dr.Jit held on a CUDA device since the last call; None without one."""
    if tensor_place(choose_device(wanted)) != "cuda":
        return None
    import drjit as dr

    most = torch.cuda.max_memory_allocated() + dr.detail.malloc_watermark(dr.JitBackend.CUDA)
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    torch.cuda.reset_peak_memory_stats()
    return most / 1e6


def surface_of(built: VolumeRenderer, scene: ObjectScene, cells: Cells, samples: int) -> np.ndarray:
    """Points (N, 3) [m] at which every third training photograph sees the volume, one per 1/256 of the box."""
    parts = []
    for camera, pixels in list(zip(scene.train.cameras, scene.train.pixels, strict=True))[::3]:
        view = render_volume(built, camera, scene.train.water, cells, samples=samples)
        opaque = view.opacity.reshape(-1)[pixels] > 0.5
        parts.append(view.points.reshape(-1, 3)[pixels][opaque])
    points = np.concatenate(parts)
    inside = ((points > scene.box.low) & (points < scene.box.high)).all(axis=1)
    return thinned(points[inside], scene.box.edge / 256.0)


def step_times(
    models: tuple[str, ...], scene: ObjectScene, options, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Seconds of a training step of each model in its fine stage, median of rounds in which all take their turn."""
    scenes = {model: build(model, scene, options, steps=options.steps) for model in models}
    for built in scenes.values():
        switch_to_fine(built)
    training = Training(steps=TIMED[1], rays=options.rays, samples=options.samples, refresh=())
    seconds: dict[str, list[float]] = {model: [] for model in models}
    for turn in range(TIMED[0] + 1):
        for model, built in scenes.items():
            start = clock()
            train_volume(built, scene.train, training, lambda *done: None)
            if turn:  # the first compiles
                seconds[model].append((clock() - start) / TIMED[1])
    return {model: statistics.median(s) for model, s in seconds.items()}


def steps_mb(model: str, scene: str, options) -> float:
    """Memory [MB] that steps of a training take, with parameters, in a process of their own."""
    names = ("scale", "cells", "rays", "samples", "steps", "device")
    numbers = [f"--{name}={getattr(options, name)}" for name in names]
    command = [sys.executable, __file__, str(options.work), "--memory", scene, model, *numbers]
    run = subprocess.run(command, check=True, capture_output=True, text=True, env=os.environ | GIVEN_BACK)
    return float(run.stdout.split()[-1])


def print_memory(scene: str, model: str, options) -> None:
    """For `steps_mb`: the most that was held during steps of the fine stage, over what was held before."""
    loaded = scene_of(scene, options)
    training = Training(steps=POOL_STEPS, rays=options.rays, samples=options.samples, refresh=())
    # Compilers and libraries are loaded once, for all models alike.
    tiny = build("mdw", loaded, argparse.Namespace(**(vars(options) | {"cells": 16})), steps=options.steps)
    train_volume(tiny, loaded.train, replace(training, rays=64), lambda *done: None)
    before = _resident_mb("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    built = build(model, loaded, options, steps=options.steps)
    switch_to_fine(built)
    train_volume(built, loaded.train, training, lambda *done: None)
    sys.stdout.write(f"{_resident_mb('VmHWM') - before:.1f}\n")


def _resident_mb(what: str) -> float:
    """Memory that this process holds (VmRSS), or held at most (VmHWM), [MB]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(what)) / 1024


def kept(path: Path, compute: Callable[[], dict]) -> dict:
    """What a file of an earlier run holds, or what is computed now, and kept."""
    if path.exists():
        return json.loads(path.read_text())
    found = compute()
    part = path.with_suffix(".part")
    part.write_text(json.dumps(found, indent=2))
    part.rename(path)
    return found


def measure(options) -> list[dict]:
    """All requested rows."""
    rows = []
    for name in options.objects:
        scene = scene_of(name, options)
        middle = len(scene.held.images) // 2
        Image.fromarray(scene.held.images[middle]).save(options.work / f"{name}_photograph.png")
        path = options.work / f"{name}_times_{'_'.join(options.models)}.json"
        times = kept(path, lambda s=scene: step_times(tuple(options.models), s, options))
        for model in options.models:
            make = partial(row, model, scene, options, steps_of(options, times[model]))
            of_model = [
                kept(options.work / f"{name}_{model}_{seed}.json", partial(make, seed)) for seed in range(options.seeds)
            ]
            if any(each["settings"] != settings_of(options) for each in of_model):
                raise SystemExit(f"{options.work} has rows of {name}, {model} with other settings; name another folder")
            memory = None
            if of_model[0]["train_mb"] is None:
                path = options.work / f"{name}_{model}_memory.json"
                memory = kept(path, lambda m=model, n=name: {"mb": steps_mb(m, n, options)})["mb"]
            rows += [each | {"steps_mb": memory, "step_s": times[model]} for each in of_model]
    return rows


def steps_of(options, step_s: float) -> int:
    """Steps of a training: as asked, or as many as take the time that was asked for."""
    return options.steps if options.seconds is None else max(round(options.seconds / step_s), LEAST_STEPS)


def parser_of() -> argparse.ArgumentParser:
    """The options."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path, help="folder for rows and pictures")
    parser.add_argument("--objects", nargs="+", default=NAMES, choices=NAMES)
    parser.add_argument("--models", nargs="+", default=ABLATION, choices=tuple(MODELS))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--scale", type=float, default=0.25, help="of the pictures")
    parser.add_argument("--cells", type=int, default=128, help="along the longest edge, at the finest scale")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seconds", type=float, help="of each training, in place of --steps")
    parser.add_argument("--rays", type=int, default=2048)
    parser.add_argument("--samples", type=int, default=32, help="of each path")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda", "torch"))
    parser.add_argument("--draw", action="store_true", help="the pictures of docs/field.md")
    parser.add_argument("--memory", nargs=2, help=argparse.SUPPRESS)
    return parser


def parsed(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The command line, with the folder of the surveys."""
    options = parser.parse_args()
    folder = os.environ.get("BATHYNERF_DATA")
    options.data = Path(folder) if folder else Path(__file__).resolve().parents[2] / "shared" / "data"
    return options


def main() -> None:
    """Measure and print, and draw with --draw."""
    options = parsed(parser_of())
    options.work.mkdir(parents=True, exist_ok=True)
    if options.memory:
        print_memory(*options.memory, options)
        return
    rows = measure(options)
    sys.stdout.write(table_of(rows) + "\n")
    if options.draw:
        draw_objects(options.work, rows)


if __name__ == "__main__":
    main()
