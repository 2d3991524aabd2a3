"""What do real photographs give? A lidar profile through a lake, and RTK targets left out one after another.

    python benchmarks/bench_real.py [MEASURE ...] [-o FOLDER] [--publish]

Measures, each into real.json of the work folder, which keeps those that are not asked for:

greenland    `process` on real/greenland_lake as it is, and with straight rays (index 1); depth against the lidar
targets      real/swindale adjusted by its matches, with each of its targets left out in turn
shutter      real/swindale asked for a rolling shutter
streams      real/pyBathySfM and real/palau_coral_heights by bench_real_points.py

--publish writes benchmarks/results/real.json and the tables of docs/real.md. BATHYNERF_DATA names the folder of the
data. The first takes some minutes of processor time, the second the time of structure from motion and some seconds for
each target.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from published import publish
from real_measures import left_out, profile, shutter, streams
from real_tables import TABLES

from survey.benchmark.benchmark import run_bathynerf

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("BATHYNERF_DATA", ROOT.parent / "shared" / "data")) / "real"
PUBLISHED, PAGE = ROOT / "benchmarks" / "results" / "real.json", ROOT / "docs" / "real.md"
INDEX, STRAIGHT = "refractive_index = 1.3352", "refractive_index = 1.0"


def greenland(folder: Path) -> dict:
    """The lake with bent and with straight rays."""
    found = {}
    for name in ("bent", "straight"):
        survey = folder / name
        if not survey.is_dir():
            shutil.copytree(DATA / "greenland_lake", survey)
            settings = survey / "survey.toml"
            text = settings.read_text(encoding="utf-8")
            settings.write_text(text.replace(INDEX, STRAIGHT) if name == "straight" else text, encoding="utf-8")
        run = survey / "bathynerf"
        if not (run / "cloud.las").is_file():
            with tempfile.TemporaryDirectory() as home:
                _, _, words = run_bathynerf(["process", str(survey)], Path(home))
            if not (run / "cloud.las").is_file():
                raise SystemExit(f"{survey}: {words}")
        found[name] = profile(run / "cloud.las", DATA / "greenland_lake" / "lidar_profile_lon_lat_height.csv")
    return found


MEASURES: dict[str, Callable[[Path], dict]] = {
    "greenland": greenland,
    "targets": lambda folder: left_out(DATA / "swindale", folder),
    "shutter": lambda folder: shutter(DATA / "swindale", folder, folder.parent / "targets" / "sfm"),
    "streams": lambda folder: streams(DATA),
}


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("measures", nargs="*", metavar="MEASURE", help=f"default: {' '.join(MEASURES)}")
    parser.add_argument("-o", "--output", type=Path, help="work folder; default: a new temporary one")
    parser.add_argument("--publish", action="store_true", help="into docs and benchmarks/results")
    options = parser.parse_args()
    unknown = set(options.measures) - set(MEASURES)
    if unknown:
        parser.error(f"{', '.join(sorted(unknown))} is none of {', '.join(MEASURES)}")
    if not DATA.is_dir():
        raise SystemExit(f"no data at {DATA}; set BATHYNERF_DATA")
    folder = options.output or Path(tempfile.mkdtemp(prefix="bathynerf_real_"))
    folder.mkdir(parents=True, exist_ok=True)
    results = folder / "real.json"
    found = json.loads(results.read_text(encoding="utf-8")) if results.is_file() else {}
    for name in options.measures or MEASURES:
        (folder / name).mkdir(exist_ok=True)
        found[name] = MEASURES[name](folder / name)
        results.write_text(json.dumps(found, indent=1), encoding="utf-8")
        print("\n".join(TABLES[name](found[name])), flush=True)  # noqa: T201
    if options.publish:
        shutil.copyfile(results, PUBLISHED)
        for name in found:
            publish(PAGE, name, TABLES[name](found[name]))


if __name__ == "__main__":
    main()
