"""Pareto front of run time and error, and its picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter

from survey.benchmark.measured import METHODS
from survey.benchmark.records import Record
from survey.compare.canvas import canvas, save
from survey.display.palette import INK, RED, SERIES, SOFT

# Numbers within each decade that stand at the axes.
_TICKS = (1.0, 2.0, 5.0)
_COLOURS = (*SERIES, RED, INK)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")


def wall_s(record: Record) -> float:
    """Median wall clock of the repeats [s]."""
    return float(np.median([cost.wall_s for cost in record.costs]))


def on_front(records: Sequence[Record]) -> set[tuple[str, ...]]:
    """Keys of the records of each case than which none is both faster and more accurate."""
    front: set[tuple[str, ...]] = set()
    for case in {record.case for record in records}:
        least = np.inf
        known = [(wall_s(r), r.errors.error_m, r.key) for r in records if r.case == case and r.errors is not None]
        for _, error, key in sorted(known):
            if error < least:
                least = error
                front.add(key)
    return front


def draw_front(path: Path, records: Sequence[Record]) -> None:
    """Time over error on logarithmic axes: a colour for each method, a mark for each case; the front is filled."""
    known = [record for record in records if record.errors is not None]
    cases, front = list(dict.fromkeys(record.case for record in known)), on_front(known)
    figure, axes = canvas(7.2, 4.6)
    methods = [name for name in METHODS if any(record.method == name for record in known)]
    for record in known:
        assert record.errors is not None
        colour = _COLOURS[methods.index(record.method) % len(_COLOURS)]
        axes.plot(
            1000.0 * record.errors.error_m,
            wall_s(record),
            _MARKERS[cases.index(record.case) % len(_MARKERS)],
            color=colour,
            markerfacecolor=colour if record.key in front else "none",
            ms=11,
        )
        axes.annotate(
            record.quality[0].upper(), (1000.0 * record.errors.error_m, wall_s(record)), ha="center", va="center",
            fontsize=7, color="white" if record.key in front else colour,
        )  # fmt: skip
    letters = dict.fromkeys(record.quality for record in known)
    for label, marker, colour, is_filled in legend_of(methods, cases):
        axes.plot([], [], marker, color=colour, markerfacecolor=colour if is_filled else "none", label=label)
    axes.plot([], [], " ", label=", ".join(f"{name[0].upper()}: {name}" for name in letters))
    axes.set(xscale="log", yscale="log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=_TICKS))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("error: root of mean² + std² of the inner 90 % [mm]", color=INK)
    axes.set_ylabel("run time [s]", color=INK)
    axes.grid(True, lw=0.3, color=SOFT, alpha=0.5)
    if known:
        axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(figure, path)


def legend_of(methods: Sequence[str], cases: Sequence[str]) -> list[tuple[str, str, str, bool]]:
    """Legend of the marks: words, marker, colour, and whether it is filled."""
    return [
        *((METHODS[name].words, "o", _COLOURS[i % len(_COLOURS)], True) for i, name in enumerate(methods)),
        *((case, _MARKERS[i % len(_MARKERS)], INK, False) for i, case in enumerate(cases)),
        ("filled: on the front", "o", SOFT, True),
        ("hollow: another is faster and more accurate", "o", SOFT, False),
    ]
