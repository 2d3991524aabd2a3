"""Is the std of each point its error, in every class of points?

    python benchmarks/bench_coverage.py RUN REFERENCE [RUN REFERENCE ...] [--bounds E0 N0 E1 N1] [--field]

A RUN is a folder of `bathynerf process` (or a LAS or LAZ file of it), REFERENCE the true surface as a mesh in the same
crs. Prints rows of Markdown with the share [%] of vertical errors within 1.96 std: in all, in fifths from the smallest
to the largest std, by the number of views, on slopes, wet and dry, where the reference is flatter than 60 degrees. Then
the smallest std, and the mean interval score: it is small where std is true and no larger than it has to be.
``--field`` takes the median error off first, and says how it stands to the median `std_common`: within 2.6 of it.
"""

from __future__ import annotations

import argparse
import tomllib
from pathlib import Path

import laspy
import numpy as np

from evaluation import Coverage, coverage_by_class, interval_score, slope_below, vertical_difference
from evaluation.vertical import WALL_DEG
from geo import read_reference
from geo.las_header import extra_of

# A class of fewer points says nothing.
LEAST = 100


def cells_of(run: Path, reference: Path, bounds: list[float] | None, field: bool) -> list[str]:
    """The cells of the row of one run, behind its name."""
    cloud = run / "cloud.las" if run.is_dir() else run
    las, mesh = laspy.read(cloud), read_reference(reference)
    extra, middle = extra_of(las), mesh.vertices.mean(axis=0)
    points = np.stack([las.x, las.y, las.z], axis=-1)
    inside = np.ones(len(points), dtype=bool)
    bounds = _bounds_of(run) if bounds is None else bounds
    if bounds is not None:
        e0, n0, e1, n1 = bounds
        inside = (points[:, 0] >= e0) & (points[:, 0] <= e1) & (points[:, 1] >= n0) & (points[:, 1] <= n1)
    points, vertices = points[inside] - middle, mesh.vertices - middle
    error = vertical_difference(points, vertices, mesh.faces)
    slope = slope_below(points, vertices, mesh.faces)
    std, views, common = (np.asarray(extra[name])[inside] for name in ("std", "num_views", "std_common"))
    wet = np.asarray(las.classification)[inside] == 40
    known = np.isfinite(error) & (slope < WALL_DEG) & np.isfinite(std)
    error, median = error[known], float(np.median(error[known]))
    error = error - median * field
    found = coverage_by_class(error, std[known], views[known], slope[known], wet[known])
    shares = [_percent(each, digits=int(name == "all")) for name, each in found.items()]
    cells = [shares[0], " ".join(shares[1:6]), *shares[6:], f"{1e3 * np.nanmin(std):.2g} mm"]
    cells.append(f"{1e3 * interval_score(error, std[known]):.3g} mm")
    if field:
        of_common = float(np.nanmedian(common))
        cells += [f"{1e3 * median:.1f} mm", f"{1e3 * of_common:.1f} mm", f"{abs(median) / of_common:.1f}"]
    return cells


def _bounds_of(run: Path) -> list[float] | None:
    """What the run's survey asks to be evaluated."""
    settings = run / "settings.toml"
    if not settings.is_file():
        return None
    return tomllib.loads(settings.read_text(encoding="utf-8")).get("area", {}).get("bounds")


def _percent(found: Coverage, digits: int = 0) -> str:
    return f"{100 * found.share:.{digits}f}" if found.num >= LEAST else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pairs", nargs="+", type=Path, metavar="RUN REFERENCE")
    parser.add_argument("--bounds", nargs=4, type=float)
    parser.add_argument("--field", action="store_true")
    options = parser.parse_args()
    if len(options.pairs) % 2:
        parser.error("give a REFERENCE with each RUN")
    for run, reference in zip(options.pairs[::2], options.pairs[1::2], strict=True):
        cells = cells_of(run, reference, options.bounds, options.field)
        print(f"| {' | '.join([run.name, *cells])} |", flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
