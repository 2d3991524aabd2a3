"""How much noise does the solver take off, and what does the bed itself leave below the pixel?

    python benchmarks/bench_solver.py SURVEY ... [--noise N --seeds S ...] [--ways WAY ...] [-o FOLDER]

A SURVEY is a folder with known truth (reference.ply and visible.ply in it, or in truth/). Each is processed in standard
quality by the command line in several ways: the sweep alone, the trained field, a plain Gauss-Newton on each height
alone (the solver without its prior and without heights that stay as the sweep has them), and the solver. `--noise`
first adds so many grey levels to the photographs, the same in all channels, and writes them again as JPEG of quality 92
with 4:4:4, once for each seed. Prints rows of Markdown for each survey: accuracy, with the least and
the greatest of several seeds, and the std of the true bed averaged over 1 to 4 ground sampling distances. Whether the
std of its points is true, `bench_coverage.py` tells.
"""

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

BATHYNERF = "from survey.commands.app import main; main()"
# Second differences cost nothing, and no update is rejected.
PLAIN = f"""
from unittest.mock import patch
with patch("fields.solver.solver.roughness_of", lambda *_: 1e6), patch(
    "fields.solver.solver.rejects_update", lambda tile, *_: tile.requested & False
):
    {BATHYNERF}
"""
# What each way is called, its program and its field.
WAYS = {
    "sweep": ("sweep alone", BATHYNERF, "off"),
    "field": ("sweep and trained field", BATHYNERF, "mdw"),
    "plain": ("plain Gauss-Newton, each pixel alone", PLAIN, "solver"),
    "solver": ("**solver**", BATHYNERF, "solver"),
}
# Exit codes of a run that is whole; with the latter its points are less certain than it asks for itself.
WHOLE = (0, 3)
TOLERANCES = ("0.2", "0.05")
# Of the numbers of `accuracy`, the first that is a share.
FIRST_SHARE = 3
WINDOWS_GSD = (1, 2, 3, 4)
# Cells of the raster of the true bed within a ground sampling distance.
FINE = 4


def noisy(survey: Path, folder: Path, noise: float, seed: int) -> Path:
    """A copy of a survey whose photographs have more noise."""
    copy = shutil.copytree(survey, folder / f"{survey.name}_{noise:g}_{seed}", copy_function=shutil.copyfile)
    random = np.random.default_rng(seed)
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


def accuracy(survey: Path, run: Path, truth: Path) -> list[float]:
    """Mean, std, rms [mm] and completeness at each tolerance [%] of the cloud of a run."""
    bounds = [str(v) for v in load_survey(survey).bounds]
    numbers = {}
    for tolerance in TOLERANCES:
        out = run / f"compare_{tolerance}.json"
        options = ["--visible", str(truth / "visible.ply"), "--tolerance", tolerance, "--bounds", *bounds]
        command = [
            sys.executable,
            "-c",
            BATHYNERF,
            "compare",
            str(run / "cloud.las"),
            str(truth / "reference.ply"),
            *options,
        ]
        subprocess.run([*command, "--json", str(out), "-q"], check=True, stdout=subprocess.DEVNULL)
        numbers[tolerance] = json.loads(out.read_text())
    found = numbers[TOLERANCES[0]]
    errors = [1e3 * found[name] for name in ("mean_inner90_m", "std_inner90_m", "rms_m")]
    return errors + [100.0 * numbers[t]["completeness_visible"] for t in TOLERANCES]


def row(found: list[list[float]]) -> str:
    """Means of what `accuracy` found with several seeds, with the least and the greatest, between bars."""
    cells = []
    for number, values in enumerate(zip(*found, strict=True)):
        digits, unit = ((1, "mm"), (2, "%"))[number >= FIRST_SHARE]
        between = f" ({min(values):.{digits}f} to {max(values):.{digits}f})" if len(values) > 1 else ""
        cells.append(f"{np.mean(values):.{digits}f} {unit}{between}")
    return " | ".join(cells)


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


def processed(survey: Path, way: str, run: Path) -> Path:
    """The folder of a run of a survey in standard quality."""
    _, program, field = WAYS[way]
    command = ["process", str(survey), "-o", str(run), "--quality", "standard", "--field", field, "--no-resume", "-qq"]
    done = subprocess.run([sys.executable, "-c", program, *command])
    if done.returncode not in WHOLE:
        raise SystemExit(f"{way} of {survey} ended with exit code {done.returncode}")
    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("surveys", nargs="+", type=Path)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[11], metavar="SEED", help="of the noise")
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS), metavar="WAY")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    folder = options.output or Path(tempfile.mkdtemp(prefix="bathynerf_solver_"))
    for given in options.surveys:
        name, surveys = given.name, [given]
        if options.noise:
            name = f"{given.name} + {options.noise:g}"
            surveys = [noisy(given, folder, options.noise, seed) for seed in options.seeds]
        truth = given / "truth" if (given / "truth").is_dir() else given
        for way in options.ways:
            runs = [processed(survey, way, folder / f"{survey.name}_{way}") for survey in surveys]
            found = [accuracy(survey, run, truth) for survey, run in zip(surveys, runs, strict=True)]
            print(f"| {name} | {WAYS[way][0]} | {row(found)} |", flush=True)  # noqa: T201
        print(f"| {name} | {below(surveys[0], runs[0], truth)} |", flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
