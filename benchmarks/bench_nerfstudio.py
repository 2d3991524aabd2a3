"""Nerfacto of nerfstudio with bent rays beside the fields here: equal photographs, rays a step, processor time, scores.

    python benchmarks/bench_nerfstudio.py WORK [--objects hull wreck] [--models hash mdw ...] [--seconds S] [--seeds N]
                                          [--sizes small published] [--scale S] [--cells N_MAX] [--rays N]

Nerfacto's field, proposals, samplers, losses and optimiser are nerfstudio's own, in torch, at the published size and at
that of our ``hash``. As in BathyFacto a ray is bent before samples are drawn on it: its bundle begins where the bent
path enters the box. Poses are exact, so that the refinement of cameras is off, and exposures equal, so that there is no
appearance. Learning rates fall to a tenth, as here. Without nerfstudio (`pip install nerfstudio`) its rows are left
out. Every row is a file in WORK; what is there is not computed again.
"""

import argparse
import statistics
import sys
import time
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec

import numpy as np
import torch
from bench_field import (
    chamfer,
    held_quality,
    interval,
    kept,
    parsed,
    parser_of,
    row,
    scene_of,
    settings_of,
    step_times,
    steps_of,
    thinned,
)
from object_scenes import ObjectScene

from fields.models import MODELS
from fields.volume.paths import Paths, paths_of
from fields.volume.train import POOL_STEPS, psnr_db

# Changes of nerfstudio's settings, and of its proposals: none at the published size; as those of our `hash`.
SIZES: dict[str, dict] = {
    "published": {},
    "small": {
        "num_levels": 8,
        "log2_hashmap_size": 15,
        "num_proposal_samples_per_ray": (48,),
        "num_proposal_iterations": 1,
    },
}
LABELS = {"published": "Nerfacto of nerfstudio", "small": "Nerfacto of nerfstudio, of the size of `hash`"}
# As its method `nerfacto` has them.
RATE, EPSILON, FINAL_RATE = 1e-2, 1e-15, 0.1
CHUNK = 1 << 12
TIMED = 8  # Steps of a round whose time is taken
HEAD = (
    "| object | model | held-out PSNR | SSIM | Chamfer distance | steps | a step, CPU | rays/s |",
    "|---|---|---|---|---|---|---|---|",
)


@dataclass
class Nerfacto:
    """nerfstudio's Nerfacto in the box of a scene, trained along bent paths."""

    scene: ObjectScene
    options: argparse.Namespace
    size: str
    steps: int
    seed: int

    def __post_init__(self):
        torch.manual_seed(self.seed)
        self.model = self._build()
        groups = self.model.get_param_groups()
        self.optimisers = [
            torch.optim.Adam(parameters, lr=RATE, eps=EPSILON) for parameters in groups.values() if parameters
        ]

    def _build(self):
        import torchmetrics.image.lpip as lpip
        from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
        from nerfstudio.data.scene_box import SceneBox
        from nerfstudio.models.nerfacto import NerfactoModelConfig

        # LPIPS, which is not scored here, would fetch its weights.
        lpip.LearnedPerceptualImagePatchSimilarity = lambda **_settings: torch.nn.Identity()
        box = self.scene.box
        config = NerfactoModelConfig(
            implementation="torch",
            max_res=4 * self.options.cells,
            num_nerf_samples_per_ray=self.options.samples,
            disable_scene_contraction=True,
            proposal_initial_sampler="uniform",
            use_appearance_embedding=False,
            camera_optimizer=CameraOptimizerConfig(mode="off"),
            proposal_weights_anneal_max_num_iters=max(self.steps // 30, 1),
            proposal_warmup=max(self.steps // 6, 1),
            **SIZES[self.size],
        )
        aabb = torch.tensor(np.stack([box.low, box.high]), dtype=torch.float32)
        model = config.setup(scene_box=SceneBox(aabb), num_train_data=len(self.scene.train.images))
        model.collider = None  # paths bring where they enter and leave the box
        return model

    def bundle_of(self, paths: Paths):
        """nerfstudio's rays on the leg of paths that is in the box, and which of the paths meet it."""
        from nerfstudio.cameras.rays import RayBundle

        meets = paths.far > paths.near
        paths = paths[meets]
        length = (paths.far - paths.near)[:, None]
        return RayBundle(
            origins=paths.at(paths.near[:, None])[:, 0],
            directions=paths.direction((paths.near + 0.5 * length[:, 0])[:, None])[:, 0],
            pixel_area=torch.ones_like(length),
            camera_indices=paths.view[:, None],
            nears=torch.zeros_like(length),
            fars=length,
        ), meets

    def train(self) -> None:
        """All steps, with the callbacks of nerfstudio's trainer."""
        before, after = self.model.get_training_callbacks(None)
        self.model.train()
        for first in range(0, self.steps, POOL_STEPS):
            count = min(POOL_STEPS, self.steps - first)
            rng = np.random.default_rng((self.seed, first))
            pool = self.scene.train.draw(count * self.options.rays, self.scene.box, rng)
            for step in range(count):
                before.func(first + step)
                self._step(pool[step * self.options.rays : (step + 1) * self.options.rays], (first + step) / self.steps)
                after.func(first + step)

    def _step(self, paths: Paths, share: float) -> None:
        bundle, meets = self.bundle_of(paths)
        for optimiser in self.optimisers:
            optimiser.param_groups[0]["lr"] = RATE * FINAL_RATE**share
            optimiser.zero_grad(set_to_none=True)
        outputs, batch = self.model(bundle), {"image": paths.rgb[meets]}
        losses = self.model.get_loss_dict(outputs, batch, self.model.get_metrics_dict(outputs, batch))
        sum(losses.values()).backward()
        for optimiser in self.optimisers:
            optimiser.step()

    @torch.no_grad()
    def render(self, camera, water) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colours (M, 3), opacities (M,) and median points (M, 3) [m] of the pixels; NaN where a path misses."""
        self.model.eval()
        pixels = camera.pixel_centres().reshape(-1, 2)
        seen = np.full((len(pixels), 7), np.nan, dtype=np.float32)
        for first in range(0, len(pixels), CHUNK):
            rows = np.arange(first, min(first + CHUNK, len(pixels)))
            bundle, meets = self.bundle_of(
                paths_of(camera, water, pixels[rows], np.zeros((len(rows), 3)), self.scene.box)
            )
            if not len(bundle):
                continue
            outputs = self.model(bundle)
            points = bundle.origins + outputs["depth"] * bundle.directions
            found = torch.cat([outputs["rgb"], outputs["accumulation"], points], dim=1)
            seen[rows[meets.numpy()]] = found.numpy()
        return seen[:, :3], seen[:, 3], seen[:, 4:]


def seconds_of_a_step(scene: ObjectScene, options, size: str) -> float:
    """Processor time, median of three rounds, after one."""
    seconds = []
    for _ in range(4):
        timed = Nerfacto(scene, options, size, TIMED, 0)
        start = time.process_time()
        timed.train()
        seconds.append((time.process_time() - start) / TIMED)
    return statistics.median(seconds[1:])


def rival_row(scene: ObjectScene, options, size: str, step_s: float, seed: int) -> dict:
    """Train nerfstudio's model on an object and score it as `bench_field.row` does."""
    rival = Nerfacto(scene, options, size, steps_of(options, step_s), seed)
    rival.train()
    held, errors, alike, rates = scene.held, [], [], []
    for number, camera in enumerate(held.cameras):
        start = time.process_time()
        rgb, _, _ = rival.render(camera, held.water)
        rates.append(len(rgb) / (time.process_time() - start))
        quality = held_quality(scene, number, np.nan_to_num(rgb).reshape(camera.height, camera.width, 3))
        errors.append(10.0 ** (-0.1 * quality["psnr_db"]))
        alike.append(quality.get("ssim", np.nan))
    parts = []
    for camera, shown in list(zip(scene.train.cameras, scene.train.pixels, strict=True))[::3]:
        _, opacity, points = rival.render(camera, scene.train.water)
        parts.append(points[shown][opacity[shown] > 0.5])
    points = np.concatenate(parts)
    inside = ((points > scene.box.low) & (points < scene.box.high)).all(axis=1)
    return {
        "held_out_psnr_db": psnr_db(errors),
        "held_out_ssim": float(np.nanmean(alike)),
        "chamfer_m": chamfer(thinned(points[inside], scene.box.edge / 256.0), scene.surface),
        "steps": rival.steps,
        "rays_per_s": statistics.median(rates),
        "step_s": step_s,
        "settings": settings_of(options),
    }


def measure(options) -> list[dict]:
    """All rows, by object: nerfstudio's, where it is installed, and ours."""
    rows = []
    sizes = options.sizes if find_spec("nerfstudio") else ()
    if not sizes:
        sys.stdout.write("The rows of nerfstudio are left out: it is not installed (pip install nerfstudio).\n")
    for name in options.objects:
        scene = scene_of(name, options)
        for size in sizes:
            file = options.work / f"{name}_nerfstudio_{size}_time.json"
            step_s = kept(file, lambda s=scene, z=size: {"s": seconds_of_a_step(s, options, z)})["s"]
            for seed in range(options.seeds):
                make = partial(rival_row, scene, options, size, step_s, seed)
                file = options.work / f"{name}_nerfstudio_{size}_{seed}.json"
                rows.append(kept(file, make) | {"object": name, "model": LABELS[size]})
        for model in options.models:
            file = options.work / f"{name}_{model}_time.json"
            times = kept(file, lambda s=scene, m=model: step_times((m,), s, options, time.process_time))
            for seed in range(options.seeds):
                make = partial(row, model, scene, options, steps_of(options, times[model]), seed, time.process_time)
                computed = kept(options.work / f"{name}_{model}_{seed}.json", make)
                rows.append(computed | {"model": MODELS[model].label, "step_s": times[model]})
    return rows


def table_of(rows: list[dict]) -> str:
    """Markdown: of several seeds the mean, and half of the 95 % interval of the mean."""
    lines = list(HEAD)
    for name, model in dict.fromkeys((r["object"], r["model"]) for r in rows):
        own = [r for r in rows if (r["object"], r["model"]) == (name, model)]
        lines.append(
            f"| {name} | {model} | {interval([r['held_out_psnr_db'] for r in own], 2)} dB "
            f"| {interval([r['held_out_ssim'] for r in own], 3)} "
            f"| {interval([1e3 * r['chamfer_m'] for r in own], 1)} mm | {own[0]['steps']} "
            f"| {1e3 * own[0]['step_s']:.0f} ms | {statistics.fmean(r['rays_per_s'] for r in own) / 1e3:.1f} k |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = parser_of()
    parser.add_argument("--sizes", nargs="+", default=("small",), choices=tuple(SIZES), help="of Nerfacto")
    parser.set_defaults(models=("hash", "mdw"), objects=("hull",), seconds=60.0)
    options = parsed(parser)
    options.work.mkdir(parents=True, exist_ok=True)
    sys.stdout.write(table_of(measure(options)) + "\n")


if __name__ == "__main__":
    main()
