"""How far is an exported terrain model from the mean of the true bed over each cell, and does its uncertainty cover it?

    python benchmarks/bench_dem.py RUN REFERENCE [RUN REFERENCE ...] [--resolution M ...]

Of each run that `bathynerf process` made, `--dem` is exported at each resolution and held against REFERENCE, the true
surface as a mesh in the same crs, seen from above and averaged over each cell by samples at most a centimetre apart.
Prints rows of Markdown as docs/products.md has them: over all cells that have points, and over those away from walls,
where neither the cell nor one beside it has true heights further apart than a slope of 3 explains.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from scipy import ndimage

from evaluation import vertical_difference
from geo import Mesh, read_reference
from survey.export.export import export
from survey.export.product import ExportOptions

SAMPLE_M = 0.01
STEEPEST = 3.0
RESOLUTIONS_M = (0.05, 0.1, 0.25, 0.5)
# Samples of the reference at a time.
AT_ONCE = 2_000_000
HEAD = (
    "run",
    "cell [m]",
    "cells",
    "rms [mm]",
    "68 %",
    "95 %",
    "median std [mm]",
    "within 1.96 std",
    "within 1 std",
    "s",
)


@dataclass(frozen=True)
class TrueCells:
    """The true bed over the cells of a raster: mean, and largest difference of height [m], (rows, columns)."""

    mean: np.ndarray
    relief: np.ndarray


def true_cells(mesh: Mesh, raster) -> TrueCells:
    """The reference over the cells of an open raster, NaN where it does not cover a cell."""
    origin = mesh.vertices.mean(axis=0).round()
    vertices, side = mesh.vertices - origin, raster.transform.a
    above = float(vertices[:, 2].max()) + 10.0
    per_side = max(math.ceil(side / SAMPLE_M), 4)
    step = (np.arange(per_side) + 0.5) / per_side
    x = raster.transform.c - origin[0] + side * (np.arange(raster.width)[:, None] + step).ravel()
    mean, relief = np.full((2, *raster.shape), np.nan)
    rows = max(AT_ONCE // (len(x) * per_side), 1)
    for top in range(0, raster.height, rows):
        some = np.arange(top, min(top + rows, raster.height))
        y = raster.transform.f - origin[1] - side * (some[:, None] + step).ravel()
        places = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), above)], axis=-1)
        height = above - vertical_difference(places.reshape(-1, 3), vertices, mesh.faces)
        height = height.reshape(len(some), per_side, raster.width, per_side)
        mean[some], relief[some] = height.mean(axis=(1, 3)), np.ptp(height, axis=(1, 3))
    return TrueCells(mean + origin[2], relief)


def row_of(name: str, side: float, error: np.ndarray, std: np.ndarray, seconds: float) -> str:
    """One row of the table, from errors and standard deviations (K,) [m]."""
    size = np.abs(error)
    numbers = [np.sqrt(np.mean(error**2)), *np.quantile(size, [0.683, 0.95]), np.median(std)]
    shares = [np.mean(size < 1.96 * std), np.mean(size < std)]
    cells = [f"{1e3 * number:.1f}" for number in numbers] + [f"{100 * share:.1f} %" for share in shares]
    return f"| {name} | {side:g} | {len(error):,} | {' | '.join(cells)} | {seconds:.1f} |"


def measure(run: Path, mesh: Mesh, side: float, folder: Path) -> list[str]:
    """The rows of one run at one resolution."""
    start = time.monotonic()
    (path,) = export(run, options=ExportOptions(resolution_m=side), dem=folder / f"{run.name}_{side:g}.tif")
    seconds = time.monotonic() - start
    with rasterio.open(path) as raster:
        height, std, count = raster.read([1, 2, 4]).astype(np.float64)
        true = true_cells(mesh, raster)
    known = (count > 0) & np.isfinite(true.mean)
    steep = ~(true.relief < STEEPEST * math.sqrt(2.0) * side)
    away = known & ~ndimage.binary_dilation(steep, np.ones((3, 3), dtype=bool))
    error = height - true.mean
    return [
        row_of(name, side, error[among], std[among], seconds)
        for name, among in ((run.name, known), (f"{run.name}, away from walls", away))
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="+", type=Path, metavar="RUN REFERENCE")
    parser.add_argument("--resolution", nargs="+", type=float, default=RESOLUTIONS_M, metavar="M")
    arguments = parser.parse_args()
    if len(arguments.pairs) % 2:
        parser.error("give each RUN with its REFERENCE")
    print(f"| {' | '.join(HEAD)} |\n{'|---' * len(HEAD)}|")  # noqa: T201
    with tempfile.TemporaryDirectory() as folder:
        for run, reference in zip(arguments.pairs[::2], arguments.pairs[1::2], strict=True):
            mesh = read_reference(reference)
            for side in arguments.resolution:
                for row in measure(run, mesh, side, Path(folder)):
                    print(row, flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
