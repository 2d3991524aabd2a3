"""Results of a benchmark as text and picture: rows of a table, changes between two results, a Pareto front.

Errors and means are compared in pairs of blocks in plan: both clouds come from the same photographs and share most of
their noise. Times and memory are compared where both were measured on the same machine and often enough. Completeness
and the coverage of the standard deviations are shares of the whole cloud, whose differences count beyond `NOISE`. Over
several surveys the changes of each method are taken together, which judges times that were measured once, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.stats import t as student

from survey.benchmark.records import METHODS, Cost, Errors, Record, Results
from survey.compare.canvas import canvas, plain_log_ticks, save
from survey.display.blocks import aligned
from survey.display.palette import INK, RED, SERIES, SOFT
from survey.display.quantities import length

_COLOURS = (*SERIES, RED, INK)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")
_DRAWS, _SEED = 2000, 20_261_122
_LEVEL = (2.5, 97.5)
# Fewer repeats than this do not show how a time varies; fewer blocks not how an error does.
MIN_REPEATS, MIN_BLOCKS = 3, 10
# Fewer surveys than this are not taken together.
MIN_SURVEYS = 3
ANOTHER_MACHINE = "another machine"
COMPLETE, MEAN, COVERS = "complete", "mean", "std covers"
# Smaller differences are noise: of the mean as a share of the error, of completeness and of coverage as shares.
NOISE = {MEAN: 0.05, COMPLETE: 0.002, COVERS: 0.01}
# Nominal share of the errors within 1.96 standard deviations.
_COVERED = 0.95
BETTER, WORSE, SAME, UNKNOWN = "better", "worse", "as before", "not judged"
_HEAD = ("survey", "method", "quality", "poses", "device", "time", "processor", "memory", "mean", "std",
         "complete 0.2, 0.1, 0.05 m", "std covers", "")  # fmt: skip

# Of differences in hundredths.
_UNITS = {COMPLETE: " points", MEAN: " % of the error", COVERS: " points away from 95 %"}
# Records that are named where others cannot be paired.
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
    """Change of a figure of a record: the ratio of now over then, or the difference of now less then."""

    key: tuple[str, ...]  # Of the record
    figure: str
    ratio: float  # NaN where it is a difference
    # (low, high) or None: of ratio or difference, 95 %; None where there is too little to tell
    interval: tuple[float, float] | None
    verdict: str  # "better", "worse", "as before" or "not judged"
    reason: str = ""  # Of "not judged"
    # Of completeness; of the distance of the coverage from 95 %; of the mean's absolute value over the error then. NaN
    # where it is a ratio.
    difference: float = float("nan")

    @property
    def kind(self) -> str:
        """The figure without its tolerance: what its noise is known by."""
        return self.figure.partition(" at ")[0]


def changes(new: Results, old: Results) -> list[ResultChange]:
    """All figures of all records that both have; a cloud that one lacks is a change too."""
    earlier = {record.key: record for record in old.records}
    same_machine = new.machine == old.machine
    found = []
    for record in new.records:
        before = earlier.get(record.key)
        if before is not None:
            found += _of_record(record, before, same_machine)
    return found


def over_surveys(found: list[ResultChange]) -> list[ResultChange]:
    """The changes of each method and figure over all surveys: the geometric mean of ratios, the mean of differences.

    The interval is Student's, of ratios that of their logarithms: surveys count as drawn from all that could be.
    """
    groups: dict[tuple[tuple[str, ...], str], list[ResultChange]] = {}
    for change in found:
        if (np.isfinite(change.ratio) or change.kind in NOISE) and change.reason != ANOTHER_MACHINE:
            groups.setdefault((change.key[1:], change.figure), []).append(change)
    return [
        _change_over_surveys(key, figure, group) for (key, figure), group in groups.items() if len(group) >= MIN_SURVEYS
    ]


def _change_over_surveys(key: tuple[str, ...], figure: str, group: list[ResultChange]) -> ResultChange:
    name, is_difference = (f"{len(group)} surveys", *key), group[0].kind in NOISE
    values = np.array([change.difference for change in group]) if is_difference else np.log([c.ratio for c in group])
    half = student.ppf(0.5 * (1.0 + 0.01 * (_LEVEL[1] - _LEVEL[0])), len(values) - 1) * values.std(ddof=1)
    middle, half = float(values.mean()), float(half) / len(values) ** 0.5
    if is_difference:
        return _differs(name, figure, middle, (middle - half, middle + half))
    interval = (float(np.exp(middle - half)), float(np.exp(middle + half)))
    return ResultChange(name, figure, float(np.exp(middle)), interval, _verdict(*interval))


def unpaired(new: Results, old: Results) -> tuple[list[tuple[str, ...]], list[tuple[str, ...]]]:
    """Keys of the records that only the one has, and of those that only the other has."""
    new_keys, old_keys = ({record.key for record in results.records} for results in (new, old))
    return sorted(new_keys - old_keys), sorted(old_keys - new_keys)


def _of_record(new: Record, old: Record, same_machine: bool) -> list[ResultChange]:
    if new.errors is None or old.errors is None:
        if (new.errors is None) == (old.errors is None):
            return []
        verdict = WORSE if new.errors is None else BETTER
        return [ResultChange(new.key, "has a cloud", float("nan"), None, verdict)]
    found = [_error(new.key, new.errors, old.errors), _mean(new.key, new.errors, old.errors)]
    for tolerance in sorted(new.errors.completeness.keys() & old.errors.completeness.keys(), key=float):
        after, before = (errors.completeness[tolerance] for errors in (new.errors, old.errors))
        found.append(_differs(new.key, f"{COMPLETE} at {tolerance} m", after - before))
    shares = (new.errors.coverage, old.errors.coverage)
    if METHODS[new.method].is_refracted and shares[0] is not None and shares[1] is not None:
        found.append(_differs(new.key, COVERS, abs(shares[0] - _COVERED) - abs(shares[1] - _COVERED)))
    costs: tuple[tuple[str, Callable[[Cost], float]], ...] = (
        ("wall_s", lambda cost: cost.wall_s),
        ("processor_s", lambda cost: cost.processor_s),
        ("memory", lambda cost: float(cost.peak_bytes)),
    )
    for figure, of in costs:
        a, b = (np.array([of(cost) for cost in record.costs]) for record in (new, old))
        found.append(_cost(new.key, figure, a, b, same_machine))
    return found


def _error(key: tuple[str, ...], new: Errors, old: Errors) -> ResultChange:
    """Root mean square of the inner 90 %, by a bootstrap over pairs of blocks."""
    ratio, drawn = new.error_m / old.error_m, _bootstrap_sums(new, old)
    if isinstance(drawn, str):
        return ResultChange(key, "error", ratio, None, UNKNOWN, drawn)
    rms = [np.sqrt(sums[:, 2] / sums[:, 0]) for sums in drawn]
    return _judged(key, "error", ratio, rms[0] / rms[1])


def _mean(key: tuple[str, ...], new: Errors, old: Errors) -> ResultChange:
    """Bias of the inner 90 % over the earlier error, by a bootstrap over pairs of blocks."""
    difference, drawn = (abs(new.mean_m) - abs(old.mean_m)) / old.error_m, _bootstrap_sums(new, old)
    if isinstance(drawn, str):
        return ResultChange(key, MEAN, float("nan"), None, UNKNOWN, drawn, difference)
    off = [np.abs(sums[:, 1] / sums[:, 0]) for sums in drawn]
    low, high = (float(v) for v in np.percentile((off[0] - off[1]) / old.error_m, _LEVEL))
    return _differs(key, MEAN, difference, (low, high))


def _bootstrap_sums(new: Errors, old: Errors) -> tuple[np.ndarray, np.ndarray] | str:
    """Bootstrap sums (draws, 3) of both over pairs of the blocks that both have; the reason where these are too few."""
    shared = sorted(new.blocks.keys() & old.blocks.keys())
    if len(shared) < MIN_BLOCKS:
        return f"{len(shared)} blocks in common, expected {MIN_BLOCKS}"
    a, b = (np.array([errors.blocks[name] for name in shared]) for errors in (new, old))
    drawn = np.random.default_rng(_SEED).integers(len(shared), size=(_DRAWS, len(shared)))
    return a[drawn].sum(axis=1), b[drawn].sum(axis=1)


def _cost(key: tuple[str, ...], figure: str, new: np.ndarray, old: np.ndarray, same_machine: bool) -> ResultChange:
    ratio = float(np.median(new) / np.median(old))
    if not same_machine:
        return ResultChange(key, figure, ratio, None, UNKNOWN, ANOTHER_MACHINE)
    if min(len(new), len(old)) < MIN_REPEATS:
        return ResultChange(key, figure, ratio, None, UNKNOWN, f"expected --repeats {MIN_REPEATS} or more in both")
    rng = np.random.default_rng(_SEED)
    a, b = (np.median(values[rng.integers(len(values), size=(_DRAWS, len(values)))], axis=1) for values in (new, old))
    return _judged(key, figure, ratio, a / b)


def _judged(key: tuple[str, ...], figure: str, ratio: float, ratios: np.ndarray) -> ResultChange:
    low, high = (float(v) for v in np.percentile(ratios, _LEVEL))
    return ResultChange(key, figure, ratio, (low, high), _verdict(low, high))


def _differs(
    key: tuple[str, ...], figure: str, difference: float, interval: tuple[float, float] | None = None
) -> ResultChange:
    """A difference: beyond noise, and with an interval, where there is one, on the same side of zero."""
    change = ResultChange(key, figure, float("nan"), interval, SAME, "", difference)
    is_one_sided = interval is None or interval[0] > 0.0 or interval[1] < 0.0
    if abs(difference) <= NOISE[change.kind] or not is_one_sided:
        return change
    return replace(change, verdict=BETTER if (difference > 0.0) == (change.kind == COMPLETE) else WORSE)


def _verdict(low: float, high: float) -> str:
    return BETTER if high < 1.0 else WORSE if low > 1.0 else SAME


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
    """Changes for better or worse: over all surveys, then of each, then what could not be compared."""
    found = changes(new, old)
    lines = lines_of(over_surveys(found)) + lines_of(found)
    for keys, where in zip(unpaired(new, old), ("this", "the earlier"), strict=True):
        if keys:
            named = "; ".join(" ".join(key) for key in keys[:_MOST_NAMED])
            lines.append(f"only in {where} result: {len(keys)} records, {named}{'; ...' * (len(keys) > _MOST_NAMED)}")
    return lines


def lines_of(changes: list[ResultChange]) -> list[str]:
    """Lines of text, one for each change."""
    lines = []
    for change in changes:
        reason = f": {change.reason}" if change.reason else ""
        lines.append(f"{' '.join(change.key)}: {change.figure}{_difference_text(change)} {change.verdict}{reason}")
    return lines


def _difference_text(change: ResultChange) -> str:
    if np.isnan(change.ratio) and np.isnan(change.difference):
        return ""
    if np.isnan(change.difference):
        between = "" if change.interval is None else f" ({change.interval[0]:.3f} to {change.interval[1]:.3f})"
        return f" {change.ratio:.3f}{between}"
    low, high = change.interval or (np.nan, np.nan)
    between = "" if change.interval is None else f" ({100.0 * low:+.2f} to {100.0 * high:+.2f})"
    return f" {100.0 * change.difference:+.2f}{between}{_UNITS[change.kind]}"
