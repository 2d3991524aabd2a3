"""The records of a benchmark as the rows of a table."""

from __future__ import annotations

import numpy as np

from survey.benchmark.against import COMPLETE, COVERS, MEAN, Change, changes, over_surveys, unpaired
from survey.benchmark.front import on_front, wall_s
from survey.benchmark.measured import METHODS
from survey.benchmark.records import Record, Results
from survey.display.quantities import length

_HEAD = ("survey", "method", "quality", "poses", "device", "time", "processor", "memory", "mean", "std",
         "complete 0.2, 0.1, 0.05 m", "std covers", "")  # fmt: skip

# Of differences in hundredths.
_UNITS = {COMPLETE: " points", MEAN: " % of the error", COVERS: " points away from 95 %"}
# Records that are named where others cannot be paired.
_MOST_NAMED = 3


def table(results: Results) -> list[str]:
    """Table with a line for each record, under a head; * marks the front of its survey."""
    front = on_front(results.records)
    rows = [_HEAD, *(_row(record, record.key in front) for record in results.records)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEAD))]
    return ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]


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


def comparison(now: Results, then: Results) -> list[str]:
    """Changes for better or worse: over all surveys, then of each, then what could not be compared."""
    found = changes(now, then)
    lines = lines_of(over_surveys(found)) + lines_of(found)
    for keys, where in zip(unpaired(now, then), ("this", "the earlier"), strict=True):
        if keys:
            named = "; ".join(" ".join(key) for key in keys[:_MOST_NAMED])
            lines.append(f"only in {where} result: {len(keys)} records, {named}{'; ...' * (len(keys) > _MOST_NAMED)}")
    return lines


def lines_of(changes: list[Change]) -> list[str]:
    """Lines of text, one for each change."""
    lines = []
    for change in changes:
        why = f": {change.why}" if change.why else ""
        lines.append(f"{' '.join(change.key)}: {change.figure}{_by_how_much(change)} {change.verdict}{why}")
    return lines


def _by_how_much(change: Change) -> str:
    if np.isnan(change.ratio) and np.isnan(change.difference):
        return ""
    if np.isnan(change.difference):
        between = "" if change.interval is None else f" ({change.interval[0]:.3f} to {change.interval[1]:.3f})"
        return f" {change.ratio:.3f}{between}"
    low, high = change.interval or (np.nan, np.nan)
    between = "" if change.interval is None else f" ({100.0 * low:+.2f} to {100.0 * high:+.2f})"
    return f" {100.0 * change.difference:+.2f}{between}{_UNITS[change.kind]}"
