"""How accurate, how complete, and is the std true, on surveys that nothing was tuned on?

    python benchmarks/bench_random.py [--seeds 100-111] -o FOLDER [--quality draft standard] [--publish]

Each seed is a survey of random_surveys.py: drawn, processed by the command line in each quality, compared with its true
bed, and removed. Of a survey with waves the median error is taken off before coverage is counted. Prints rows of
Markdown; FOLDER/random.json has the rows, and what it has is not run again; --publish writes them into
docs/notes/field.md. A survey takes about a minute of one core.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

from bench_coverage import cells_of
from published import publish
from random_surveys import RandomSurvey

from survey.benchmark.benchmark import run_bathynerf
from survey.benchmark.cases import case_of
from survey.benchmark.records import Errors, errors_of

# Cells of coverage: all, fifths, four classes of views, slopes, wet, dry, and the least std.
_CLASSES = 10
PAGE = Path(__file__).resolve().parent.parent / "docs" / "notes" / "field.md"
HEAD = (
    "| seed | quality | mean | std | rms | at 0.2 m | at 0.05 m | std covers | fifths | 2 views | 3 to 4 | 5 to 7 "
    "| 8 and more | slopes | wet | dry | least std |"
)


def rows_of(seed: int, qualities: list[str], folder: Path) -> dict[str, list[str]]:
    """Cells of a table by quality; the survey and its runs are removed."""
    random, survey, home = RandomSurvey.of(seed), folder / f"survey_{seed}", folder / "home"
    home.mkdir(parents=True, exist_ok=True)
    random.draw(survey)
    case, rows = case_of(survey), {}
    for quality in qualities:
        run = survey / quality
        code, _, words = run_bathynerf(["process", str(survey), "-o", str(run), "--quality", quality], home)
        if not (run / "cloud.las").is_file():
            rows[quality] = [f"exit code {code}: {words}"]
            continue
        covers = cells_of(run, case.reference, None, random.waves_m > 0.0)
        # Without the median and what it is held against.
        rows[quality] = [*_accuracy(errors_of(run / "cloud.las", case)), *covers[:_CLASSES]]
    shutil.rmtree(survey)
    return rows


def _accuracy(errors: Errors) -> list[str]:
    lengths = [f"{1e3 * value:.1f} mm" for value in (errors.mean_m, errors.std_m, errors.rms_m)]
    return [*lengths, *(f"{100.0 * errors.completeness[tolerance]:.2f} %" for tolerance in ("0.2", "0.05"))]


def lines_of(found: dict[str, dict[str, list[str]]]) -> list[str]:
    """The table, and below it what each survey is."""
    rows = [
        f"| {' | '.join([seed, quality, *cells])} |" for seed, each in found.items() for quality, cells in each.items()
    ]
    surveys = [f"- {seed}: {RandomSurvey.of(int(seed))}" for seed in found]
    return [HEAD, "|" + (HEAD.count("|") - 1) * "---|", *rows, "", *surveys]


def main() -> None:
    """Run the seeds that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="100-111", help="first and last")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--quality", nargs="+", default=["draft", "standard"])
    parser.add_argument("--publish", action="store_true", help="into docs")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    path = options.output / "random.json"
    found = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    first, last = (int(part) for part in options.seeds.split("-"))
    for seed in range(first, last + 1):
        left = [quality for quality in options.quality if quality not in found.get(str(seed), {})]
        if left:
            found[str(seed)] = found.get(str(seed), {}) | rows_of(seed, left, options.output)
            path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        for quality, cells in found[str(seed)].items():
            print(f"| {' | '.join([str(seed), quality, *cells])} |", flush=True)  # noqa: T201
    print("\n".join(lines_of(found)))  # noqa: T201
    if options.publish:
        publish(PAGE, "random", lines_of(found))


if __name__ == "__main__":
    main()
