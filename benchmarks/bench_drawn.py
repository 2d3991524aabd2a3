"""Run time against error on drawn surveys: 0.5 to 8 m deep, looking down and oblique, 20, 130 and 520 photographs.

    python benchmarks/bench_drawn.py [PART ...] -o FOLDER [--against FILE] [--publish]

Parts are 20, 130, 520 and images (poses from the photographs alone); each asks of larger surveys fewer methods, so that
all of them take about four hours of one core. The survey of a case is drawn, measured and removed. FOLDER/results.json
grows with every process; the same command continues where it was stopped, unless the code has changed. Prints a
table; --publish writes the results into benchmarks/results/drawn.json, of which tables.py makes those of
docs/benchmark.md, and the picture into docs/img/.
"""

import argparse
import itertools
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_methods import RESULTS, Settings, benchmark, commit, machine
from matplotlib.ticker import LogLocator, NullFormatter
from method_cases import IMAGES
from method_records import METHODS, Record, Results, read_results, write_results
from method_text import comparison, pareto_front

from survey.display.canvas import canvas, save
from survey.display.palette import INK, RED, SERIES, SOFT

COLOURS = dict(zip(METHODS, (*SERIES, RED), strict=True))
# By depth, and by the number of photographs.
MARKERS = {"0.5": "o", "2": "s", "3.5": "^", "8": "D"}
SIZES = {"20": 5, "130": 8, "520": 11}
ROOT = Path(__file__).resolve().parent.parent
PUBLISHED, PICTURE = ROOT / "benchmarks" / "results" / "drawn.json", ROOT / "docs" / "img" / "benchmark-drawn.png"
STRAIGHT = ("straight", "times_index", "per_camera")


def parts_of(record: Record) -> tuple[str, str, str]:
    """Depth, pattern and number of photographs, from the name of a drawn case."""
    _, depth, pattern, number = record.case.split("_")
    return depth, pattern, number


def processor_s(record: Record) -> float:
    """Median processor time of the repeats [s]."""
    return float(np.median([cost.processor_s for cost in record.costs]))


def draw(path: Path, records: Sequence[Record]) -> None:
    """Processor time over error: a colour for each method, a mark for each depth; thin lines join two qualities.

    Processor time, since that of the wall counts what else a machine has to do.
    """
    known = [record for record in records if record.errors is not None]
    figure, axes = canvas(8.0, 5.2)
    for record in known:
        depth, _, number = parts_of(record)
        colour = COLOURS[record.method]
        better = next((o for o in known if _is_standard_of(o, record)), None)
        if better is not None:
            pair = (record, better)
            axes.plot(
                [_error_mm(r) for r in pair], [processor_s(r) for r in pair], "-", color=colour, lw=0.5, alpha=0.5
            )
        axes.plot(
            _error_mm(record), processor_s(record), MARKERS.get(depth, "v"), color=colour, ms=SIZES.get(number, 7),
            markerfacecolor="none" if record.quality == "draft" else colour, mew=1.0, alpha=0.9,
        )  # fmt: skip
        if record.poses == IMAGES:
            axes.plot(_error_mm(record), processor_s(record), "x", color="white", ms=4, mew=1.2)
    if any(record.poses == IMAGES for record in known):
        axes.plot([], [], "X", color=INK, ms=6, label="crossed: from the photographs alone")
    for label, marker, colour, size, is_filled in legend_of(known):
        face = colour if is_filled else "none"
        axes.plot([], [], marker, color=colour, markerfacecolor=face, ms=size, label=label)
    axes.set(xscale="log", yscale="log")
    # At least a decade, so that small differences look small.
    low, high = axes.get_ylim()
    if high < 10.0 * low:
        axes.set_ylim(low / 3.0, 3.0 * high)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("error: root of mean² + std² of the inner 90 % [mm]", color=INK)
    axes.set_ylabel("processor time [s]", color=INK)
    axes.grid(True, lw=0.3, color=SOFT, alpha=0.5)
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(figure, path)


def legend_of(records: Sequence[Record]) -> list[tuple[str, str, str, int, bool]]:
    """What marks mean, of what there is: words, marker, colour, size, and whether it is filled."""
    parts = [parts_of(record) for record in records]
    depths, numbers = {depth for depth, _, _ in parts}, {number for _, _, number in parts}
    methods = {record.method for record in records}
    return [
        *((METHODS[name].words, "o", COLOURS[name], 6, True) for name in METHODS if name in methods),
        *((f"{depth} m deep", marker, INK, 6, False) for depth, marker in MARKERS.items() if depth in depths),
        *((f"{number} photographs", "o", INK, size, False) for number, size in SIZES.items() if number in numbers),
        ("hollow: draft", "o", INK, 6, False),
        ("filled: standard", "o", INK, 6, True),
    ]


def _is_standard_of(other: Record, record: Record) -> bool:
    same = (other.case, other.method, other.poses) == (record.case, record.method, record.poses)
    return same and record.quality == "draft" and other.quality == "standard"


def _error_mm(record: Record) -> float:
    assert record.errors is not None
    return 1000.0 * record.errors.error_m


def table(records: Sequence[Record]) -> list[str]:
    """Lines of Markdown: a row for each record, * on the front of its survey."""
    front = pareto_front(records)
    lines = [
        "| depth | pattern | photographs | poses | quality | method | time | processor | memory | mean | std | "
        "complete at 0.2, 0.1, 0.05 m | std covers | median / std_common | |",
        "|" + 15 * "---|",
    ]
    return lines + [_row(record, record.key in front) for record in records]


def _row(record: Record, is_front: bool) -> str:
    depth, pattern, number = parts_of(record)
    memory = max(cost.peak_bytes for cost in record.costs) / 1e9
    wall = float(np.median([cost.wall_s for cost in record.costs]))
    start = (
        f"| {depth} m | {pattern} | {number} | {record.poses} | {record.quality} | {METHODS[record.method].words} | "
        f"{wall:.0f} s | {processor_s(record):.0f} s | {memory:.1f} GB |"
    )
    errors = record.errors
    if errors is None:
        return f"{start} | | | | | {record.words[:120]} |"
    shares = ", ".join(f"{100.0 * errors.completeness[key]:.1f}" for key in ("0.2", "0.1", "0.05"))
    is_ours = errors.coverage is not None and METHODS[record.method].is_refracted
    covers = f"{100.0 * errors.coverage:.0f} %" if errors.coverage is not None and is_ours else ""
    ratio = abs(errors.median_m) / errors.common_m if is_ours and errors.median_m and errors.common_m else None
    words = ("*" if is_front else "") + (" gate failed" if record.exit_code else "")
    return (
        f"{start} {1e3 * errors.mean_m:.1f} mm | {1e3 * errors.std_m:.1f} mm | {shares} % | {covers} | "
        f"{'' if ratio is None else f'{ratio:.2f}'} | {words.strip()} |"
    )


def lines_of(results: Results) -> list[str]:
    """Where it was measured, and the table."""
    m = results.machine
    cores = "one core" if m["cores"] == "1" else f"{m['cores']} cores"
    return [f"{m['processor']}, {cores}, {m['memory']}, commit {results.commit}.", "", *table(results.records)]


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
    if earlier is not None:
        print("\n".join(comparison(results, earlier)))  # noqa: T201


if __name__ == "__main__":
    main()
