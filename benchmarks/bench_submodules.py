"""Does a field for each cell of a drawn tidal flat show photographs better than one field of the same size?

    python benchmarks/bench_submodules.py -o WORK [--seeds N] [--steps N] [--grid NxM] [--trainings NAME ...]

The table of the tidal-flat paper in small: one field; submodules; their looks matched; views that drop submodules. Each
photograph has its own exposure and tint: those of a photograph that was kept aside are found from its left half, in the
submodule that shows most of it, and compared in its right half. Trainings are kept in WORK, a process for each, and not
done again. Prints the table, and writes it to WORK/submodules.md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from flat_scene import BOX, WATER, FlatScene, build
from switch_scene import left_half_of

from evaluation import distance_statistics, distance_to_mesh, psnr, ssim
from evaluation.images.inputs import largest_rectangle
from fields.device import choose_device
from fields.sweep.kernels.arrays import free_unused
from fields.volume.appearance import appearance_vectors, match_appearance
from fields.volume.paths import Box
from fields.volume.photographs import Photographs, pixels_over
from fields.volume.renderer import VolumeRenderer, render_volume
from fields.volume.sampling import Cells
from fields.volume.shell import Shell
from fields.volume.submodules import (
    Grid,
    Submodule,
    ground_shares,
    kept,
    match_submodules,
    pose_weights,
    render_submodules,
    single_vector,
    vectors_of,
)
from fields.volume.surface import surface_of
from fields.volume.tensor import TensorSettings, TensorVolume
from fields.volume.train import Training, train_volume
from fields.volume.visibility import Visibility, train_visibility

SETTINGS = TensorSettings.mdw(scales=3, n_min=16, n_max=64, degree=0)
TRAINING = Training(steps=200, rays=512, samples=24, cells=48)
VECTOR, SIDE_M, SAMPLES = 8, 0.08, 32
# Rays of each step that fits a vector.
RAYS = 128
# The bed that a run would know: its points are so far apart, and so far off.
BED_M, BED_STD_M = 0.05, 0.02


@dataclass(frozen=True)
class Kind:
    """One training: of one field or of submodules, with vectors of photographs, a shell, and times the steps."""

    submodules: bool = False
    vectors: bool = False
    shell: bool = False
    times: bool = False  # as many steps as all submodules together


KINDS = {
    "one": Kind(),
    "one, long": Kind(times=True),
    "one, long, vectors": Kind(times=True, vectors=True),
    "submodules": Kind(submodules=True),
    "submodules, vectors": Kind(submodules=True, vectors=True),
    "submodules, vectors, shell": Kind(submodules=True, vectors=True, shell=True),
}


def seen_in(photographs: Photographs, box: Box, *, whole: bool) -> Photographs:
    """The photographs that show a box, of the pixels that do, or of all."""
    lists = []
    for camera, image, own in zip(photographs.cameras, photographs.images, photographs.pixels, strict=True):
        pixels = np.intersect1d(pixels_over(camera, box, WATER), own)
        if len(pixels):
            lists.append((camera, image, np.arange(camera.width * camera.height) if whole else pixels))
    return Photographs(*(list(column) for column in zip(*lists, strict=True)), WATER)


def bed_of(scene: FlatScene, seed: int) -> np.ndarray:
    points, _ = scene.flat.grid(BED_M)
    return points + np.random.default_rng(seed).normal(0.0, BED_STD_M, points.shape) * (0.0, 0.0, 1.0)


def about(bed: np.ndarray, box: Box) -> Cells:
    """The cells of a proxy about the known bed, as `bathynerf field` begins with."""
    everywhere = Cells.everywhere(box, TRAINING.cells)
    inside = bed[((bed > box.low) & (bed < box.high)).all(axis=1)]
    index = ((inside - box.low) / box.size * everywhere.occupied.shape).astype(int)
    filled = np.zeros(everywhere.occupied.shape, dtype=np.float32)
    filled[tuple(index.T)] = 1.0
    return everywhere.refined(torch.from_numpy(filled.ravel()), 0.5, TRAINING.margin * box.edge / TRAINING.cells)


def renderer_of(kind: Kind, box: Box, photographs: int, seed: int) -> VolumeRenderer:
    torch.manual_seed(seed)
    length = VECTOR if kind.vectors else 0
    model = TensorVolume(box, SETTINGS, choose_device("cpu"), appearance=length, seed=seed)
    vectors = appearance_vectors(photographs, length) if length else None
    return VolumeRenderer(model, appearance=vectors, background=Shell(box) if kind.shell else None)


def boxes_of(kind: Kind, grid: Grid) -> list[Box]:
    return [grid.box_of(number) for number in range(len(grid))] if kind.submodules else [BOX]


def memory_mb(row: str) -> float:
    """A row of this process's status, in MB."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status[row].split()[0]) / 1024.0


def train_kind(kind: Kind, grid: Grid, seed: int, steps: int) -> dict:
    """The states of all volumes of a kind, and what they took."""
    scene, saved = build(seed), []
    bed, before, seconds = bed_of(scene, seed), memory_mb("VmRSS"), []
    for box in boxes_of(kind, grid):
        photographs = seen_in(scene.train, box, whole=kind.shell)
        renderer = renderer_of(kind, box, len(photographs.cameras), seed)
        training = replace(TRAINING, steps=steps * (len(grid) if kind.times else 1))
        start = time.process_time()
        cells, figures = train_volume(
            renderer, photographs, training, lambda done: None, cells=about(bed, box), seed=seed
        )
        seconds.append(time.process_time() - start)
        peak = memory_mb("VmHWM") - before
        inner = seen_in(scene.train, box, whole=False)
        network = train_visibility(renderer, inner, cells, seed=seed) if kind == KINDS["submodules, vectors"] else None
        saved.append(
            {
                "renderer": renderer.state_dict(),
                "occupied": cells.occupied,
                "photographs": len(photographs.cameras),
                "network": None if network is None else network.state_dict(),
                "parameters": figures.parameters,
            }
        )
        free_unused(choose_device("cpu"))
    return {"volumes": saved, "seconds": seconds, "peak_mb": peak}


def loaded(kind: Kind, grid: Grid, state: dict, seed: int) -> list[Submodule]:
    found = []
    for number, (box, saved) in enumerate(zip(boxes_of(kind, grid), state["volumes"], strict=True)):
        renderer = renderer_of(kind, box, saved["photographs"], seed)
        renderer.load_state_dict(saved["renderer"])
        found.append(Submodule(number, renderer, Cells(box, saved["occupied"])))
    return found


def compared(scene: FlatScene, view: int, rgb: np.ndarray) -> dict[str, float]:
    """PSNR [dB] and SSIM of the right half of a photograph that was kept aside."""
    camera = scene.held.cameras[view]
    mask = np.zeros((camera.height, camera.width), dtype=bool)
    mask.flat[scene.held.pixels[view]] = True
    mask[:, : camera.width // 2] = False
    photograph = scene.held.images[view] / 255.0
    rows, columns = largest_rectangle(mask)
    return {"psnr_db": psnr(photograph, rgb, mask), "ssim": ssim(photograph[rows, columns], rgb[rows, columns])}


def of_left_half(submodules: list[Submodule], scene: FlatScene, view: int) -> int | None:
    """Give the submodule that shows most of a photograph's left half its look there; the index of it."""
    left = left_half_of(scene.held)
    camera, own = left.cameras[view], left.pixels[view]
    pixels = [np.intersect1d(own, pixels_over(camera, each.box, WATER)) for each in submodules]
    root = int(np.argmax([len(each) for each in pixels]))
    photograph = Photographs([camera], [left.images[view]], [pixels[root]], WATER)
    chosen = submodules[root]
    vectors = match_appearance(chosen.renderer, photograph, chosen.cells, rays=RAYS)
    chosen.renderer.appearance = single_vector(vectors.weight[0])
    return root


def rows_of_one(kind: Kind, volume: Submodule, scene: FlatScene) -> dict[str, list[dict]]:
    """Figures of each photograph that was kept aside."""
    renderer, found = volume.renderer, []
    if kind.vectors:
        renderer.appearance = match_appearance(renderer, left_half_of(scene.held), volume.cells, rays=RAYS)
    for view, camera in enumerate(scene.held.cameras):
        start = time.process_time()
        seen = render_volume(renderer, camera, WATER, volume.cells, samples=SAMPLES, view=view)
        found.append(compared(scene, view, seen.rgb) | {"render_s": time.process_time() - start, "rendered": 1.0})
    return {"": found}


class Views:
    """Views of submodules under the variants of the table."""

    def __init__(self, submodules: list[Submodule], grid: Grid, scene: FlatScene, bed: np.ndarray):
        self.submodules, self.grid, self.scene, self.bed = submodules, grid, scene, bed
        self.rows: dict[str, list[dict]] = {}

    def show(self, row: str, view: int, visible=None) -> None:
        """A view, of those submodules that are visible to it."""
        camera, start = self.scene.held.cameras[view], time.process_time()
        weights = pose_weights(camera.centre, [each.box for each in self.submodules])
        numbers = range(len(self.submodules)) if visible is None else kept(visible(camera))
        chosen = [(float(weights[k]), self.submodules[k]) for k in numbers]
        seen = render_submodules(chosen, self.grid, camera, WATER, samples=SAMPLES)
        seconds = time.process_time() - start
        shown = {"render_s": seconds, "rendered": float(len(chosen))}
        self.rows.setdefault(row, []).append(compared(self.scene, view, seen.rgb) | shown)

    def own_ground(self, row: str, view: int) -> None:
        """Each pixel from the submodule on whose ground its place lies: no blend."""
        camera = self.scene.held.cameras[view]
        start = time.process_time()
        chosen = [(1.0, each) for each in self.submodules]
        points = render_submodules(chosen, self.grid, camera, WATER, samples=SAMPLES).points
        owner, rgb = self.grid.owner(points), np.zeros((*points.shape[:2], 3))
        for each in self.submodules:
            seen = render_volume(each.renderer, camera, WATER, each.cells, samples=SAMPLES)
            rgb = np.where((owner == each.number)[..., None], seen.rgb, rgb)
        shown = {"render_s": time.process_time() - start, "rendered": float(len(chosen))}
        self.rows.setdefault(row, []).append(compared(self.scene, view, rgb) | shown)


def rows_of_submodules(kind: Kind, views: Views, state: dict) -> dict[str, list[dict]]:
    """Figures of each photograph that was kept aside, under each variant."""
    networks = []
    for each, saved in zip(views.submodules, state["volumes"], strict=True):
        if saved["network"] is not None:
            networks.append((Visibility(each.box), each.cells))
            networks[-1][0].load_state_dict(saved["network"])
    owns = [each.renderer.appearance for each in views.submodules]
    for view in range(len(views.scene.held.cameras)):
        if not kind.vectors:
            views.show("", view)
            continue
        for each, own in zip(views.submodules, owns, strict=True):
            each.renderer.appearance = own
        root = of_left_half(views.submodules, views.scene, view)
        for number, each in enumerate(views.submodules):
            if number != root:
                each.renderer.appearance = single_vector(vectors_of(each).mean(dim=0))
        views.show("", view)
        for number, (each, own) in enumerate(zip(views.submodules, owns, strict=True)):
            each.renderer.appearance = each.renderer.appearance if number == root else own
        match_submodules(views.submodules, root, views.scene.train.cameras, views.bed, WATER, rays=RAYS)
        views.show("matched", view)
        if networks:
            views.own_ground("matched, each on its own ground", view)
            views.show(
                "matched, dropped by geometry", view,
                lambda camera: ground_shares(views.grid, views.bed, camera, WATER),
            )  # fmt: skip
            views.show(
                "matched, dropped by network", view,
                lambda camera: np.array([network.of_view(camera, WATER, cells) for network, cells in networks]),
            )  # fmt: skip
    return views.rows


def of_surface(kind: Kind, submodules: list[Submodule], grid: Grid, scene: FlatScene) -> dict[str, float]:
    """Distances [m] of the extracted surface to the true bed: of each submodule on its own ground."""
    parts = []
    for each in submodules:
        photographs = seen_in(scene.train, each.box, whole=False)
        surface = surface_of(each.renderer, photographs, each.cells, samples=SAMPLES, side=SIDE_M)
        own = grid.owner(surface.xyz) == each.number if kind.submodules else slice(None)
        parts.append(surface.xyz[own])
    points = np.concatenate(parts)
    statistics = distance_statistics(distance_to_mesh(points, *scene.flat.grid(BED_M)).signed)
    return {
        "points": len(points), "c2m_mean_mm": 1e3 * statistics.mean_inner90_m,
        "c2m_std_mm": 1e3 * statistics.std_inner90_m,
    }  # fmt: skip


def measured(name: str, grid: Grid, state: dict, seed: int) -> dict[str, dict]:
    """Rows of the table that come from one training."""
    kind, scene = KINDS[name], build(seed)
    submodules = loaded(kind, grid, state, seed)
    common = of_surface(kind, submodules, grid, scene) | {
        "train_s": sum(state["seconds"]),
        "parameters_mb": max(each["parameters"] for each in state["volumes"]) * 4e-6,
        "peak_mb": state["peak_mb"],
    }
    if kind.submodules:
        rows = rows_of_submodules(kind, Views(submodules, grid, scene, bed_of(scene, seed)), state)
    else:
        rows = rows_of_one(kind, submodules[0], scene)
    mean = {row: {key: float(np.mean([v[key] for v in views])) for key in views[0]} for row, views in rows.items()}
    return {", ".join(filter(None, (name, row))): common | figures for row, figures in mean.items()}


COLUMNS = {
    "psnr_db": ("PSNR [dB]", 2), "ssim": ("SSIM", 3), "c2m_mean_mm": ("C2M mean [mm]", 0),
    "c2m_std_mm": ("C2M std [mm]", 0), "train_s": ("training [s]", 0), "render_s": ("a view [s]", 2),
    "rendered": ("rendered", 1), "parameters_mb": ("parameters of one [MB]", 2), "peak_mb": ("peak [MB]", 0),
}  # fmt: skip


def table(found: dict[str, list[dict]]) -> str:
    """Markdown: the figures of each seed."""
    lines = [f"| | {' | '.join(title for title, _ in COLUMNS.values())} |", f"|---{'|---' * len(COLUMNS)}|"]
    for name, rows in found.items():
        cells = [", ".join(f"{row[key]:.{digits}f}" for row in rows) for key, (_, digits) in COLUMNS.items()]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--steps", type=int, default=TRAINING.steps)
    parser.add_argument("--grid", default="3x1")
    parser.add_argument("--trainings", nargs="*", default=list(KINDS), choices=list(KINDS), metavar="NAME")
    parser.add_argument("--train", nargs=2, metavar=("NAME", "SEED"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    columns, rows = options.grid.split("x")
    grid = Grid(BOX, (int(columns), int(rows)))
    if options.train:
        name, seed = options.train
        torch.save(train_kind(KINDS[name], grid, int(seed), options.steps), options.out)
        return
    options.out.mkdir(parents=True, exist_ok=True)
    found: dict[str, list[dict]] = {}
    for seed in range(options.seeds):
        for name in options.trainings:
            stem = options.out / f"{name.replace(', ', '_')}_{options.grid}_{options.steps}_{seed}"
            state, figures = stem.with_suffix(".pt"), stem.with_suffix(".json")
            if not state.is_file():
                settings = ["--steps", str(options.steps), "--grid", options.grid]
                subprocess.run(
                    [sys.executable, __file__, "-o", str(state), *settings, "--train", name, str(seed)], check=True
                )
            if not figures.is_file():
                figures.write_text(json.dumps(measured(name, grid, torch.load(state, weights_only=False), seed)))
            for row, values in json.loads(figures.read_text()).items():
                found.setdefault(row, []).append(values)
                print(seed, row, values, flush=True)  # noqa: T201
            (options.out / "submodules.md").write_text(table(found))
    print(table(found))  # noqa: T201


if __name__ == "__main__":
    main()
