"""How much noise does the solver take off, and what does the bed itself leave below the pixel?

    python benchmarks/bench_solver.py SURVEY ... [--noise N] [-o FOLDER]

A SURVEY is a folder with known truth (reference.ply and visible.ply in it, or in truth/). Each is processed twice by
the command line, by the sweep alone and with the solver; `--noise` first adds so many grey levels to the photographs,
the same in all channels, and writes them again as JPEG of quality 92 with 4:4:4. Prints rows of Markdown for each
survey, as docs/field.md and docs/sweep.md have them: accuracy, and the std of the true bed averaged over 1 to 4 ground
sampling distances. Whether the std of its points is true, `bench_coverage.py` tells.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import laspy
import numpy as np
from PIL import Image
from scipy import ndimage

from evaluation import distance_to_mesh, vertical_difference
from geo import read_reference
from survey.folder.survey import load_survey

FIELDS = ("off", "solver")
TOLERANCES = ("0.2", "0.05")
WINDOWS_GSD = (1, 2, 3, 4)
# Cells of the raster of the true bed within a ground sampling distance.
FINE = 4
BATHYNERF = [sys.executable, "-c", "from survey.commands.app import main; main()"]


def noisy(survey: Path, folder: Path, noise: float) -> Path:
    """A copy of a survey whose photographs have more noise."""
    copy = shutil.copytree(survey, folder / f"{survey.name}_{noise:g}", copy_function=shutil.copyfile)
    random = np.random.default_rng(11)
    for path in sorted((copy / "images").iterdir()):
        with Image.open(path) as image:
            pixels, exif = np.asarray(image.convert("RGB")).astype(float), image.info.get("exif", b"")
        pixels += random.normal(0.0, noise, pixels.shape[:2])[..., None]
        changed = Image.fromarray(np.clip(np.rint(pixels), 0, 255).astype(np.uint8))
        changed.save(path, quality=92, subsampling=0, exif=exif)
    return copy


def inner90(values: np.ndarray) -> np.ndarray:
    """The 90 % of the values that are least in size."""
    return values[np.abs(values) <= np.quantile(np.abs(values), 0.9)]


def accuracy(survey: Path, run: Path, truth: Path) -> str:
    """Mean, std, rms [mm] and completeness [%] of the cloud of a run, between bars."""
    bounds = [str(v) for v in load_survey(survey).bounds]
    numbers = {}
    for tolerance in TOLERANCES:
        out = run / f"compare_{tolerance}.json"
        options = ["--visible", str(truth / "visible.ply"), "--tolerance", tolerance, "--bounds", *bounds]
        command = [*BATHYNERF, "compare", str(run / "cloud.las"), str(truth / "reference.ply"), *options]
        subprocess.run([*command, "--json", str(out), "-q"], check=True, stdout=subprocess.DEVNULL)
        numbers[tolerance] = json.loads(out.read_text())
    found = numbers[TOLERANCES[0]]
    shares = " | ".join(f"{100 * numbers[t]['completeness_visible']:.2f} %" for t in TOLERANCES)
    return f"{1e3 * found['mean_inner90_m']:.1f} mm | {1e3 * found['std_inner90_m']:.2f} mm | {shares}"


def below(survey: Path, run: Path, truth: Path) -> str:
    """What the averaged true bed has as std [mm], between bars."""
    loaded, mesh, las = load_survey(survey), read_reference(truth / "reference.ply"), laspy.read(run / "cloud.las")
    local = loaded.frame.local_from_crs
    points, vertices = local(np.stack([las.x, las.y, las.z], axis=-1)), local(mesh.vertices)
    e0, n0, e1, n1 = loaded.bounds
    inside = (las.x >= e0) & (las.x <= e1) & (las.y >= n0) & (las.y <= n1)
    points = points[inside]
    gsd = json.loads((run / "plan.json").read_text())["gsd_m"]
    raster, low, cell = raster_of(points, vertices, mesh.faces, gsd / FINE)
    stds = []
    for window in WINDOWS_GSD:
        mean = ndimage.uniform_filter(raster, window * FINE)
        at = ((points[:, 1::-1] - low[::-1]) / cell).T
        there = np.column_stack([points[:, :2], ndimage.map_coordinates(mean, at, order=1, mode="nearest")])
        stds.append(f"{1e3 * inner90(distance_to_mesh(there, vertices, mesh.faces).signed).std():.2f} mm")
    return " | ".join(stds)


def raster_of(points, vertices, faces, cell: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Heights of the highest surface in cells over the extent of the points; holes take the nearest."""
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    x, y = np.meshgrid(*(np.arange(a, b, cell) for a, b in zip(low, high, strict=True)))
    above = vertices[:, 2].max() + 1.0
    places = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, above)])
    height = (above - vertical_difference(places, vertices, faces)).reshape(x.shape)
    nearest = ndimage.distance_transform_edt(np.isnan(height), return_distances=False, return_indices=True)
    return height[tuple(nearest)], low, cell


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("surveys", nargs="+", type=Path)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    folder = options.output or Path(tempfile.mkdtemp(prefix="bathynerf_solver_"))
    for given in options.surveys:
        survey = noisy(given, folder, options.noise) if options.noise else given
        truth = survey / "truth" if (survey / "truth").is_dir() else survey
        for field in FIELDS:
            run = folder / f"{survey.name}_{field}"
            command = [*BATHYNERF, "process", str(survey), "-o", str(run), "--field", field, "-qq"]
            subprocess.run(command, check=True)
            print(f"| {survey.name} | {field} | {accuracy(survey, run, truth)} |")  # noqa: T201
        print(f"| {survey.name} | {below(survey, run, truth)} |")  # noqa: T201


if __name__ == "__main__":
    main()
