"""How far are colours of the bed without its water from those in air? Drawn shores, absorption on both ways of light.

    python benchmarks/bench_true_colour.py WORK [--seeds N ...] [--depth M]

Light of these photographs is absorbed on its way down to the bed and up to the camera, and scattered into the way up
(`survey.simulate.conditions`). Each survey is processed in draft quality as it is, with `--true-colour` (the absorption
is estimated from the photographs), with that of the scene given but no veil, and with both given, which bounds what an
estimate can reach. The colours of points on the true bed are compared
with the bed in dry air: difference in a* and b* of CIELAB after one factor common to all points and channels, since
absolute brightness cannot be observed; median over points, and over means of cells of 0.25 m, by depth.
"""

import argparse
import shutil
import sys
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np

from fields.image_store import GAMMA
from survey.progress import Progress
from survey.run.folder import RunDir
from survey.run.process import process
from survey.run.stored import StoredBed, load_bed
from survey.simulate.conditions import WaterOptics
from survey.simulate.drawn import DrawnScene, stage_drawing
from survey.simulate.writing import write_survey

# Points further from the true bed than this [m] may have the colour of something else.
ON_THE_BED_M = 0.03
BINS_M = (0.5, 1.0, 2.0, 3.0, 4.0)
RAYS = 8
ROWS = (
    "as photographed",
    "absorption estimated",
    "absorption of the scene given, no veil",
    "absorption and veil of the scene given",
)
# Side of the cells over which colours are averaged, too: what is left there is not noise [m].
CELL_M = 0.25


def scene_of(seed: int, depth_m: float) -> DrawnScene:
    """A shore that falls to a depth."""
    return DrawnScene(
        size_m=(6.0, 6.0), depth_m=depth_m, num_views=14, nadir_share=0.5, image_px=(288, 216), focal_px=420.0,
        flying_m=14.0, shore=True, objects=False, seed=seed, noise=1.0,
    )  # fmt: skip


def in_air(scene: DrawnScene, points_crs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linear radiance (N, 3) of the bed in dry air over a pixel about points, and which points lie on it."""
    staged = stage_drawing(replace(scene, water=False))
    above = staged.frame.local_from_crs(points_crs) + np.array([0.0, 0.0, 0.15])
    down, pixel = np.tile([0.0, 0.0, -1.0], (len(above), 1)), (scene.flying_m + scene.depth_m) / scene.focal_px
    rng, light = np.random.default_rng(0), np.zeros((len(above), 3))
    for _ in range(RAYS):
        aside = np.column_stack([pixel * rng.uniform(-0.5, 0.5, (len(above), 2)), np.zeros(len(above))])
        light += staged.renderer.radiance_of_rays(above + aside, down) / RAYS
    found = staged.renderer.trace_rays(above, down).points[:, 2]
    return light, np.abs(found - above[:, 2] + 0.15) < ON_THE_BED_M


def chroma(linear: np.ndarray) -> np.ndarray:
    """a* and b* (N, 2) of linear radiance (N, 3) of sRGB's primaries, white at 1."""
    c = np.clip(linear, 0.0, 1.0)
    stored = np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1.0 / 2.4) - 0.055)
    return cv2.cvtColor(stored[None].astype(np.float32), cv2.COLOR_RGB2LAB)[0, :, 1:]


def differences(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Distances (N,) in a* and b* of linear radiance (N, 3) after a factor common to all."""
    return np.linalg.norm(chroma(found * (true.sum() / found.sum())) - chroma(true), axis=1)


def processed(folder: Path, *, true_colour: bool) -> StoredBed:
    with Progress(verbosity=-1):
        if process(folder, quality="draft", field="off", true_colour=true_colour) not in (0, 3):
            raise SystemExit(f"{folder} could not be processed")
    return load_bed(RunDir(folder / "bathynerf").load_stage("bed"))


def veiling_light(optics: WaterOptics, depth_m: float) -> list[float]:
    """Veiling light of `WaterColumn` with the veil that is nearest to a drawn one, over level ground down to a depth.

    A drawn veil builds up at a rate of its own along the way up, that of the column as light is absorbed, on both ways.
    """
    depth = np.linspace(0.0, depth_m, 81)[1:]
    drawn = optics.seen_through(np.zeros((len(depth), 3)), depth, depth)
    share = 1.0 - np.exp(-2.0 * depth[:, None] * optics.absorption)
    return ((share * drawn).sum(axis=0) / (share**2).sum(axis=0)).tolist()


def measure(work: Path, seed: int, depth_m: float) -> dict[str, dict[str, np.ndarray]]:
    """Depths and differences of each row."""
    scene, folder = scene_of(seed, depth_m), work / f"shore {seed}"
    shutil.rmtree(folder, ignore_errors=True)
    write_survey(folder, asdict(scene), lambda: stage_drawing(scene))
    found = {}
    toml = folder / "survey.toml"
    text = toml.read_text(encoding="utf-8")
    optics = WaterOptics()
    veils = dict(zip(ROWS[2:], ([0.0, 0.0, 0.0], veiling_light(optics, depth_m)), strict=True))
    for row in ROWS:
        given = "[water]"
        if row in veils:
            given += f"\nabsorption_per_m = {list(optics.absorption)}\nveiling_light = {veils[row]}"
        toml.write_text(text.replace("[water]", given), encoding="utf-8")
        stored = processed(folder, true_colour=row != ROWS[0])
        light, on_bed = in_air(scene, stored.points_crs)
        keep = on_bed & stored.bed.wet & (light > 1e-3).all(axis=1)
        seen = (stored.bed.rgb[keep] / 255.0) ** GAMMA
        found[row] = {"depth": stored.bed.depth[keep], "difference": differences(seen, light[keep])}
        columns = np.column_stack([stored.bed.depth, (stored.bed.rgb / 255.0) ** GAMMA, light])[keep]
        depth, seen, true = np.split(cell_means(stored.bed.xyz[keep], columns), [1, 4], axis=1)
        found[f"{row}, means"] = {"depth": depth[:, 0], "difference": differences(seen, true)}
    return found


def cell_means(xyz: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Means of columns (N, C) over square cells in plan, of those with ten points or more."""
    _, cell, count = np.unique(np.floor(xyz[:, :2] / CELL_M), axis=0, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(cell.ravel(), column) / count for column in columns.T], axis=-1)
    return means[count >= 10]


def table(found: dict[str, dict[str, np.ndarray]]) -> list[str]:
    """Markdown: medians by depth, and the share of all points within 4 units."""
    heads = [f"{low:g} to {high:g} m" for low, high in zip((0.0, *BINS_M[:-1]), BINS_M, strict=True)]
    lines = [f"| | {' | '.join(heads)} | all | within 4 |", "|---" * (len(heads) + 3) + "|"]
    for row, each in found.items():
        depth, difference = each["depth"], each["difference"]
        inside = [(depth > low) & (depth <= high) for low, high in zip((0.0, *BINS_M[:-1]), BINS_M, strict=True)]
        cells = [f"{np.median(difference[part]):.1f}" if part.any() else "-" for part in inside]
        cells += [f"{np.median(difference):.1f}", f"{100.0 * (difference <= 4.0).mean():.0f} %"]
        lines.append(f"| {row} | {' | '.join(cells)} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--depth", type=float, default=4.0)
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    parts = [measure(options.work, seed, options.depth) for seed in options.seeds]
    joined = {
        row: {key: np.concatenate([part[row][key] for part in parts]) for key in ("depth", "difference")}
        for row in parts[0]
    }
    sys.stdout.write("\n".join(table(joined)) + "\n")


if __name__ == "__main__":
    main()
