"""How do time and memory of a run grow with the number of photographs?

    python benchmarks/bench_photographs.py FOLDER [130 520 2080] [--quality draft] [--workers 1]
        [--photographs-of-tile 14.4] [-o FILE.json]
    python benchmarks/bench_photographs.py FOLDER 100 --enlarged --quality standard [--memory 3GB]

Draws in FOLDER/<number> strips of 320 x 240 px over a bed 1.5 m deep, 12 m over the water (a pixel covers 25 mm),
6.5 m² for each photograph whatever their number, and keeps them. Processes each with poses as given, in a tile for
every 14.4 photographs: of 130 in nine, one of which has others on every side, as most of larger surveys have. Prints
and writes: wall time by stage and of all, processor time, peak of anonymous memory [bytes] of the process of the run
and of the largest worker, points, mean and std of the inner 90 % of the vertical errors. Linux alone tells the memory.
With --enlarged that many photographs of data/wreck_water, the nearest to its middle, are enlarged to 20 Mpx and
processed whole, with an area of 12 x 12 m: they cost what such photographs cost, and show nothing more.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import subprocess
import sys
import tempfile
import time
import tomllib
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np

from evaluation import distance_to_mesh
from geo import read_cloud, read_reference
from survey.benchmark.benchmark import PeakMemory, machine
from survey.folder.survey import load_survey
from survey.run.folder import RunDir
from survey.simulate.drawn import DrawnScene, stage_drawing
from survey.simulate.output.sidecars import StagedScene
from survey.simulate.output.writing import write_survey

_BATHYNERF = (sys.executable, "-c", "from survey.commands.app import main; main()")
GROUND_OF_PHOTOGRAPH_M2 = 6.5
# Of the extent of a drawn scene, what the cameras of its strips span.
SPAN = (0.6, 0.7)
# Errors are those of this far around the middle [m]: the whole surface would take more memory than a run.
MIDDLE_M = 8.0
# Points whose errors are looked at, about.
_POINTS = 1_000_000
# Share of the extent of the true surface along its edges where errors are not looked at.
_EDGE = 0.05
# Photographs that are enlarged to 5168 x 3876 px, over this far around the middle of their survey [m].
ROOT = Path(__file__).resolve().parents[1]
SOURCE = Path(os.environ.get("BATHYNERF_DATA", ROOT.parent / "shared" / "data")) / "wreck_water"
ENLARGED = 5.046875
HALF_SIDE_M = 6.0


def scene_of(number: int) -> DrawnScene:
    """Strips of so many photographs that look down."""
    side = math.sqrt(GROUND_OF_PHOTOGRAPH_M2 * number)
    return DrawnScene(
        size_m=(side / SPAN[0], side / SPAN[1]),
        depth_m=1.5,
        num_views=number,
        nadir_share=1.0,
        image_px=(320, 240),
        focal_px=480.0,
        flying_m=12.0,
        cell_m=0.05,
        texel_m=0.02,
        objects=False,
    )


def bounds_of(scene: StagedScene, half_m: float) -> tuple[float, float, float, float]:
    """Bounds in crs so far around the middle."""
    east, north = scene.frame.origin[:2]
    return east - half_m, north - half_m, east + half_m, north + half_m


def draw(survey: Path, number: int) -> None:
    """Draw a survey, of one ray per pixel, with the truth of its middle alone; its bounds are what the strips cover."""
    scene = stage_drawing(scene_of(number))
    middle = bounds_of(scene, MIDDLE_M)
    scene = replace(scene, bounds=middle, sensor=replace(scene.sensor, samples=1))
    write_survey(survey, asdict(scene_of(number)), lambda: scene)
    whole = bounds_of(scene, 0.5 * math.sqrt(GROUND_OF_PHOTOGRAPH_M2 * number))
    text = (survey / "survey.toml").read_text(encoding="utf-8")
    was, now = (f"bounds = [{', '.join(f'{each:.3f}' for each in box)}]" for box in (middle, whole))
    if was not in text:
        raise RuntimeError(f"survey.toml of {survey} lacks {was}")
    (survey / "survey.toml").write_text(text.replace(was, now), encoding="utf-8")


def row_of(survey: Path, number: int, tiles: int, quality: str, workers: int) -> dict:
    """A run of a survey, measured."""
    words = ["--quality", quality, "--tiles", str(tiles), "--workers", str(workers)]
    asked = {"photographs": number, "tiles": tiles, "quality": quality, "workers": workers}
    return asked | measured_run(survey, words, survey / "truth" / "reference.ply")


def measured_run(survey: Path, words: list[str], reference: Path) -> dict:
    """Time, memory, points and errors of `bathynerf process` with these options."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        start, before = time.monotonic(), os.times()
        process = subprocess.Popen(
            [*_BATHYNERF, "process", str(survey), "-o", str(run), "-q", *words], stdout=subprocess.DEVNULL
        )
        memory = PeakMemory(process.pid)
        code = process.wait()
        memory.stop()
        wall, after = time.monotonic() - start, os.times()
        if code not in (0, 3):
            raise SystemExit(f"the run of {survey} ended with exit code {code}; see its output above")
        cloud = read_cloud(RunDir(run).cloud_path)
        off, count = errors_of(survey, cloud.points, reference), len(cloud.points)
        timings = json.loads((run / "report.json").read_text(encoding="utf-8"))["timings_s"]
    inner = off[np.abs(off) <= np.quantile(np.abs(off), 0.9)]
    return {
        "processor_s": after.children_user - before.children_user + after.children_system - before.children_system,
        "wall_s": wall,
        "memory_bytes": memory.own,
        "worker_bytes": memory.child,
        "points": count,
        "mean_mm": 1e3 * float(inner.mean()),
        "std_mm": 1e3 * float(inner.std()),
        "stages_s": timings,
    }


def errors_of(folder: Path, points: np.ndarray, reference: Path) -> np.ndarray:
    """Signed distances [m] of the points in the middle of a survey to the true surface there."""
    frame, mesh = load_survey(folder).frame, read_reference(reference)
    xyz, vertices = frame.local_from_crs(points), frame.local_from_crs(mesh.vertices)
    # The true surface lies about the middle of the scene, which is not the origin of the survey's local frame.
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    margin = _EDGE * (high - low)
    here = xyz[((xyz[:, :2] > low + margin) & (xyz[:, :2] < high - margin)).all(axis=1)]
    return distance_to_mesh(here[:: len(here) // _POINTS + 1], vertices, mesh.faces).signed


def enlarge(source: Path, survey: Path, number: int) -> None:
    """Write a survey of the photographs nearest to the middle of another, enlarged."""
    header, *lines = (source / "cameras.csv").read_text(encoding="utf-8").split()
    text = (source / "survey.toml").read_text(encoding="utf-8")
    given = tomllib.loads(text)
    box = np.array(given["area"]["bounds"])
    middle = 0.5 * (box[:2] + box[2:])
    away = [np.linalg.norm(np.array(line.split(",")[1:3], float) - middle) for line in lines]
    chosen = [lines[each] for each in sorted(np.argsort(away)[:number])]
    (survey / "images").mkdir(parents=True)
    for line in chosen:
        name = line.split(",")[0]
        pixels = cv2.imread(str(source / "images" / name))
        large = cv2.resize(pixels, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(survey / "images" / name), large, [cv2.IMWRITE_JPEG_QUALITY, 92])
    (survey / "cameras.csv").write_text("\n".join([header, *chosen]) + "\n", encoding="utf-8")
    for key in ("size_px", "focal_px", "principal_point_px"):
        text = _with(text, key, (ENLARGED * np.array(given["cameras"][key])).tolist())
    text = _with(text, "bounds", [*(middle - HALF_SIDE_M).tolist(), *(middle + HALF_SIDE_M).tolist()])
    (survey / "survey.toml").write_text(text, encoding="utf-8")


def _with(text: str, key: str, value: float | list[float]) -> str:
    """survey.toml with another value of a key; sizes are whole numbers."""
    if key == "size_px":
        value = [round(each) for each in value]
    return re.sub(rf"^{key} = [^#\n]*", f"{key} = {json.dumps(value)} ", text, flags=re.MULTILINE)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("photographs", type=int, nargs="*", default=[130, 520, 2080])
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--photographs-of-tile", type=float, default=130 / 9)
    parser.add_argument("--enlarged", action="store_true")
    parser.add_argument("--memory", help="of a run of enlarged photographs, e.g. 3GB")
    parser.add_argument("-o", "--output", type=Path)
    asked = parser.parse_args()
    rows = []
    if asked.enlarged:
        (number,) = asked.photographs
        survey = asked.folder / f"large_{number}"
        if not (survey / "survey.toml").exists():
            enlarge(SOURCE, survey, number)
        words = ["--quality", asked.quality, "--image-scale", "1", "--workers", str(asked.workers)]
        words += [] if asked.memory is None else ["--memory", asked.memory]
        print(json.dumps(measured_run(survey, words, SOURCE / "reference.ply")))  # noqa: T201
        return
    for number in asked.photographs:
        survey = asked.folder / str(number)
        if not (survey / "survey.toml").exists():
            draw(survey, number)
        rows.append(row_of(survey, number, round(number / asked.photographs_of_tile), asked.quality, asked.workers))
        print(json.dumps(rows[-1]), flush=True)  # noqa: T201
    if asked.output is not None:
        asked.output.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
