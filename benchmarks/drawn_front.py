"""The front of run time against error over many drawn surveys: as a picture and as a table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter

from survey.benchmark.cases import IMAGES
from survey.benchmark.records import METHODS, Record, Results
from survey.benchmark.text import pareto_front
from survey.compare.canvas import canvas, save
from survey.display.palette import INK, RED, SERIES, SOFT

COLOURS = dict(zip(METHODS, (*SERIES, RED, SOFT), strict=True))
# By depth, and by the number of photographs.
MARKERS = {"0.5": "o", "2": "s", "3.5": "^", "8": "D"}
SIZES = {"20": 5, "130": 8, "520": 11}


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
    """What stands in docs/notes/benchmark.md: where it was measured, and the table."""
    m = results.machine
    cores = "one core" if m["cores"] == "1" else f"{m['cores']} cores"
    return [f"{m['processor']}, {cores}, {m['memory']}, commit {results.commit}.", "", *table(results.records)]
