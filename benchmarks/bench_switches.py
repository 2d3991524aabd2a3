"""What does each switch of a volume's training give on its own? A small scene under water, held-out views, two seeds.

    python benchmarks/bench_switches.py -o FOLDER [--only NAME ...] [--steps N] [--seeds N]

Every row trains the same field with the same paths; one JSON per row and seed is kept in FOLDER and not computed again.
Writes FOLDER/switches.md: PSNR of held-out views, error of depth there, and processor time against the row it is
compared with.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from switch_scene import BOX, WATER, Backdrop, SwitchScene, build
from torch import nn

from fields.device import choose_device
from fields.models import Losses
from fields.volume.fitted import appearance_vectors, match_appearance
from fields.volume.photographs import Photographs
from fields.volume.renderer import VolumeRenderer, render_volume
from fields.volume.sampling import Cells
from fields.volume.shell import Shell
from fields.volume.tensor import TensorSettings, TensorVolume
from fields.volume.train import Training, train_volume

SETTINGS = TensorSettings(scales=3, n_min=16, n_max=64, degree=0)
TRAINING = Training(steps=400, rays=768, samples=24, cells=48)
APPEARANCE = 8


@dataclass(frozen=True)
class Row:
    """One switch alone.

    Attributes
    ----------
    against : str
        Name of the row that differs from it by the switch.
    losses : Losses
    kind : str
        Of the photographs: "plain", "exposed" or "wide".
    part : str
        "appearance", "shell", "black" or "colour": what the scene has besides the volume; "colour" is the mean of the
        photographs behind it.
    """

    against: str = "none"
    losses: Losses = field(default_factory=Losses)
    kind: str = "plain"
    part: str = ""


# Weights: those of the papers for transparency, distortion and density; else such that the gradient is about a fifth of
# that of the colours after 240 steps.
ROWS = {
    "none": Row(),
    "distortion 0.002": Row(losses=Losses(distortion=0.002)),
    "density 0.002": Row(losses=Losses(density=0.002)),
    "Gaussian density 0.008": Row(losses=Losses(gaussian_density=0.008)),
    "density as printed 0.002": Row(losses=Losses(printed_density=0.002)),
    "Gaussian density as printed 0.002": Row(losses=Losses(printed_gaussian_density=0.002)),
    "empty 0.001": Row(losses=Losses(empty=0.001)),
    "density, distortion, empty": Row(losses=Losses(printed_density=0.002, distortion=0.002, empty=0.001)),
    "monocular depth 0.01": Row(losses=Losses(depth=0.01)),
    "monocular normals 0.0001": Row(losses=Losses(normal=0.0001)),
    # A loss of no weight to speak of: what drawing patches costs.
    "patches of 8 px": Row(losses=Losses(ncc=1e-12)),
    "NCC 0.0003": Row("patches of 8 px", Losses(ncc=0.0003)),
    "SSIM 0.003": Row("patches of 8 px", Losses(ssim=0.003)),
    "virtual patches 0.0003": Row("patches of 8 px", Losses(virtual_patches=0.0003)),
    # Behind the box as a rule is nothing: the last sample is opaque.
    "black behind": Row(part="black"),
    "one colour behind": Row(part="colour"),
    "transparency 0.001": Row("one colour behind", Losses(transparency=0.001), part="colour"),
    "exposures, no vectors": Row("exposures, no vectors", kind="exposed"),
    "exposures, vectors of 8": Row("exposures, no vectors", kind="exposed", part="appearance"),
    "beyond the box, nothing": Row("beyond the box, nothing", kind="wide"),
    "beyond the box, shell": Row("beyond the box, nothing", kind="wide", part="shell"),
}


@cache
def scene_of(kind: str) -> SwitchScene:
    return build(exposed=kind == "exposed", wide=kind == "wide", priors=True)


def measure(row: Row, training: Training, seed: int) -> dict:
    """PSNR [dB], median and 90th percentile of depth errors [m] of held-out views, and processor time [s]."""
    data = scene_of(row.kind)
    length = APPEARANCE if row.part == "appearance" else 0
    torch.manual_seed(seed)
    volume = TensorVolume(BOX, SETTINGS, choose_device("cpu"), appearance=length)
    scene = VolumeRenderer(
        volume,
        appearance=appearance_vectors(len(data.train.cameras), length) if length else None,
        background=behind(row.part, data.train),
    )
    training = replace(training, losses=row.losses)
    start = time.process_time()
    cells, figures = train_volume(scene, data.train, training, lambda *done: None, seed=seed)
    seconds = time.process_time() - start
    if length:
        scene.appearance = match_appearance(scene, data.held.left_half, cells)
    quality = compare(scene, data, cells, right_half=row.kind == "exposed")
    return {**quality, "seconds": seconds, "steps": training.steps, "train_psnr_db": figures.psnr_db}


def behind(part: str, photographs: Photographs) -> nn.Module | None:
    """The background of a row."""
    if part == "shell":
        return Shell(BOX)
    if part == "black":
        return Backdrop((0.0, 0.0, 0.0))
    if part == "colour":
        shown = [i.reshape(-1, 3)[p] for i, p in zip(photographs.images, photographs.pixels, strict=True)]
        red, green, blue = (np.concatenate(shown).mean(axis=0) / 255.0).tolist()
        return Backdrop((red, green, blue))
    return None


def compare(scene: VolumeRenderer, data: SwitchScene, cells: Cells, *, right_half: bool) -> dict:
    """Against held-out views; with exposures per view, against the right halves: the left ones fit the exposures."""
    squares, errors = [], []
    for view, camera in enumerate(data.held.cameras):
        seen = render_volume(scene, camera, WATER, cells, samples=64, view=view)
        shown = np.zeros(camera.height * camera.width, dtype=bool)
        shown[data.held.pixels[view]] = True
        shown = shown.reshape(camera.height, camera.width)
        if right_half:
            shown[:, : camera.width // 2] = False
        squares.append(((seen.rgb - data.held.images[view] / 255.0) ** 2)[shown])
        error = np.abs(seen.distance - data.length[view])[shown]
        errors.append(error[np.isfinite(error)])
    error = np.concatenate(errors)
    return {
        "psnr_db": -10.0 * np.log10(np.concatenate(squares).mean()),
        "depth_median_m": float(np.median(error)),
        "depth_p90_m": float(np.quantile(error, 0.9)),
    }


def table(results: dict[str, list[dict]]) -> str:
    """Markdown: means over seeds, and in brackets what the switch changes, with half of its range over the seeds."""
    lines = [
        "| switch | PSNR [dB] | median depth error [mm] | 90 % of depth errors within [mm] | time |",
        "|---|---|---|---|---|",
    ]
    for name, found in results.items():
        base = results.get(ROWS[name].against)
        if base is None:
            continue
        columns = [
            _cell(found, base, lambda r: r["psnr_db"], 2),
            _cell(found, base, lambda r: 1000.0 * r["depth_median_m"], 1),
            _cell(found, base, lambda r: 1000.0 * r["depth_p90_m"], 0),
        ]
        ratio = np.mean([f["seconds"] / b["seconds"] for f, b in zip(found, base, strict=False)])
        title = name if ROWS[name].against in ("none", name) else f"{name}, against {ROWS[name].against}"
        lines.append(f"| {title} | {' | '.join(columns)} | {ratio:.2f} |")
    return "\n".join(lines) + "\n"


def _cell(found: list[dict], base: list[dict], figure: Callable[[dict], float], digits: int) -> str:
    mean = f"{np.mean([figure(r) for r in found]):.{digits}f}"
    if found is base:
        spread = 0.5 * np.ptp([figure(r) for r in found])
        return f"{mean} ± {spread:.{digits}f}"
    change = [figure(f) - figure(b) for f, b in zip(found, base, strict=False)]
    spread = f" ± {0.5 * np.ptp(change):.{digits}f}" if len(change) > 1 else ", one seed"
    return f"{mean} ({np.mean(change):+.{digits}f}{spread})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=list(ROWS), choices=list(ROWS), metavar="NAME")
    parser.add_argument("--steps", type=int, default=TRAINING.steps)
    parser.add_argument("--seeds", type=int, default=2)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    training = replace(TRAINING, steps=options.steps)
    results: dict[str, list[dict]] = {}
    for seed in range(options.seeds):
        for name in options.only:
            file = options.out / f"{name.replace(' ', '_').replace(',', '')}_{options.steps}_{seed}.json"
            if not file.is_file():
                file.write_text(json.dumps(measure(ROWS[name], training, seed)))
            results.setdefault(name, []).append(json.loads(file.read_text()))
            print(seed, name, results[name][-1], flush=True)  # noqa: T201
            (options.out / "switches.md").write_text(table(results))


if __name__ == "__main__":
    main()
