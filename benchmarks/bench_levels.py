"""What does a scene look like at each level of detail of a field, and what does it cost?

    python benchmarks/bench_levels.py WORK [--models octree ground] [--steps N] [--views N] [--dists F]

An octree of fields (as Inf-NeRF) and ground planes (as Grid-NeRF) of three levels, 64 cells at the finest, learn the
scene of `bench_switches`; then held-out views of four times its size are rendered at each level. Results are
kept in WORK for the same settings and code. DISTS needs its weights, a state dict of torch. Prints Markdown.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

import numpy as np
import torch
from kept_results import kept_result
from switch_scene import BOX, WATER, SwitchScene, build

from evaluation.images.quality import image_quality
from fields.device import choose_device
from fields.volume.model import VolumeModel
from fields.volume.models import build_model
from fields.volume.renderer import VolumeRenderer, render_volume
from fields.volume.sampling import Cells
from fields.volume.train import Training, train_volume

CELLS, LEVELS, ENLARGED = 64, 3, 4.0
TRAINING = {"rays": 768, "samples": 24, "cells": 48}
MEASURES = ("psnr_db", "ssim", "ms_ssim", "gmsd", "ms_gmsd", "vsi", "dists")
HEAD = (
    "| model | level | cell | read | multiplications | PSNR [dB] | SSIM | MS-SSIM | GMSD | MS-GMSD | VSI | DISTS "
    "| median depth error |",
    "|---" * 13 + "|",
)


def at_level(model: VolumeModel, level: int) -> dict:
    """Set a model to a level, 0 the coarsest: its cell [m], numbers that it may read, multiplications of a sample."""
    heads = sum(p.numel() for name, p in model.named_parameters() if p.dim() == 2 and "table" not in name)
    if hasattr(model, "footprint"):
        model.footprint = model.cell(level) if level < LEVELS - 1 else 0.0
        features = model.settings.features
        nodes = int((model.level <= level).sum())
        return {"cell_m": model.cell(level), "read": nodes * model.table[0].numel(), "products": 8 * features + heads}
    model.levels = level + 1
    grids, channels = model.factors.grids[: level + 1], model.settings.channels
    heads -= model.factors.planes.numel() + model.factors.vectors.numel()
    read = sum((g.nx * g.ny + g.nz) * channels for g in grids)
    return {"cell_m": BOX.edge / grids[-1].nx, "read": read, "products": 7 * channels * (level + 1) + heads}


def measure(name: str, scene: SwitchScene, options) -> list[dict]:
    """A row for each level."""
    model = build_model(name, BOX, CELLS, choose_device("cpu"), steps=options.steps)
    renderer = VolumeRenderer(model)
    cells, _ = train_volume(renderer, scene.train, Training(steps=options.steps, **TRAINING), lambda share: None)
    rows = []
    for level in range(LEVELS):
        cost = at_level(model, level)
        found = [of_view(renderer, scene, view, cells, options.dists) for view in range(options.views)]
        means = {key: float(np.mean([f[key] for f in found])) for key in found[0]}
        rows.append({"model": name, "level": level} | cost | means)
        sys.stderr.write(f"{rows[-1]}\n")
    return rows


def of_view(renderer: VolumeRenderer, scene: SwitchScene, view: int, cells: Cells, dists: Path | None) -> dict:
    """Measures of one held-out view, and its median error of depth [m]."""
    camera = scene.held.cameras[view]
    seen = render_volume(renderer, camera, WATER, cells, samples=48)
    shown = np.zeros(camera.height * camera.width, dtype=bool)
    shown[scene.held.pixels[view]] = True
    shown = shown.reshape(camera.height, camera.width)
    weights = {} if dists is None else {"dists_weights": torch.load(dists, map_location="cpu", weights_only=True)}
    found = image_quality(scene.held.images[view] / 255.0, seen.rgb.astype(float), mask=shown, **weights)
    error = np.abs(seen.distance - scene.length[view])[shown]
    return {k: v for k, v in found.items() if k in MEASURES} | {"depth_m": float(np.nanmedian(error))}


def line(row: dict) -> str:
    """A row as Markdown."""
    digits = {"psnr_db": 1} | dict.fromkeys(MEASURES[1:], 3)
    measures = [f"{row[k]:.{digits[k]}f}" if k in row else "-" for k in MEASURES]
    cost = [f"{100.0 * row['cell_m']:.1f} cm", f"{row['read'] / 250.0:.0f} kB", f"{row['products']:,}"]
    return (
        "| " + " | ".join([row["model"], str(row["level"]), *cost, *measures, f"{1e3 * row['depth_m']:.0f} mm"]) + " |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--models", nargs="+", default=["octree", "ground"], choices=["octree", "ground"])
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--dists", type=Path)
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    scene, lines = build(enlarged=ENLARGED), [*HEAD]
    for name in options.models:
        settings = {"steps": options.steps, "views": options.views, "dists": options.dists and str(options.dists)}
        rows = kept_result(options.work, name, settings, __file__, partial(measure, name, scene, options))
        lines += [line(row) for row in rows]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
