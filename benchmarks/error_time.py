"""Errors of published fields with time, dry and under water, on the scene of `bench_switches`."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import torch
from switch_scene import BOX, WATER, SwitchScene, build

from fields.device import choose_device
from fields.volume.models import build_model, proposal_for
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
    scene.held.priors = [PriorImages(length=length, std=ones) for length in scene.length]
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
    """Errors of a model after each time, dry or wet."""
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
    return {"model": name, "scene": where, "seed": seed, "steps": steps, "looks": looks}
