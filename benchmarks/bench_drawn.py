"""Run time against error on drawn surveys: 0.5 to 8 m deep, looking down and oblique, 20, 130 and 520 photographs.

    python benchmarks/bench_drawn.py [PART ...] -o FOLDER [--against FILE] [--publish]

Parts are 20, 130, 520 and images (poses from the photographs alone); each asks of larger surveys fewer methods, so that
all of them take about four hours of one core. The survey of a case is drawn, measured and removed. FOLDER/results.json
grows with every process; the same command continues where it was stopped, unless the code has changed. Prints the table
of docs/notes/benchmark.md; --publish writes it into that page, the results into benchmarks/results/drawn.json and the
picture into docs/img/.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
from dataclasses import dataclass
from pathlib import Path

from drawn_front import draw, lines_of
from published import publish

from survey.benchmark.benchmark import RESULTS, Settings, benchmark, commit, machine
from survey.benchmark.records import Record, read_results, write_results
from survey.benchmark.text import comparison

ROOT = Path(__file__).resolve().parent.parent
PUBLISHED, PICTURE = ROOT / "benchmarks" / "results" / "drawn.json", ROOT / "docs" / "img" / "benchmark-drawn.png"
PAGE = ROOT / "docs" / "notes" / "benchmark.md"
STRAIGHT = ("straight", "times_index", "per_camera")


@dataclass(frozen=True)
class Part:
    """Surveys of the same size, and what is measured on each, one after another."""

    drawn: tuple[str, ...]
    settings: tuple[Settings, ...]


PARTS = {
    "20": Part(
        tuple(f"{depth},{pattern},20" for depth in ("0.5", "2", "3.5", "8") for pattern in ("nadir", "oblique")),
        # In draft the whole chain is the sweep alone.
        (
            Settings(methods=("full", *STRAIGHT), qualities=("draft",)),
            Settings(methods=("full", "sweep", *STRAIGHT), qualities=("standard",)),
        ),
    ),
    "images": Part(
        ("2,oblique,20", "3.5,oblique,20"),
        (Settings(methods=("full", *STRAIGHT), qualities=("standard",), poses=("images",)),),
    ),
    "130": Part(
        ("2,oblique,130", "8,nadir,130", "0.5,nadir,130", "3.5,oblique,130"),
        (Settings(methods=("full", *STRAIGHT), qualities=("draft",)),),
    ),
    "520": Part(("2,oblique,520", "3.5,nadir,520"), (Settings(methods=("full",), qualities=("draft",)),)),
}


def measured(part: Part, folder: Path, known: list[Record]) -> list[Record]:
    """The records of a part, those that are known included; a survey whose records are all known is not drawn."""
    for word in part.drawn:
        name = f"drawn_{word.replace(',', '_')}"
        before = {record.key for record in known}
        left = [settings for settings in part.settings if not _keys(name, settings) <= before]
        if not left:
            continue
        for settings in left:
            known = list(benchmark([], folder, drawn=[word], settings=settings, known=known).records)
        for place in folder.glob(f"{name}*"):
            shutil.rmtree(place)
        shutil.rmtree(folder / "runs")
    return known


def _keys(case: str, settings: Settings) -> set[tuple[str, ...]]:
    each = (settings.methods, settings.qualities, settings.poses, settings.devices)
    return {(case, *names) for names in itertools.product(*each)}


def main() -> None:
    """Measure the parts that are asked for, all by default."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"default: {' '.join(PARTS)}")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--against", type=Path, metavar="FILE", help="an earlier results.json, e.g. the published one")
    parser.add_argument("--publish", action="store_true", help="into docs and benchmarks/results")
    options = parser.parse_args()
    unknown = [name for name in options.parts if name not in PARTS]
    if unknown:
        parser.error(f"part is {unknown[0]}, expected one of {', '.join(PARTS)}")
    # Read before hours are spent; --publish may replace it.
    earlier = None if options.against is None else read_results(options.against)
    options.output.mkdir(parents=True, exist_ok=True)
    path, known = options.output / RESULTS, []
    if path.is_file():
        before = read_results(path)
        if (before.commit, before.machine) == (commit(), machine()):
            known = list(before.records)
        else:
            path.rename(path.with_name(f"results-{before.commit.strip('+')}.json"))
    for name in options.parts or PARTS:
        known = measured(PARTS[name], options.output, known)
    results = read_results(path)
    print("\n".join(lines_of(results)))  # noqa: T201
    draw(options.output / PICTURE.name, results.records)
    if options.publish:
        write_results(PUBLISHED, results)
        draw(PICTURE, results.records)
        publish(PAGE, "drawn", lines_of(results))
    if earlier is not None:
        print("\n".join(comparison(results, earlier)))  # noqa: T201


if __name__ == "__main__":
    main()
