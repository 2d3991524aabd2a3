"""How true is a cloud under water, and how true over it?

    python benchmarks/bench_dry_ground.py SURVEY CLOUD [CLOUD ...] [--bounds E0 N0 E1 N1]

SURVEY is a folder with known truth (reference.ply and visible.ply in it) and a plane of water, which the true surface
rises above; a CLOUD is that of a run or of `bathynerf field`. Bounds, in crs, are those of survey.toml by default.
Points within 5 cm of the plane, by their place on the true surface, are of neither side. Prints Markdown: mean and
standard deviation of the inner 90 % of the distances to the true surface, and the share of what three cameras see that
has a point within a tolerance.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from evaluation import distance_to_mesh, is_reached
from geo import read_cloud, read_reference
from survey.folder.survey import Survey, load_survey

SHORELINE_M = 0.05
TOLERANCES_M = (0.05, 0.2)
HEAD = (
    "| cloud | side | points | mean | std | " + " | ".join(f"at {tolerance:g} m" for tolerance in TOLERANCES_M) + " |",
    "|---|---|---|---|---|" + "---|" * len(TOLERANCES_M),
)


def rows(survey: Survey, folder: Path, path: Path, bounds: list[float]) -> list[str]:
    """Lines of the table for one cloud."""
    frame, water = survey.frame, survey.water
    if water is None:
        raise SystemExit(f"{folder} has no water")
    mesh = read_reference(folder / "reference.ply")
    clouds = read_cloud(path).points, read_reference(folder / "visible.ply").points
    points, visible = (frame.local_from_crs(each[_inside(each, bounds)]) for each in clouds)
    distances = distance_to_mesh(points, frame.local_from_crs(mesh.vertices), mesh.faces)
    reached = [is_reached(visible, points, tolerance_m=tolerance) for tolerance in TOLERANCES_M]
    lines = []
    for side, sign in (("wet", 1.0), ("dry", -1.0)):
        signed = distances.signed[sign * water.depth(distances.nearest) > SHORELINE_M]
        inner = signed[np.abs(signed) <= np.quantile(np.abs(signed), 0.9)] if len(signed) else np.array([np.nan])
        of_side = sign * water.depth(visible) > SHORELINE_M
        shares = " | ".join(f"{100.0 * each[of_side].mean():.1f} %" for each in reached)
        figures = f"{len(signed)} | {1e3 * inner.mean():.0f} mm | {1e3 * inner.std():.0f} mm"
        lines.append(f"| {path.parent.name} | {side} | {figures} | {shares} |")
    return lines


def _inside(points: np.ndarray, bounds: list[float]) -> np.ndarray:
    return ((points[:, :2] >= bounds[:2]) & (points[:, :2] <= bounds[2:])).all(axis=1)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("survey", type=Path)
    parser.add_argument("clouds", type=Path, nargs="+")
    parser.add_argument("--bounds", type=float, nargs=4)
    options = parser.parse_args()
    survey = load_survey(options.survey)
    bounds = options.bounds or list(survey.bounds)
    lines = [line for path in options.clouds for line in rows(survey, options.survey, path, bounds)]
    sys.stdout.write("\n".join([*HEAD, *lines]) + "\n")


if __name__ == "__main__":
    main()
