"""What do things that real photographs hold do to a cloud, and does its std say so? Drawn surveys, one for each seed.

    python benchmarks/bench_conditions.py -o FOLDER [CONDITION ...] [--seeds 1-3] [--quality standard] [--publish]

Each condition of condition_scenes.py is drawn, processed by the command line and held against its true bed, where that
is no wall. Prints a row for each: share of what three photographs see that is found within 5 cm, mean of the vertical
errors and std of their inner 99 %, points beyond 5 cm; of the errors less their median those within 1.96 std, all and
in the fifth of the largest std; median std, exit code. FOLDER/conditions.json has the rows, and what it has is not run
again; --publish writes their means into docs/stress.md. About a minute of one core for each.
"""

import argparse
import json
import tomllib
from pathlib import Path

import numpy as np
import tomli_w
from bench_methods import run_bathynerf
from condition_scenes import CONDITIONS
from method_cases import Case, case_of, variant
from std_coverage import WALL_DEG, slope_below
from tables import publish

from evaluation import vertical_difference
from survey.compare.comparison import CompareOptions, compare_surfaces
from survey.compare.inputs import to_local
from survey.errors import FILE_NAME
from survey.simulate.writing import write_survey

PAGE = Path(__file__).resolve().parent.parent / "docs" / "stress.md"
HEAD = "| photographs hold | at 5 cm | mean | std | beyond 5 cm | std covers | its largest fifth | median std | exit |"
TOLERANCE_M, TO_95, INNER = 0.05, 1.959964, 0.99


def measured(name: str, seed: int, folder: Path, quality: str) -> dict:
    """Draw, process and compare one survey: a record for JSON."""
    condition, place, home = CONDITIONS[name], folder / f"{name}_{seed}", folder / "home"
    home.mkdir(parents=True, exist_ok=True)
    write_survey(place, {"condition": name, "seed": seed}, lambda: condition.stage(seed))
    case = case_of(place)
    survey = variant(case, folder / f"{name}_{seed}_{condition.poses}", poses=condition.poses, is_refracted=True)
    say_otherwise(survey / FILE_NAME, dict(condition.cameras))
    run = survey / quality
    code, cost, words = run_bathynerf(["process", str(survey), "-o", str(run), "--quality", quality], home)
    record = {"exit_code": code, "processor_s": round(cost.processor_s), "words": words}
    return record | errors_of(run / "cloud.las", case) if (run / "cloud.las").is_file() else record


def say_otherwise(path: Path, keys: dict) -> None:
    """Change keys of [cameras] in a survey.toml; None leaves one out."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    cameras = table.get("cameras", {}) | keys
    table["cameras"] = {key: value for key, value in cameras.items() if value is not None}
    path.write_text(tomli_w.dumps(table), encoding="utf-8")


def errors_of(cloud: Path, case: Case) -> dict:
    """Vertical errors of a cloud over the true bed, and what its std says of them."""
    found = compare_surfaces(
        cloud, case.reference, CompareOptions((TOLERANCE_M,), visible=case.visible, bounds=case.bounds)
    )
    frame, paths, inputs = found.inputs.frame, found.inputs.paths, found.inputs
    points = to_local(frame, found.points, paths.cloud)
    vertices = to_local(frame, inputs.reference.vertices, paths.reference)
    error = vertical_difference(points, vertices, inputs.reference.faces)
    known = np.isfinite(error) & (slope_below(points, vertices, inputs.reference.faces) < WALL_DEG)
    std, common = (inputs.cloud.extra[each][inputs.inside] for each in ("std", "std_common"))
    error, std, common = error[known], std[known], common[known]
    own = error - np.median(error)
    within, largest = np.abs(own) <= TO_95 * std, std >= np.quantile(std, 0.8)
    inner = np.abs(own) <= np.quantile(np.abs(own), INNER)
    return {
        "points": len(error),
        "found": float(found.figures.tolerances[0].completeness_visible or np.nan),
        "mean_m": float(error[inner].mean()),
        "std_m": float(error[inner].std()),
        "beyond": float(np.mean(np.abs(error) > TOLERANCE_M)),
        "within": float(within.mean()),
        "within_largest": float(within[largest].mean()),
        "median_std_m": float(np.median(std)),
        "common_m": float(np.median(common)) if np.isfinite(common).any() else 0.0,
    }


def row_of(name: str, records: list[dict]) -> str:
    """A row of the table: means over the seeds."""
    known = [each for each in records if "points" in each]
    codes = ", ".join(str(each["exit_code"]) for each in records)
    if not known:
        return f"| {CONDITIONS[name].words} | | | | | | | | {codes} |"

    def mean(key: str) -> float:
        return float(np.mean([each[key] for each in known]))

    cells = [
        f"{100.0 * mean('found'):.1f} %",
        f"{1e3 * mean('mean_m'):+.1f} mm",
        f"{1e3 * mean('std_m'):.1f} mm",
        f"{100.0 * mean('beyond'):.2f} %",
        f"{100.0 * mean('within'):.1f} %",
        f"{100.0 * mean('within_largest'):.1f} %",
        f"{1e3 * mean('median_std_m'):.1f} mm",
        codes,
    ]
    return f"| {' | '.join([CONDITIONS[name].words, *cells])} |"


def _seeds(words: str) -> list[int]:
    first, _, last = words.partition("-")
    return list(range(int(first), int(last or first) + 1))


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("conditions", nargs="*", metavar="CONDITION", help=f"default: {' '.join(CONDITIONS)}")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--seeds", type=_seeds, default=_seeds("1-3"), help="first and last")
    parser.add_argument("--quality", default="standard")
    parser.add_argument("--publish", action="store_true", help="into docs")
    options = parser.parse_args()
    names = options.conditions or list(CONDITIONS)
    unknown = set(names) - set(CONDITIONS)
    if unknown:
        parser.error(f"{', '.join(sorted(unknown))} is none of {', '.join(CONDITIONS)}")
    options.output.mkdir(parents=True, exist_ok=True)
    path = options.output / "conditions.json"
    found = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    rows = [HEAD, "|" + (HEAD.count("|") - 1) * "---|"]
    for name in names:
        for seed in options.seeds:
            key = f"{name} {seed} {options.quality}"
            if key not in found:
                found[key] = measured(name, seed, options.output, options.quality)
                path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
                print(f"{key}: {json.dumps(found[key])}", flush=True)  # noqa: T201
        rows.append(row_of(name, [found[f"{name} {seed} {options.quality}"] for seed in options.seeds]))
        print(rows[-1], flush=True)  # noqa: T201
    if options.publish:
        publish(PAGE, "conditions", rows)


if __name__ == "__main__":
    main()
