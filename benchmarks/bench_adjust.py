"""How well does a run find poses, lens and water from what is known in the field? On data/ and on field surveys.

    python benchmarks/bench_adjust.py [ROW ...] [-o FOLDER]
    python benchmarks/bench_adjust.py --coverage 20 [--shared] [--free-water] [--common-up 30]

A row is a name of adjust_rows.ROWS or shutter_rows.SHUTTER_ROWS, or the folder of a survey that field_surveys.py drew;
FOLDER:true is the same from its true poses, lens and water. Its survey is prepared in the work folder and processed by
the command line; a row that the program refuses has its words. Prints a table, and writes results.json into the work
folder.

With --coverage: how often the truth of so many drawn blocks, without images, lies within what is stated.
"""

import argparse
import json
import tempfile
from functools import partial
from pathlib import Path

from adjust_coverage import covered, table
from adjust_measures import brighton_errors, copr_errors, errors_of
from adjust_rows import DATA, ROWS, SHUTTER_ROWS, Row, prepare
from bench_methods import run_bathynerf

MEASURES = {"drawn": errors_of, "brighton": brighton_errors, "copr": copr_errors}
# Titles of the table, and the figures in millimetres.
COLUMNS = {"mean": "mean_inner90_m", "std": "std_inner90_m", "wet": "wet_mean_inner90_m", "dry": "dry_mean_inner90_m",
           "rods": "rods_rms_m", "of the true bed": "rods_floor_rms_m"}  # fmt: skip


def main() -> None:
    """Process and measure the requested rows."""
    names = [*ROWS, *SHUTTER_ROWS]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", nargs="*", metavar="ROW", default=names, help=f"default: {' '.join(names)}")
    parser.add_argument("--quality", help="instead of that of the row")
    parser.add_argument("-o", "--output", type=Path, help="work folder; default: a new temporary one")
    parser.add_argument("--coverage", type=int, metavar="N", help="adjust N drawn blocks instead")
    parser.add_argument("--shared", action="store_true", help="their neighbours have errors in common")
    parser.add_argument("--free-water", action="store_true", help="nothing is known of their water")
    parser.add_argument("--common-up", type=float, metavar="M", help="heights of their GPS share an error of this std")
    options = parser.parse_args()
    if options.coverage is not None:
        points = 900 if options.shared else 300
        blocks = [
            covered(
                seed,
                shared=options.shared,
                free_water=options.free_water,
                num_points=points,
                common_up_m=options.common_up,
            )
            for seed in range(options.coverage)
        ]
        print(table(blocks))  # noqa: T201
        return
    if not DATA.is_dir():
        raise SystemExit(f"no survey data at {DATA}; set BATHYNERF_DATA")
    folder = options.output or Path(tempfile.mkdtemp(prefix="bathynerf_adjust_"))
    folder.mkdir(parents=True, exist_ok=True)
    records = []
    for name in options.rows:
        work = folder / Path(name).name.replace(":", "_")
        row = (SHUTTER_ROWS.get(name) or partial(prepare, name))(work / "survey")
        records.append({"row": name} | measure(row, work / "run", options.quality or row.quality))
        (folder / "results.json").write_text(json.dumps(records, indent=1), encoding="utf-8")
        print(as_text(records[-1]), flush=True)  # noqa: T201


def measure(row: Row, run: Path, quality: str) -> dict:
    """Process a prepared survey and measure what came out."""
    command = ["process", str(row.survey), "-o", str(run), "--quality", quality, "--no-resume", *row.options]
    with tempfile.TemporaryDirectory() as home:
        code, cost, words = run_bathynerf(command, Path(home))
    record = {"quality": quality, "wall_s": round(cost.wall_s, 1), "peak_gb": round(cost.peak_bytes / 1e9, 2)}
    if not (run / "cloud.las").is_file():
        # Refused; what it says is worth reading.
        return record | {"exit_code": code, "words": [words]}
    return record | {"exit_code": code} | MEASURES[row.kind](row, run)


def as_text(record: dict) -> str:
    """One line of the table, and one for each parameter that was found."""
    parts = [f"{record['row']:<14}", f"{record['wall_s']:>7.1f} s", f"{record['peak_gb']:>5.2f} GB"]
    if "words" in record:
        return "  ".join([*parts, f"exit code {record['exit_code']}:", *record["words"]])
    parts += [f"{title} {1000.0 * record[key]:.1f} mm" for title, key in COLUMNS.items() if key in record]
    shares = [f"{100.0 * record[f'completeness_visible_{t}']:.1f} %" for t in ("0.2", "0.05") if is_drawn(record)]
    parts += [" / ".join(shares)] if shares else []
    parts += [f"{key} {value:.4g}" for key, value in record.get("real", {}).items()]
    if "position_rms_m" in record:
        across = " ".join(f"{1000.0 * v:.0f}" for v in record["position_rms_m"])
        parts.append(f"poses {across} mm {1000.0 * record['rotation_rms_deg']:.1f} mdeg")
    lines = ["  ".join(parts)]
    for name, found in record.get("parameters", {}).items():
        std = "-" if found["std"] is None else f"{found['std']:.5g}"
        inside = {True: "within", False: "BEYOND", None: ""}[found.get("in_95")]
        lines.append(f"    {name:<20} off {found['error']:+.5g}  std {std}  {found['status']}  {inside}")
    return "\n".join(lines)


def is_drawn(record: dict) -> bool:
    """Whether the whole true surface is known."""
    return "completeness_visible_0.2" in record


if __name__ == "__main__":
    main()
