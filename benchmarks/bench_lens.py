"""Does a lens that distorts move the bed? Scenes drawn at random, each through a pinhole, a barrel and a pincushion.

    python benchmarks/bench_lens.py [--scenes N] [--quality Q] [-o FOLDER]

The pincushion is decentred as well: its principal point lies beside the middle, and it has tangential terms. Ground,
poses and noise of a scene are the same through all of its lenses. Accuracy is that of `bathynerf compare` inside the
bounds, nothing aligned. Prints one JSON with a record per survey, and how far the means of a scene lie apart.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from bench_sweep import Case

from refract.lens import Lens
from survey.simulate.drawn import DrawnScene, stage_drawing
from survey.simulate.output.sidecars import StagedScene
from survey.simulate.output.writing import write_survey

# k1, k2, p1, p2, and the principal point beside the middle of the image, in shares of its size.
DISTORTIONS = {
    "pinhole": ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0)),
    "barrel": ((-0.14, 0.04, 0.0, 0.0), (0.0, 0.0)),
    "pincushion": ((0.12, 0.03, 0.0015, -0.001), (0.012, -0.017)),
}
SIZE_PX, NUM_VIEWS = (400, 300), 16
# In footprints of a view: the part of the ground that is evaluated.
AREA = (0.7, 0.8)
# In ground sampling distances: between the points of texture and the vertices of the bed.
TEXEL, CELL = 0.4, 1.0


def drawn_scene(seed: int) -> DrawnScene:
    """A scene whose depth, flight, water and noise are drawn at random."""
    rng = np.random.default_rng([seed, 17])
    depth, focal = rng.uniform(0.8, 3.0), SIZE_PX[0] * rng.uniform(1.3, 1.9)
    flying = depth * rng.uniform(4.0, 9.0)
    gsd = flying / focal
    return DrawnScene(
        size_m=(AREA[0] * gsd * SIZE_PX[0], AREA[1] * gsd * SIZE_PX[1]),
        depth_m=depth,
        n_water=rng.uniform(1.325, 1.345),
        slope_east=rng.normal(0.0, 0.002),
        slope_north=rng.normal(0.0, 0.002),
        num_views=NUM_VIEWS,
        image_px=SIZE_PX,
        focal_px=focal,
        flying_m=flying,
        noise=rng.uniform(0.5, 2.0),
        seed=seed,
        cell_m=CELL * gsd,
        texel_m=TEXEL * gsd,
        shore=bool(seed % 2),
    )


def lens_of(scene: DrawnScene, name: str) -> Lens:
    """A lens of the scene's focal length."""
    coefficients, beside = DISTORTIONS[name]
    (width, height), focal = scene.image_px, scene.focal_px
    centre = ((0.5 + beside[0]) * width, (0.5 + beside[1]) * height)
    return Lens("OPENCV", (focal, focal, *centre, *coefficients), width, height)


def staged(scene: DrawnScene, name: str) -> StagedScene:
    """The scene through a lens; its ground is that of the pinhole, with a margin that the others do not exceed."""
    found, lens = stage_drawing(scene), lens_of(scene, name)
    cameras = tuple(lens.pinhole(camera.centre, camera.cam_from_local) for camera in found.cameras)
    return replace(found, lens=lens, cameras=cameras)


def draw(folder: Path, scene: DrawnScene, name: str) -> None:
    """Photograph a scene through a lens into a survey folder."""
    settings = asdict(scene) | {"lens": DISTORTIONS[name]}
    write_survey(folder, settings, lambda: staged(scene, name))


def measured(folder: Path, quality: str) -> dict:
    """Figures of the bed of a survey."""
    case = Case(folder, quality)
    start, processor = time.monotonic(), time.process_time()
    maps, _ = case.maps()
    seconds = {"sweep_s": time.monotonic() - start, "sweep_cpu_s": time.process_time() - processor}
    return case.figures(case.points(maps)) | seconds


def records(seeds: range, quality: str, work: Path) -> Iterator[dict]:
    """A record per scene and lens."""
    for seed in seeds:
        for name in DISTORTIONS:
            folder = work / f"{seed}_{name}"
            draw(folder, drawn_scene(seed), name)
            yield {"scene": seed, "lens": name} | measured(folder, quality)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--quality", default="standard")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    work = options.output or Path(tempfile.mkdtemp(prefix="bathynerf_lens_"))
    found = list(records(range(1, options.scenes + 1), options.quality, work))
    means = np.array([r["mean_inner90_m"] for r in found]).reshape(-1, len(DISTORTIONS))
    apart = (means - means[:, :1]).tolist()
    print(json.dumps({"records": found, "mean_apart_m": apart}, indent=2))  # noqa: T201


if __name__ == "__main__":
    main()
