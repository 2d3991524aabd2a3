"""How long does `bathynerf process` take, what memory, and how far is the bed from the truth? On the drawn surveys.

    python benchmarks/bench_surveys.py [NAME ...] [--quality Q] [--field F] [-o FOLDER]

Each survey is processed by the command line with a cold kernel cache; wall clock and peak memory are those of the whole
process tree, imports included. Prints one JSON with a record per survey.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from survey.benchmark.running import run_bathynerf

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("BATHYNERF_DATA", ROOT.parent / "shared" / "data"))
QUALITY = {"quick": "standard", "river": "standard", "wreck_water": "draft", "wreck_dry": "draft"}
FIGURES = ("n_points", "mean_inner90_m", "std_inner90_m")
SHARES = ("accuracy_share", "completeness_visible")
BATHYNERF = (sys.executable, "-c", "from survey.commands.app import main; main()")


def measure(name: str, quality: str, field: str, folder: Path) -> dict:
    """Process one survey and compare it with its reference."""
    survey, run = DATA / name, folder / f"{name}_{quality}_{field}"
    with tempfile.TemporaryDirectory() as home:  # Dr.Jit keeps its compiled kernels in the home folder
        options = ["-o", str(run), "--quality", quality, "--field", field, "--no-resume"]
        code, cost, _ = run_bathynerf(["process", str(survey), *options], Path(home))
    if code != 0:
        return {"survey": name, "exit_code": code}
    reference = (DATA / name.replace("dry", "water") / "reference.ply").resolve()
    record = {"survey": name, "quality": quality, "field": field}
    record |= {"wall_s": round(cost.wall_s, 1), "peak_gb": round(cost.peak_bytes / 1e9, 2)}
    return record | compared(survey, run, reference, survey / "visible.ply")


def compared(survey: Path, run: Path, reference: Path, visible: Path) -> dict:
    """The errors of the cloud of a run within the bounds of its survey."""
    bounds = [str(v) for v in tomllib.loads((survey / "survey.toml").read_text())["area"]["bounds"]]
    record = {}
    for tolerance in ("0.2", "0.05"):
        out = run / f"compare_{tolerance}.json"
        options = ["--visible", str(visible), "--tolerance", tolerance, "--bounds", *bounds]
        command = [*BATHYNERF, "compare", str(run / "cloud.las"), str(reference), *options, "--json", str(out), "-q"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        numbers = json.loads(out.read_text())
        record |= {k: numbers[k] for k in FIGURES} | {f"{k}_{tolerance}": numbers[k] for k in SHARES}
        for part in ("wet", "dry"):
            record |= {f"{part}_{k}": numbers[part][k] for k in FIGURES} if numbers.get(part) else {}
    return record


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=["quick", "river", "wreck_water"])
    parser.add_argument("--quality")
    parser.add_argument("--field", default="auto")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    if not DATA.is_dir():
        raise SystemExit(f"no survey data at {DATA}; set BATHYNERF_DATA")
    folder = options.output or Path(tempfile.mkdtemp(prefix="bathynerf_bench_"))
    records = [measure(n, options.quality or QUALITY.get(n, "standard"), options.field, folder) for n in options.names]
    print(json.dumps(records, indent=2))  # noqa: T201


if __name__ == "__main__":
    main()
