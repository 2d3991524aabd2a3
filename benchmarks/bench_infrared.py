"""Does near infrared beside photographs make a bed better? Drawn shores with sun glint: a water mask, and glint off.

    python benchmarks/bench_infrared.py -o WORK [--seeds N ...] [--views N]

Infrared of water 1 m deep is dark (4.3 1/m both ways), of land bright, and sun glint is the same in all bands. A mask
is what Otsu's threshold calls dark, held against the pixels whose rays enter water. Glint is taken off as by Hedley et
al. (2005): each band less its slope against infrared times the infrared over its least, both of what the mask calls
water; with bands exactly over each other, and with infrared one pixel aside, as of a second lens.
"""

import argparse
import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from bathynerf import CompareOptions, DrawnScene, Progress, compare, draw_survey, load_survey, process
from fields.image_store import GAMMA
from survey.simulate.drawn import stage_drawing

ABSORPTION, GLINT_SHARE, GLINT, TOLERANCE_M = 4.3, 0.16, 0.25, 0.05
ROWS = ("no glint", "glint", "glint off, bands exactly over each other", "glint off, infrared a pixel aside")


def scene_of(seed: int, views: int) -> DrawnScene:
    """A shore, of another depth, height and share of water each time."""
    rng = np.random.default_rng(seed)
    return DrawnScene(
        size_m=(6.0, 6.0), depth_m=rng.uniform(1.2, 3.0), num_views=views, image_px=(320, 240), focal_px=460.0,
        flying_m=rng.uniform(11.0, 15.0), shore=True, seed=seed,
    )  # fmt: skip


def infrared_of(linear: np.ndarray, in_water: np.ndarray) -> np.ndarray:
    """Radiance (H, W) of near infrared of a bed that is as uneven as the colours (H, W, 3), under lengths of water."""
    grey = linear.mean(axis=-1)
    uneven = grey / cv2.GaussianBlur(grey, (0, 0), 8.0)
    return 0.35 * uneven * np.exp(-2.0 * ABSORPTION * in_water) + 0.02


def glint_of(wet: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Radiance (H, W) of glint on a share of the wet pixels, in streaks of some pixels, another in each photograph."""
    waves = cv2.GaussianBlur(rng.normal(size=wet.shape), (0, 0), 2.0, sigmaY=1.0)
    over = waves - np.quantile(waves, 1.0 - GLINT_SHARE)
    return np.where(wet & (over > 0.0), GLINT * over / np.median(over[over > 0.0]), 0.0)


def stored(linear: np.ndarray) -> np.ndarray:
    return np.round(255.0 * np.clip(linear, 0.0, 1.0) ** (1.0 / GAMMA)).astype(np.uint8)


def without_glint(linear: np.ndarray, infrared: np.ndarray, water: np.ndarray) -> np.ndarray:
    """Colours (H, W, 3) without what grows with infrared over water."""
    if water.sum() < 100:
        return linear
    over = infrared[water] - np.quantile(infrared[water], 0.01)
    slope = (over @ (linear[water] - linear[water].mean(axis=0))) / (over @ (over - over.mean()))
    out = linear.copy()
    out[water] -= over[:, None] * slope
    return out


def measure(work: Path, seed: int, views: int) -> dict:
    scene, drawn = scene_of(seed, views), work / f"{seed}" / "drawn"
    shutil.rmtree(drawn.parent, ignore_errors=True)
    with Progress(verbosity=-1):
        draw_survey(drawn, scene)
        for number in range(1, len(ROWS)):
            shutil.copytree(drawn, drawn.parent / str(number))
    rng, overlaps, renderer = np.random.default_rng(seed), [], stage_drawing(scene).renderer
    for view in load_survey(drawn).views:
        path, camera = Path("images") / view.name, view.camera
        with Image.open(drawn / path) as image:
            exif, linear = image.getexif(), (np.asarray(image.convert("RGB")) / 255.0) ** GAMMA
        rays = camera.directions(camera.pixel_centres()).reshape(-1, 3)
        in_water = renderer.trace_rays(np.broadcast_to(camera.centre, rays.shape), rays).in_water.reshape(
            linear.shape[:2]
        )
        wet = np.nan_to_num(in_water, posinf=99.0) > 0.0
        glint = glint_of(wet, rng)
        infrared = stored(infrared_of(linear, np.nan_to_num(in_water, posinf=99.0)) + glint)
        threshold, _ = cv2.threshold(infrared, 0, 255, cv2.THRESH_OTSU)
        water = infrared <= threshold
        overlaps.append(float((water & wet).sum() / max((water | wet).sum(), 1)))
        glittering = np.clip(linear + glint[..., None], 0.0, 1.0)
        # Glint is over water, too: what infrared calls land by its brightness is judged by its surroundings.
        near = cv2.medianBlur(water.astype(np.uint8), 15) > 0
        beside = np.roll(infrared, 1, axis=1)
        found = [without_glint(glittering, (band / 255.0) ** GAMMA, near) for band in (infrared, beside)]
        for number, pixels in enumerate((glittering, *found), start=1):
            Image.fromarray(stored(pixels)).save(drawn.parent / str(number) / path, quality=95, exif=exif)
    rows = {}
    for row, folder in zip(ROWS, (drawn, *(drawn.parent / str(number) for number in range(1, len(ROWS)))), strict=True):
        with Progress(verbosity=-1):
            process(folder, quality="draft", field="off")
        options = CompareOptions(
            (TOLERANCE_M,), visible=folder / "truth" / "visible.ply", bounds=load_survey(folder).bounds
        )
        got = compare(folder / "bathynerf" / "cloud.las", folder / "truth" / "reference.ply", options=options)
        rows[row] = {
            "mean_mm": 1000.0 * got.distances.mean_inner90_m, "std_mm": 1000.0 * got.distances.std_inner90_m,
            "complete": 100.0 * got.tolerances[0].completeness_visible,
        }  # fmt: skip
    return {"seed": seed, "overlap": float(np.mean(overlaps)), "worst": min(overlaps), "rows": rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--views", type=int, default=14)
    given = parser.parse_args()
    for seed in given.seeds:
        sys.stdout.write(json.dumps(measure(given.output, seed, given.views), indent=1) + "\n")


if __name__ == "__main__":
    main()
