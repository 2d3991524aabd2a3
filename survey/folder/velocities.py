"""Velocity of the camera at each photograph: by XMP, positions and times, or survey.toml."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from survey.photos.exif import Exif

# Where a velocity comes from, the most certain first.
BY_XMP, BY_TIMES, BY_SETTINGS = "XMP", "positions and times", "survey.toml"
# Photographs farther apart in time are not of one flight line [s].
_LONGEST_S = 60.0
# On a flight line, what one way to the next photograph has of its velocity differs from the next by at most this
# share: 20 degrees of direction, or what a clock of whole seconds adds to some seconds.
_SAME_LINE = 0.35


@dataclass(frozen=True, eq=False)
class Velocity:
    """Velocity of the camera at one photograph.

    Attributes
    ----------
    local : (3,) float64 [m/s], local
    source : str
        `BY_XMP`, `BY_TIMES` or `BY_SETTINGS`.
    """

    local: np.ndarray
    source: str

    @property
    def speed(self) -> float:
        """[m/s]."""
        return float(np.linalg.norm(self.local))


def velocities_of(
    places: Mapping[str, np.ndarray], heads: Mapping[str, Exif], speed_m_s: float | None
) -> dict[str, Velocity]:
    """Velocities of the photographs of which anything tells them.

    Parameters
    ----------
    places : name to (3,) [m], local
        Of the cameras.
    heads : name to Exif
    speed_m_s : float or None
        Along the flight lines, where neither XMP nor times tell it; the order is that of times, else of names.
    """
    found = velocities_by_xmp({name: heads[name] for name in places})
    if len(found) == len(places):
        return found
    seconds = _seconds(heads, places)
    for name, local in _along_lines(places, seconds, None).items():
        found.setdefault(name, Velocity(local, BY_TIMES))
    if speed_m_s is not None:
        order = seconds if len(seconds) == len(places) else {name: float(i) for i, name in enumerate(sorted(places))}
        for name, local in _along_lines(places, order, speed_m_s).items():
            found.setdefault(name, Velocity(local, BY_SETTINGS))
    return found


def velocities_by_xmp(heads: Mapping[str, Exif]) -> dict[str, Velocity]:
    """Velocities in XMP. True east and north are those of local to some thousandths."""
    return {
        name: Velocity(np.array(head.motion.speed), BY_XMP)
        for name, head in heads.items()
        if head.motion.speed is not None
    }


def _seconds(heads: Mapping[str, Exif], places: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Seconds since the first photograph, by one clock: the camera's, or where fewer have that, UTC."""
    clocks = [
        {name: time for name in places if (time := getattr(heads[name], clock)) is not None}
        for clock in ("clock", "taken")
    ]
    times = max(clocks, key=len)
    first = min(times.values(), default=None)
    return {} if first is None else {name: (time - first).total_seconds() for name, time in times.items()}


def _along_lines(
    places: Mapping[str, np.ndarray], seconds: Mapping[str, float], speed_m_s: float | None
) -> dict[str, np.ndarray]:
    """Velocities (3,) [m/s] of the photographs on flight lines: from the one before to the one after.

    At the end of a line the side counts on which the line goes on; where none or both do, at a turn, a photograph has
    no velocity. A speed replaces that of positions and times, so that only their order counts.
    """
    names = sorted(seconds, key=lambda name: (seconds[name], name))
    if len(names) < 3:
        return {}
    steps = np.diff([places[name] for name in names], axis=0)
    times = np.diff([seconds[name] for name in names])
    linked = (times > 0.0) & (times <= _LONGEST_S)
    rates = steps / np.where(linked, times, 1.0)[:, None]
    if speed_m_s is not None:
        linked = np.linalg.norm(steps, axis=1) > 0.0
        rates = speed_m_s * steps / np.where(linked, np.linalg.norm(steps, axis=1), 1.0)[:, None]
    lengths = np.linalg.norm(rates, axis=1)
    apart = np.linalg.norm(np.diff(rates, axis=0), axis=1)
    # Of the photographs but the first and the last: whether they lie on a line.
    inside = linked[:-1] & linked[1:] & (apart <= _SAME_LINE * np.maximum(lengths[:-1], lengths[1:]))
    found: dict[str, np.ndarray] = {}
    for i, name in enumerate(names):
        if 0 < i < len(names) - 1 and inside[i - 1]:
            shares = np.array([1.0, 1.0]) if speed_m_s is not None else times[i - 1 : i + 1]
            found[name] = shares @ rates[i - 1 : i + 1] / shares.sum()
            continue
        comes, goes = i > 1 and inside[i - 2], i < len(names) - 2 and inside[i]
        if comes != goes:
            found[name] = rates[i - 1] if comes else rates[i]
    return found
