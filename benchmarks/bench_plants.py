"""What is found of plants over a bed, and of the bed beneath them? Drawn plants, still and swaying.

    python benchmarks/bench_plants.py WORK [--seeds N ...] [--sway S ...] [--quality draft]

Patches of leaves, 25 to 60 cm high, on a bed 1.5 to 2.5 m deep; with --sway tips move aside by up to so much of their
height, otherwise in each photograph. The cloud of `process` is divided by height over a bed of planes fitted to the low
points of cells of 10 cm, again and again without what rises over them: what is 8 cm higher is plant, all else bed.

Printed as Markdown: shares of points that three cameras see (of upright leaves, and of the bed within 0.3 m of one)
with a point of the cloud of that class within 5 cm; points of each class that are the other by the truth; errors of the
height of the bed and of that of the canopy, the top of plants in cells of half a metre over the bed.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from plant_scenes import Leaf, PlantSurvey
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from evaluation import is_reached
from geo import read_cloud, read_reference
from survey.progress import Progress
from survey.run.process import process
from survey.simulate.drawn import stage_drawing

GRID_M, LOW, REACH_M, SOFT_M, FITS, RISE_M = 0.1, 0.2, 0.3, 0.04, 6, 0.08
TOLERANCE_M, BESIDE_M, CELL_M, TOP = 0.05, 0.3, 0.5, 0.98
HEAD = (
    "| plants | seed | leaves found | bed beneath found | bed elsewhere | called plant, is bed | called bed, is plant "
    "| bed beneath, error | canopy, error |",
    "|---" * 9 + "|",
)


def classes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which points (N, 3) [m] are plant, and the height (N,) of the bed beneath each."""
    column = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / GRID_M).astype(int)
    low = low_of_cells(points[:, 2], column)
    bed = bed_beneath(low)[tuple(column.T)]
    # Lows of noise lie under the bed: level with what is not plant.
    over = points[:, 2] - bed
    bed = bed + np.median(over[over < RISE_M])
    return points[:, 2] - bed > RISE_M, bed


def low_of_cells(heights: np.ndarray, column: np.ndarray) -> np.ndarray:
    """The `LOW` quantile of the heights (N,) in each cell (east, north); NaN where there is none."""
    shape = tuple((column.max(axis=0) + 1).tolist())
    flat = np.ravel_multi_index(tuple(column.T), shape)
    order = np.lexsort((heights, flat))
    cells, first, count = np.unique(flat[order], return_index=True, return_counts=True)
    grid = np.full(shape, np.nan)
    grid.flat[cells] = heights[order][first + (LOW * (count - 1)).astype(int)]
    return grid


def bed_beneath(low: np.ndarray) -> np.ndarray:
    """Planes fitted about each cell of a raster, with bell weights of `REACH_M`, to what does not rise over them."""
    known = np.isfinite(low)
    z, weights = np.where(known, low, 0.0), known * 1.0
    x, y = np.meshgrid(*(GRID_M * np.arange(n) for n in low.shape), indexing="ij")
    for _ in range(FITS):

        def mean(values: np.ndarray, weights=weights) -> np.ndarray:
            return gaussian_filter(weights * values, REACH_M / GRID_M)

        total = mean(np.ones(low.shape)) + 1e-12
        mx, my, mz = (mean(v) / total for v in (x, y, z))
        xx, xy, yy = mean(x * x) / total - mx**2, mean(x * y) / total - mx * my, mean(y * y) / total - my**2
        xz, yz = mean(x * z) / total - mx * mz, mean(y * z) / total - my * mz
        determinant = np.maximum(xx * yy - xy**2, 1e-9)
        east, north = (xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant
        bed = mz + east * (x - mx) + north * (y - my)
        over = np.maximum(z - bed, 0.0)
        weights = known * np.exp(-((over / SOFT_M) ** 2))
    return bed


def measure(work: Path, seed: int, sway: float, quality: str) -> list[float]:
    """The numbers of a row."""
    survey, folder = PlantSurvey(seed, sway), work / f"plants {seed} {sway:g}"
    leaves = survey.draw(folder)
    with Progress(verbosity=-1):
        if process(folder, quality=quality) not in (0, 3):
            raise SystemExit(f"{folder} could not be processed")
    staged = stage_drawing(survey.scene)
    bed, frame = staged.renderer.ground.bed, staged.frame
    cloud = frame.local_from_crs(read_cloud(folder / "bathynerf" / "cloud.las").points)
    seen = frame.local_from_crs(read_reference(folder / "truth" / "visible.ply").points)
    return figures(cloud, seen, leaves, bed)


def figures(cloud: np.ndarray, seen: np.ndarray, leaves: list[Leaf], bed) -> list[float]:
    """Shares and errors [m] of a cloud with points that cameras see, local."""
    plant, low = classes(cloud)
    true_low, seen_low = (bed.height(p[:, 0], p[:, 1]) for p in (cloud, seen))
    is_plant, of_plant = cloud[:, 2] - true_low > RISE_M, seen[:, 2] - seen_low > 0.01
    feet = cKDTree(np.array([leaf.foot[:2] for leaf in leaves]))
    beside = feet.query(seen[:, :2])[0] < BESIDE_M
    under = feet.query(cloud[:, :2])[0] < BESIDE_M

    def found(points: np.ndarray, part: np.ndarray) -> float:
        return float(is_reached(points, part, tolerance_m=TOLERANCE_M).mean()) if len(part) else 0.0

    canopy = []
    for cell in np.unique(np.floor(seen[of_plant, :2] / CELL_M), axis=0):
        true = of_plant & (np.floor(seen[:, :2] / CELL_M) == cell).all(axis=1)
        there = plant & (np.floor(cloud[:, :2] / CELL_M) == cell).all(axis=1)
        if true.sum() >= 20:
            top = np.quantile((cloud[:, 2] - low)[there], TOP) if there.sum() >= 5 else 0.0
            canopy.append(top - np.quantile((seen[:, 2] - seen_low)[true], TOP))
    return [
        found(seen[of_plant], cloud[plant]),
        found(seen[~of_plant & beside], cloud[~plant]),
        found(seen[~of_plant & ~beside], cloud[~plant]),
        float((plant & ~is_plant).sum() / max(plant.sum(), 1)),
        float((~plant & is_plant).sum() / max((~plant).sum(), 1)),
        float(np.median((cloud[:, 2] - true_low)[~plant & under])),
        float(np.mean(canopy)),
        float(np.std(canopy)),
    ]


def line(seed: int, sway: float, row: list[float]) -> str:
    """A row as Markdown."""
    shares = [f"{100.0 * v:.1f} %" for v in row[:5]]
    errors = [f"{1e3 * row[5]:+.0f} mm", f"{1e3 * row[6]:+.0f} ± {1e3 * row[7]:.0f} mm"]
    return f"| {f'swaying by {sway:g}' if sway else 'still'} | {seed} | {' | '.join(shares + errors)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--sway", type=float, nargs="+", default=[0.0, 0.3])
    parser.add_argument("--quality", default="draft")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    sys.stdout.write("\n".join(HEAD) + "\n")
    for sway in options.sway:
        for seed in options.seeds:
            sys.stdout.write(line(seed, sway, measure(options.work, seed, sway, options.quality)) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
