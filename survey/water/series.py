"""The level at a moment from a series of readings: readings that are no levels left out, and what a gap costs.

A reading, or a run of a few, that the readings on both sides contradict is no level of this water; nor is a number that
services write for none and that lies far from the others. Between readings the level is a straight line, whose standard
deviation is that of a parabola with the curvature of the series; between high and low waters it is half a cosine.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import pairwise

import numpy as np

from evaluation.summary import std_by_median
from survey.display.quantities import length, named
from survey.errors import ConfigError, Findings
from survey.settings.config import MOST_RATE_M_PER_H
from survey.water.gauge_files import Reading, Series

# Contradicted beyond this many standard deviations, of the stated one or of the scatter of the series if larger.
_CONTRADICTED = 5.0
# Noise of a reading against the line through two neighbours, over that against the cubic through four: sqrt(5 / 1.94).
_OF_A_LINE = 1.6
# Readings in a run at most (more may be a seiche or a wake), and the share of readings that may be left out.
_LONGEST_RUN, _MOST_LEFT_OUT = 3, 0.1
# Readings farther from the flight than three tides [h] say nothing of it, nor do more than so many on each side.
_AROUND_H, _MOST_ON_A_SIDE = 37.2, 500
# Least distance [m] of a number for no data from all other levels; it is also farther than their range.
_LEAST_FAR_M = 0.25
# Of the main tide, the principal lunar semidiurnal M2: period [h].
_TIDE_H = 12.42
# Intervals of high and low waters [h]: 6.2 by M2, 12.4 by diurnal tides, less and more by inequality and shallows.
_EXTREMES_H = (3.0, 15.0)
# Standard deviation of half a cosine between them, as a share of their difference: the overtide M4 of shallow seas.
_COSINE = 0.05
# Longer intervals [h] of a series that does not show its curvature are named: a tide of 1 m departs by 3 cm in them.
_LONG_H = 1.0


def levels_at(series: Series, moments: np.ndarray) -> tuple[np.ndarray, float, tuple[Reading, ...], Findings]:
    """Levels (N,) [m] at moments (N,) [s since 1970] by a series, and its readings around them.

    With what interpolation adds to the standard deviation [m] of the mean level.
    """
    path, near = series.path, _near(series.readings, float(moments.min()), float(moments.max()))
    readings, left_out = without_markers(near)
    times, levels, stds = _columns(readings)
    is_of_extremes = series.is_of_extremes or are_extremes(times, levels)
    if not is_of_extremes:
        wrong = contradicted(times, levels, stds)
        left_out += [readings[i] for i in np.flatnonzero(wrong)]
        readings = tuple(readings[i] for i in np.flatnonzero(~wrong))
        times, levels, stds = times[~wrong], levels[~wrong], stds[~wrong]
    parts = [f"{each.line} ({each.text} at {each.time:%d %b %H:%M})" for each in left_out]
    warnings = named(parts, "reading", f"of {path.name} that the others contradict, left out")
    if len(left_out) > _MOST_LEFT_OUT * len(near) and sum(not each.is_marker for each in left_out) > 1:
        raise ConfigError(f"{warnings[0]}; they are too many for a series of one water: correct {path}")
    hours = moments / 3600.0
    first, last = hours.min(), hours.max()
    if len(times) < 2 or first < times[0] or last > times[-1]:
        covered = f"runs from {_shown(times[0])} to {_shown(times[-1])}" if len(times) else "has no level"
        raise ConfigError(
            f"{path} {covered}, but images were taken from {_shown(first)} to {_shown(last)}; add the readings "
            f"around the flight{''.join(f'; {text}' for text in warnings)}"
        )
    require_slow(readings)
    i = np.clip(np.searchsorted(times, hours, side="right") - 1, 0, len(times) - 2)
    before, after = hours - times[i], times[i + 1] - hours
    if is_of_extremes:
        rise, share = levels[i + 1] - levels[i], before / (before + after)
        at = levels[i] + rise * 0.5 * (1.0 - np.cos(np.pi * share))
        note = f"{path.name} has high and low waters alone: the level between them is half a cosine"
        return at, _COSINE * float(np.abs(rise).max()), readings, Findings((note,), tuple(warnings))
    longest = float((before + after).max())
    bend, is_known = curvature(times, levels, stds, longest)
    std = float(np.mean(0.5 * before * after)) * bend
    if std > float(np.median(stds)) or not (is_known or longest <= _LONG_H):
        j = int(i[np.argmax(before + after)])
        by = "by the curvature of the series" if is_known else "by the tide that their difference may be a part of"
        warnings.append(
            f"the readings of {path.name} around the flight are {longest:.2g} h apart ({_shown(times[j])}, "
            f"{readings[j].line}, to {_shown(times[j + 1])}): the level between them is known to "
            f"{length(std)} {by}; add readings during the flight"
        )
    return np.interp(hours, times, levels), std, readings, Findings(warnings=tuple(warnings))


def _columns(readings: Sequence[Reading]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [h since 1970], levels and stds [m], (N,) each."""
    rows = [(each.time.timestamp() / 3600.0, each.level_m, each.std_m) for each in readings]
    times, levels, stds = np.array(rows).reshape(-1, 3).T
    return times, levels, stds


def _near(readings: tuple[Reading, ...], first: float, last: float) -> tuple[Reading, ...]:
    """Readings around a flight from one moment to another [s since 1970]."""
    times = [each.time.timestamp() for each in readings]
    margin = 3600.0 * _AROUND_H
    low = max(bisect_left(times, first - margin), bisect_left(times, first) - _MOST_ON_A_SIDE)
    high = min(bisect_right(times, last + margin), bisect_right(times, last) + _MOST_ON_A_SIDE)
    # One on each side at least, however far.
    low, high = min(low, bisect_right(times, first) - 1), max(high, bisect_left(times, last) + 1)
    return readings[max(low, 0) : high]


def without_markers(readings: tuple[Reading, ...]) -> tuple[tuple[Reading, ...], list[Reading]]:
    """Readings without the numbers for no data among them, and these: far from all levels that are none."""
    levels = np.array([each.level_m for each in readings if not each.is_marker])
    if not len(levels):
        return readings, []
    far = max(_LEAST_FAR_M, float(np.ptp(levels)))
    left = [each for each in readings if each.is_marker and np.abs(levels - each.level_m).min() > far]
    return tuple(each for each in readings if each not in left), left


def contradicted(times: np.ndarray, levels: np.ndarray, stds: np.ndarray) -> np.ndarray:
    """Mask (N,) of readings at times (N,) [h] that those before and after contradict."""
    keep = np.arange(len(times))
    for size in range(1, _LONGEST_RUN + 1):
        while len(keep) > size + 3:
            residuals, sides = _run_residuals(times[keep], levels[keep], size)
            # At a step one side contradicts alone.
            one_sign = (np.sign(np.hstack([residuals, sides])) == np.sign(residuals[:, :1])).all(axis=1)
            least = np.minimum(np.abs(residuals).min(axis=1), np.abs(sides).min(axis=1) / _OF_A_LINE)
            least = np.where(one_sign, least, 0.0)
            worst = int(np.argmax(least))
            rest = np.delete(keep, np.arange(worst + 1, worst + 1 + size))
            # The scatter of the series without the run, which would hide itself among few readings.
            scatter = float(std_by_median(_run_residuals(times[rest], levels[rest], 1)[0]))
            if not least[worst] > _CONTRADICTED * max(scatter, float(np.median(stds[keep]))):
                break
            keep = rest
    if len(keep) > 4:
        # An end has one side alone, whose line has the scatter of all such lines.
        _, sides = _run_residuals(times[keep], levels[keep], 1)
        scatter = max(float(std_by_median(sides)), _OF_A_LINE * float(np.median(stds[keep])))
        for end, near in ((0, [1, 2]), (-1, [-2, -3])):
            at = _through(times[keep[near]][None], levels[keep[near]][None], times[keep[[end]]])
            if abs(levels[keep[end]] - at[0]) > _CONTRADICTED * scatter:
                keep = np.delete(keep, end)
    return ~np.isin(np.arange(len(times)), keep)


def _run_residuals(times: np.ndarray, levels: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (M, size) of runs of readings, which begin at the second one, the third and so on, and (M, 2) of sides.

    Those of the run count from the cubic through two readings on each side, at the ends of the series through three;
    those of the sides are of the first reading from the line through those before it, and of the last from those after.
    """
    starts, last = np.arange(1, len(times) - size), len(times) - size - 1
    residuals, sides = np.empty((len(starts), size)), np.empty((len(starts), 2))
    for of_group, before, after in (
        (starts == 1, (-1,), (0, 1)),
        (starts == last, (-2, -1), (0,)),
        ((starts > 1) & (starts < last), (-2, -1), (0, 1)),
    ):
        first = starts[of_group][:, None]
        left, right = first + np.array(before), first + size + np.array(after)
        around = np.hstack([left, right])
        for j in range(size):
            run = first[:, 0] + j
            residuals[of_group, j] = levels[run] - _through(times[around], levels[around], times[run])
        for j, (side, run) in enumerate(((left, first[:, 0]), (right, first[:, 0] + size - 1))):
            sides[of_group, j] = levels[run] - _through(times[side], levels[side], times[run])
    return residuals, sides


def _through(x: np.ndarray, y: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values (M,) at places (M,) of the polynomials through K points each, (M, K) (Lagrange)."""
    others = [[j for j in range(x.shape[1]) if j != i] for i in range(x.shape[1])]
    weights = [np.prod((at[:, None] - x[:, j]) / (x[:, [i]] - x[:, j]), axis=1) for i, j in enumerate(others)]
    return np.asarray(np.sum(np.stack(weights, axis=1) * y, axis=1))


def require_levels(readings: Sequence[Reading]) -> None:
    """Raise ConfigError where one of the levels of photographs, in their order, is none, by those before and after."""
    kept, wrong = without_markers(tuple(readings))
    _, levels, stds = _columns(kept)
    # Photographs of a burst have one time.
    wrong += [kept[i] for i in np.flatnonzero(contradicted(np.arange(len(kept), dtype=np.float64), levels, stds))]
    if wrong:
        more = f", and so are {len(wrong) - 1} others" if len(wrong) > 1 else ""
        raise ConfigError(
            f"{wrong[0].where}: the level {wrong[0].text} is contradicted by those of the photographs before and after"
            f"{more}; correct it, or leave the photograph out"
        )


def are_extremes(times: np.ndarray, levels: np.ndarray) -> bool:
    """Whether readings at times (N,) [h] are high and low waters alone: they rise and fall in turn, hours apart."""
    steps, hours = np.diff(levels), np.diff(times)
    alternates = len(levels) > 2 and (steps[1:] * steps[:-1] < 0.0).all()
    return bool(alternates and ((hours > _EXTREMES_H[0]) & (hours < _EXTREMES_H[1])).all())


def require_slow(readings: tuple[Reading, ...]) -> None:
    """Raise ConfigError where readings in turn differ by more than water can rise between them."""
    for one, other in pairwise(readings):
        hours = (other.time - one.time).total_seconds() / 3600.0
        most = MOST_RATE_M_PER_H * hours + 2.0 * _CONTRADICTED * max(one.std_m, other.std_m)
        if abs(other.level_m - one.level_m) > most:
            raise ConfigError(
                f"{other.where}: the level is {other.text} after {one.text} {60.0 * hours:.2g} minutes before "
                f"({one.line}), faster than water rises ({MOST_RATE_M_PER_H:g} m/h); correct or remove the line that "
                "is wrong"
            )


def curvature(times: np.ndarray, levels: np.ndarray, stds: np.ndarray, hours: float) -> tuple[float, bool]:
    """Curvature [m/h2] (rms) of a series over intervals of so many hours, and whether its readings show it.

    By second differences at that distance, less what the stds of readings explain; else that of a tide whose rate is
    the largest of the series.
    """
    before = np.searchsorted(times, times - 0.5 * hours, side="right") - 1
    after = np.searchsorted(times, times + 0.5 * hours, side="left")
    k = np.flatnonzero((before >= 0) & (after < len(times)))
    k = k[times[after[k]] - times[before[k]] <= 4.0 * hours]
    p, n = before[k], after[k]
    if not len(k):
        # A difference within the noise of readings may be so large.
        rate = float((np.maximum(np.abs(np.diff(levels)), np.hypot(stds[1:], stds[:-1])) / np.diff(times)).max())
        return 2.0 * np.pi / _TIDE_H * rate, False
    share = (times[k] - times[p]) / (times[n] - times[p])
    departure = levels[k] - (1.0 - share) * levels[p] - share * levels[n]
    noise = stds[k] ** 2 + ((1.0 - share) * stds[p]) ** 2 + (share * stds[n]) ** 2
    squares = 4.0 * (departure**2 - noise) / ((times[k] - times[p]) * (times[n] - times[k])) ** 2
    return float(np.sqrt(max(np.mean(squares), 0.0))), True


def _shown(hours: float) -> str:
    return f"{datetime.fromtimestamp(3600.0 * hours, UTC):%Y-%m-%d %H:%M:%S} UTC"
