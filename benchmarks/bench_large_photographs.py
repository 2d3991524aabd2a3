"""What do 100 photographs of 20 Mpx take, whole, with a given memory?

    python benchmarks/bench_large_photographs.py FOLDER [--memory 3GB] [--workers 1] [--number 100] [-o FILE.json]

Enlarges the photographs of data/wreck_water that are nearest to its middle to 5168 x 3876 px in FOLDER/large_100, once,
with an area of 12 x 12 m there, and processes them at `--image-scale 1`, quality standard, poses as given. Enlarged
photographs cost what such photographs cost, and show nothing more. Without `--memory` the run takes what is free.
Prints and writes what bench_photographs.py does. Linux alone tells the memory.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import tomllib
from pathlib import Path

import cv2
import numpy as np
from bench_photographs import measured_run

from survey.benchmark.benchmark import machine

ROOT = Path(__file__).resolve().parents[1]
SOURCE = Path(os.environ.get("BATHYNERF_DATA", ROOT.parent / "shared" / "data")) / "wreck_water"
ENLARGED = 5.046875
HALF_SIDE_M = 6.0


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
    parser.add_argument("--memory")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--number", type=int, default=100)
    parser.add_argument("-o", "--output", type=Path)
    asked = parser.parse_args()
    survey = asked.folder / f"large_{asked.number}"
    if not (survey / "survey.toml").exists():
        enlarge(SOURCE, survey, asked.number)
    words = ["--quality", "standard", "--image-scale", "1", "--workers", str(asked.workers)]
    words += [] if asked.memory is None else ["--memory", asked.memory]
    row = measured_run(survey, words, SOURCE / "reference.ply")
    print(json.dumps(row))  # noqa: T201
    if asked.output is not None:
        text = json.dumps({"machine": machine(), "memory": asked.memory, **row}, indent=2)
        asked.output.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
