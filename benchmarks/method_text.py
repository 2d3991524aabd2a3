"""Results of a benchmark as text and picture: rows of a table, changes between two results, a Pareto front.

Changes are judged over several surveys, by their scatter; of a single one they are only shown.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from method_records import METHODS, Cost, Record, Results
from scipy.stats import t as student

from survey.display.blocks import aligned
from survey.display.canvas import canvas, plain_log_ticks, save
from survey.display.palette import INK, RED, SERIES, SOFT
from survey.display.quantities import length, listed

_COLOURS = (*SERIES, RED, INK)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")
# Fewer surveys than this are not taken together; the quantile of Student's distribution for 95 %.
MIN_SURVEYS, _UPPER = 3, 0.975
COMPLETE, MEAN, COVERS = "complete", "mean", "std covers"
# Nominal share of the errors within 1.96 standard deviations.
_COVERED = 0.95
BETTER, WORSE, SAME = "better", "worse", "as before"
_COSTS: dict[str, Callable[[Cost], float]] = {
    "wall_s": lambda cost: cost.wall_s,
    "processor_s": lambda cost: cost.processor_s,
    "memory": lambda cost: cost.peak_bytes,
}
_HEAD = ("survey", "method", "quality", "poses", "device", "time", "processor", "memory", "mean", "std",
         "complete 0.2, 0.1, 0.05 m", "std covers", "")  # fmt: skip

# Of differences in hundredths.
_UNITS = {COMPLETE: " points", MEAN: " % of the error", COVERS: " points away from 95 %"}
# Clouds that are named where one result lacks them.
_MOST_NAMED = 3


def wall_s(record: Record) -> float:
    """Median wall clock of the repeats [s]."""
    return float(np.median([cost.wall_s for cost in record.costs]))


def pareto_front(records: Sequence[Record]) -> set[tuple[str, ...]]:
    """Keys of the records on the Pareto front of each case: no other is both faster and more accurate."""
    front: set[tuple[str, ...]] = set()
    for case in {record.case for record in records}:
        least = np.inf
        known = [(wall_s(r), r.errors.error_m, r.key) for r in records if r.case == case and r.errors is not None]
        for _, error, key in sorted(known):
            if error < least:
                least = error
                front.add(key)
    return front


def draw_pareto_front(path: Path, records: Sequence[Record]) -> None:
    """Draw run time over error, both logarithmic: a colour per method, a mark per case, filled on the Pareto front."""
    known = [record for record in records if record.errors is not None]
    cases, front = list(dict.fromkeys(record.case for record in known)), pareto_front(known)
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
        plain_log_ticks(axis)
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


@dataclass(frozen=True)
class ResultChange:
    """Change of a figure of a record, or of a method over several surveys."""

    key: tuple[str, ...]  # Of the record
    figure: str
    # Natural logarithm of now over then; of completeness, of the distance of the coverage from 95 % and of the mean's
    # absolute value over the error then, now less then
    step: float
    interval: tuple[float, float] | None = None  # Of the step, 95 %; None of a single record

    @property
    def verdict(self) -> str:
        """Whether it is for better or worse, by its interval; empty without one."""
        if self.interval is None:
            return ""
        low, high = sorted(-end for end in self.interval) if self.figure.startswith(COMPLETE) else self.interval
        return BETTER if high < 0.0 else WORSE if low > 0.0 else SAME

    def __str__(self) -> str:
        unit = _UNITS.get(self.figure.partition(" at ")[0])
        steps = np.array([self.step, *(self.interval or ())])
        shown = [f"{ratio:.3f}" for ratio in np.exp(steps)] if unit is None else [f"{100.0 * s:+.2f}" for s in steps]
        between = f" ({' to '.join(shown[1:])})" if self.interval else ""
        return f"{' '.join(self.key)}: {self.figure} {shown[0]}{between}{unit or ''} {self.verdict}".rstrip()


def changes(new: Results, old: Results) -> list[ResultChange]:
    """All figures of all records of a cloud that both have; times and memory where they are of one machine."""
    now, then = _with_cloud(new), _with_cloud(old)
    costs = _COSTS if new.machine == old.machine else {}
    found = []
    for key in now.keys() & then.keys():
        found += [ResultChange(key, figure, step) for figure, step in _steps_of_errors(now[key], then[key])]
        for figure, of in costs.items():
            a, b = (np.median([of(cost) for cost in record.costs]) for record in (now[key], then[key]))
            found.append(ResultChange(key, figure, float(np.log(a / b))))
    return sorted(found, key=lambda change: change.key)


def _with_cloud(results: Results) -> dict[tuple[str, ...], Record]:
    return {record.key: record for record in results.records if record.errors is not None}


def _steps_of_errors(new: Record, old: Record) -> Iterator[tuple[str, float]]:
    now, then = new.errors, old.errors
    assert now is not None
    assert then is not None
    yield "error", float(np.log(now.error_m / then.error_m))
    yield MEAN, (abs(now.mean_m) - abs(then.mean_m)) / then.error_m
    for tolerance in sorted(now.completeness.keys() & then.completeness.keys(), key=float):
        yield f"{COMPLETE} at {tolerance} m", now.completeness[tolerance] - then.completeness[tolerance]
    # Standard deviations of clouds over straight rays are those of apparent depths.
    if METHODS[new.method].is_refracted and now.coverage is not None and then.coverage is not None:
        yield COVERS, abs(now.coverage - _COVERED) - abs(then.coverage - _COVERED)


def over_surveys(found: list[ResultChange]) -> list[ResultChange]:
    """The changes of each method and figure over all surveys, `MIN_SURVEYS` at least: means with Student's interval.

    Surveys count as drawn from all that could be.
    """
    groups: dict[tuple[tuple[str, ...], str], list[float]] = {}
    for change in found:
        groups.setdefault((change.key[1:], change.figure), []).append(change.step)
    means = []
    for (key, figure), steps in groups.items():
        if len(steps) >= MIN_SURVEYS:
            half = float(student.ppf(_UPPER, len(steps) - 1) * np.std(steps, ddof=1)) / len(steps) ** 0.5
            mean = float(np.mean(steps))
            means.append(ResultChange((f"{len(steps)} surveys", *key), figure, mean, (mean - half, mean + half)))
    return means


def table(results: Results) -> list[str]:
    """Table with a line for each record, under a head; * marks the front of its survey."""
    front = pareto_front(results.records)
    rows = [_HEAD, *(_row(record, record.key in front) for record in results.records)]
    return aligned([""] * len(_HEAD), rows, len(_HEAD))


def _row(record: Record, is_front: bool) -> tuple[str, ...]:
    name = (record.case, METHODS[record.method].words, record.quality, record.poses, record.device)
    processor = float(np.median([cost.processor_s for cost in record.costs]))
    memory = max(cost.peak_bytes for cost in record.costs)
    costs = (f"{wall_s(record):.1f} s", f"{processor:.1f} s", f"{memory / 1e9:.2f} GB")
    errors = record.errors
    if errors is None:
        return (*name, *costs, "-", "-", "-", "-", record.words[:80])
    shares = ", ".join(f"{100.0 * errors.completeness[key]:.1f}" for key in ("0.2", "0.1", "0.05"))
    # Standard deviations of clouds over straight rays are those of apparent depths.
    known = errors.coverage if METHODS[record.method].is_refracted else None
    covers = "-" if known is None else f"{100.0 * known:.1f} %"
    marks = ("*" if is_front else "") + (" quality gate failed" if record.exit_code else "")
    return (*name, *costs, length(errors.mean_m), length(errors.std_m), f"{shares} %", covers, marks.strip())


def comparison(new: Results, old: Results) -> list[str]:
    """Changes over all surveys, then of each, then the clouds that only one result has."""
    found = changes(new, old)
    lines = [str(change) for change in (*over_surveys(found), *found)]
    now, then = _with_cloud(new).keys(), _with_cloud(old).keys()
    for keys, where in ((now - then, "this"), (then - now, "the earlier")):
        if keys:
            named = listed([" ".join(key) for key in sorted(keys)], _MOST_NAMED)
            lines.append(f"only in {where} result: {len(keys)} clouds, {named}")
    return lines
