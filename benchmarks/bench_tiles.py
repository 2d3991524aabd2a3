"""What does it cost to work in tiles, and does the cloud show where they meet?

    python benchmarks/bench_tiles.py SURVEY [--tiles 4] [--quality draft] [--pairs 1] [-o FILE.json]

Processes a survey with a true surface (reference.ply, visible.ply) in one piece and in tiles, in turn, each in a
process of its own. Prints and writes: processor time, peak of resident memory, number of points, and of the vertical
errors against the truth within the bounds of the survey mean and std of the inner 90 %, completeness at 0.2 and
0.05 m, and the steps at the lines between tiles: the difference of the median errors of strips of 0.5 m on either side
of each, in both clouds. The cloud in one piece has no such lines, and says by how much strips differ without them.
"""

import argparse
import json
import shutil
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np
from bench_methods import machine, run_bathynerf

from evaluation import distance_to_mesh, is_reached
from geo import read_cloud, read_reference
from survey.folder.survey import load_survey
from survey.plan.area import Tiling
from survey.plan.choices import Choices
from survey.plan.plan import make_plan
from survey.plan.tiling import RIM_GSD, ground_of

STRIP_M = 0.5
TOLERANCES_M = (0.2, 0.05)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("survey", type=Path)
    parser.add_argument("--tiles", type=int, default=4)
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--pairs", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path)
    asked = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        survey = Path(folder) / asked.survey.name
        shutil.copytree(asked.survey, survey, copy_function=shutil.copyfile)
        for _ in range(asked.pairs):
            for tiles in (1, asked.tiles):
                rows.append(_row(survey, Path(folder), tiles, asked.tiles, asked.quality))
                print(json.dumps(rows[-1]), flush=True)  # noqa: T201
    one, many = ([row for row in rows if row["tiles"] == tiles] for tiles in (1, asked.tiles))
    summary = {
        "processor_time": _mean(many, "processor_s") / _mean(one, "processor_s"),
        "memory": _mean(many, "memory_bytes") / _mean(one, "memory_bytes"),
        "mean_mm": _mean(many, "mean_mm") - _mean(one, "mean_mm"),
        "std": _mean(many, "std_mm") / _mean(one, "std_mm"),
        "completeness": {
            key: many[0]["completeness"][key] - one[0]["completeness"][key] for key in one[0]["completeness"]
        },
        "largest_step_mm": max(abs(step) for step in many[0]["steps_mm"]),
        "largest_step_in_one_piece_mm": max(abs(step) for step in one[0]["steps_mm"]),
    }
    print(json.dumps(summary, indent=2))  # noqa: T201
    if asked.output is not None:
        found = {"survey": asked.survey.name, "quality": asked.quality, "tiles": asked.tiles, "machine": machine()}
        asked.output.write_text(json.dumps(found | {"runs": rows, "tiles_against_one": summary}, indent=2) + "\n")


def _mean(rows: list[dict], key: str) -> float:
    return float(np.mean([row[key] for row in rows]))


def _row(survey: Path, folder: Path, tiles: int, lines_of: int, quality: str) -> dict:
    """One run, and its cloud against the truth."""
    run = folder / f"run_{tiles}"
    arguments = ["process", str(survey), "-o", str(run), "--quality", quality, "--tiles", str(tiles), "--no-resume"]
    # Both begin without compiled kernels.
    home = Path(tempfile.mkdtemp(dir=folder))
    code, cost, words = run_bathynerf([*arguments, "-q"], home)
    if code != 0:
        raise SystemExit(f"process ended with {code}: {words}")
    found = {"tiles": tiles, "processor_s": cost.processor_s, "wall_s": cost.wall_s, "memory_bytes": cost.peak_bytes}
    return found | _errors(survey, run / "cloud.las", lines_of, quality)


def _errors(folder: Path, path: Path, tiles: int, quality: str) -> dict:
    survey, cloud = load_survey(folder), read_cloud(path)
    truth = folder / "truth" if (folder / "truth").is_dir() else folder
    frame, mesh = survey.frame, read_reference(truth / "reference.ply")
    visible = frame.local_from_crs(read_reference(truth / "visible.ply").points)
    xyz = frame.local_from_crs(cloud.points)
    e0, n0, e1, n1 = survey.bounds
    east, north, _ = cloud.points.T
    inside = (east >= e0) & (east <= e1) & (north >= n0) & (north <= n1)
    distance = distance_to_mesh(xyz[inside], frame.local_from_crs(mesh.vertices), mesh.faces).signed
    inner = distance[np.abs(distance) <= np.quantile(np.abs(distance), 0.9)]
    plan = make_plan(survey, Choices(quality=quality))
    tiling = Tiling.of(ground_of(survey, plan), tiles, RIM_GSD * plan.gsd_m)
    return {
        "points": int(inside.sum()),
        "mean_mm": 1e3 * float(inner.mean()),
        "std_mm": 1e3 * float(inner.std()),
        "completeness": {f"{m:g}": float(is_reached(visible, xyz, tolerance_m=m).mean()) for m in TOLERANCES_M},
        "steps_mm": _steps(xyz[inside], distance, tiling),
    }


def _steps(xyz: np.ndarray, distance: np.ndarray, tiling: Tiling) -> list[float]:
    """Differences [mm] of the median errors on both sides of each line, tile by tile along it."""
    found = []
    for axis, lines, across in ((0, tiling.x, tiling.y), (1, tiling.y, tiling.x)):
        for line in lines[1:-1]:
            for low, high in pairwise(across):
                along = (xyz[:, 1 - axis] >= low) & (xyz[:, 1 - axis] < high)
                off = xyz[:, axis] - line
                sides = [distance[along & (side * off > 0.0) & (side * off < STRIP_M)] for side in (-1.0, 1.0)]
                found.append(1e3 * float(np.median(sides[1]) - np.median(sides[0])))
    return found


if __name__ == "__main__":
    main()
