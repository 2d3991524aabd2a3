"""Two results of the benchmark: what became better or worse beyond noise.

Errors are paired block by block of the plan: both clouds come from the same photographs and share most of their
noise, which leaves the ratio. Times are compared where both were measured on the same machine and often enough. Over
several surveys the ratios of each method are taken together, which judges times that were measured once, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from survey.benchmark.records import Errors, Record, Results

_DRAWS, _SEED = 2000, 20_261_122
_LEVEL = (2.5, 97.5)
# Fewer repeats than this do not show how a time varies; fewer blocks not how an error does.
MIN_REPEATS, MIN_BLOCKS = 3, 10
# Fewer surveys than this are not taken together.
MIN_SURVEYS = 3
ANOTHER_MACHINE = "another machine"
BETTER, WORSE, SAME, UNKNOWN = "better", "worse", "as before", "not judged"


@dataclass(frozen=True)
class Change:
    """One figure of one record, now over then.

    Attributes
    ----------
    key : tuple of str
        Of the record.
    figure : str
    ratio : float
    interval : (low, high) or None
        Of the ratio, 95 %; None where there is too little to tell.
    verdict : "better", "worse", "as before" or "not judged"
    why : str
        Of "not judged".
    """

    key: tuple[str, ...]
    figure: str
    ratio: float
    interval: tuple[float, float] | None
    verdict: str
    why: str = ""


def changes(now: Results, then: Results) -> list[Change]:
    """Time, processor time and error of all records that both have; a cloud that one lacks is a change too."""
    earlier = {record.key: record for record in then.records}
    same_machine = now.machine == then.machine
    found = []
    for record in now.records:
        before = earlier.get(record.key)
        if before is not None:
            found += _of_record(record, before, same_machine)
    return found


def over_surveys(found: list[Change]) -> list[Change]:
    """The changes of each method and figure over all surveys: the geometric mean of their ratios.

    The interval is Student's, of the logarithms: surveys count as drawn from all that could be.
    """
    groups: dict[tuple[tuple[str, ...], str], list[Change]] = {}
    for change in found:
        if np.isfinite(change.ratio) and change.why != ANOTHER_MACHINE:
            groups.setdefault((change.key[1:], change.figure), []).append(change)
    return [_together(key, figure, group) for (key, figure), group in groups.items() if len(group) >= MIN_SURVEYS]


def _together(key: tuple[str, ...], figure: str, group: list[Change]) -> Change:
    logs = np.log([change.ratio for change in group])
    half = student.ppf(0.5 * (1.0 + 0.01 * (_LEVEL[1] - _LEVEL[0])), len(logs) - 1) * logs.std(ddof=1)
    middle, half = float(logs.mean()), float(half) / len(logs) ** 0.5
    interval = (float(np.exp(middle - half)), float(np.exp(middle + half)))
    return Change((f"{len(group)} surveys", *key), figure, float(np.exp(middle)), interval, _verdict(*interval))


def unpaired(now: Results, then: Results) -> tuple[list[tuple[str, ...]], list[tuple[str, ...]]]:
    """Keys of the records that only the one has, and of those that only the other has."""
    ours, theirs = ({record.key for record in results.records} for results in (now, then))
    return sorted(ours - theirs), sorted(theirs - ours)


def _of_record(now: Record, then: Record, same_machine: bool) -> list[Change]:
    if now.errors is None or then.errors is None:
        if (now.errors is None) == (then.errors is None):
            return []
        verdict = WORSE if now.errors is None else BETTER
        return [Change(now.key, "has a cloud", float("nan"), None, verdict)]
    found = [_error(now.key, now.errors, then.errors)]
    for figure in ("wall_s", "processor_s"):
        after, before = (np.array([getattr(cost, figure) for cost in record.costs]) for record in (now, then))
        found.append(_time(now.key, figure, after, before, same_machine))
    return found


def _error(key: tuple[str, ...], now: Errors, then: Errors) -> Change:
    """Root mean square of the inner 90 %, by pairs of blocks that are drawn anew."""
    shared = sorted(now.blocks.keys() & then.blocks.keys())
    ratio = now.error_m / then.error_m
    if len(shared) < MIN_BLOCKS:
        return Change(key, "error", ratio, None, UNKNOWN, f"{len(shared)} blocks in common, expected {MIN_BLOCKS}")
    a, b = (np.array([errors.blocks[name] for name in shared]) for errors in (now, then))
    drawn = np.random.default_rng(_SEED).integers(len(shared), size=(_DRAWS, len(shared)))
    ratios = _rms(a[drawn].sum(axis=1)) / _rms(b[drawn].sum(axis=1))
    return _judged(key, "error", ratio, ratios)


def _rms(sums: np.ndarray) -> np.ndarray:
    return np.sqrt(sums[..., 2] / sums[..., 0])


def _time(key: tuple[str, ...], figure: str, now: np.ndarray, then: np.ndarray, same_machine: bool) -> Change:
    ratio = float(np.median(now) / np.median(then))
    if not same_machine:
        return Change(key, figure, ratio, None, UNKNOWN, ANOTHER_MACHINE)
    if min(len(now), len(then)) < MIN_REPEATS:
        return Change(key, figure, ratio, None, UNKNOWN, f"expected --repeats {MIN_REPEATS} or more in both")
    rng = np.random.default_rng(_SEED)
    a, b = (np.median(values[rng.integers(len(values), size=(_DRAWS, len(values)))], axis=1) for values in (now, then))
    return _judged(key, figure, ratio, a / b)


def _judged(key: tuple[str, ...], figure: str, ratio: float, ratios: np.ndarray) -> Change:
    low, high = (float(v) for v in np.percentile(ratios, _LEVEL))
    return Change(key, figure, ratio, (low, high), _verdict(low, high))


def _verdict(low: float, high: float) -> str:
    return BETTER if high < 1.0 else WORSE if low > 1.0 else SAME
