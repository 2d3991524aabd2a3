"""Remaining time: of a step by its own speed, of a run by the speed of its parts.

Nothing is said before it is steady: until a tenth of the work is done, and while estimates of the later half of the
time differ by more than half of the smallest.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

# Of the work, and time [s], before which a pace is too uncertain; largest estimate over smallest that counts as steady.
LEAST_SHARE, _LEAST_S, _STEADY = 0.1, 5.0, 1.5
# Of what a run is expected to take, the share of the parts whose pace is known: photographs that match badly slow down
# the sweep and not the search for features.
_LEAST_TOLD = 0.25
# Estimates that are compared are so long apart [s].
_APART_S = 1.0


class Steady:
    """Test whether successive estimates of one duration agree."""

    def __init__(self) -> None:
        # The last estimate before the middle of the time since the first, and all that follow.
        self._made: deque[tuple[float, float]] = deque()
        self._first: float | None = None

    def add(self, now: float, total_s: float) -> None:
        """Take in an estimate [s] made at a time."""
        self._first = now if self._first is None else self._first
        if len(self._made) > 1 and now - self._made[-1][0] < _APART_S:
            return
        self._made.append((now, total_s))
        _forget(self._made, 0.5 * (self._first + now))

    @property
    def agrees(self) -> bool:
        """Whether those of the later half of the time are alike."""
        values = [total_s for _, total_s in self._made]
        return len(values) > 1 and bool(max(values) <= _STEADY * min(values))


class StepForecast:
    """Progress of a step whose total is known, and its remaining time.

    Parameters
    ----------
    start : float
        Time [s] by a clock that only rises, as all others here.
    """

    def __init__(self, start: float):
        self._start = start
        # When how much was done. Nothing stands for the start: until the first advance a step loads and compiles.
        self._history: deque[tuple[float, float]] = deque()
        self._first_advance = start
        self._steady = Steady()

    def advance(self, now: float, done: float, total: float | None) -> None:
        """Take in that so much of the total is done."""
        if not self._history:
            self._first_advance = now
        self._history.append((now, done))
        _forget(self._history, 0.5 * (self._first_advance + now))
        needed = None if total is None else self._needed(total)
        if needed is not None:
            self._steady.add(now, now - self._first_advance + needed)

    def left_s(self, now: float, total: float | None) -> float | None:
        """Remaining time by the speed over the later half of the time since the first advance [s].

        None before it is steady, and where the step takes longer than the estimate said; 0 where all of it is done.
        """
        if not total or not self._history or not self._steady.agrees:
            return None
        last, done = self._history[-1]
        needed = self._needed(total)
        if needed is None or done < LEAST_SHARE * total or now - self._start < _LEAST_S:
            return None
        left = needed - (now - last)
        if done >= total:
            return 0.0
        return left if left > 0.0 else None

    def _needed(self, total: float) -> float | None:
        """Time [s] from the last advance to the end."""
        (first, done_first), (last, done) = self._history[0], self._history[-1]
        if done <= done_first:
            return None
        return (last - first) * max(total - done, 0.0) / (done - done_first)


def _forget(entries: deque[tuple[float, float]], middle: float) -> None:
    """Keep the last entry before a time, and all that follow."""
    while len(entries) > 2 and entries[1][0] <= middle:
        entries.popleft()


@dataclass
class _Part:
    expected_s: float
    began: float | None = None
    took_s: float | None = None


@dataclass
class Forecast:
    """Forecast of the remaining time of a run."""

    # How many times as long as stated rates say work takes on this machine, until parts of the run tell
    slowdown: float = 1.0
    _parts: dict[str, _Part] = field(default_factory=dict)
    _steady: Steady = field(default_factory=Steady)
    _start: float | None = None
    # Whether a part goes on that nothing is expected of.
    _is_unforeseen: bool = False
    # Whether the part that goes on has told its time by its own pace.
    _tells_itself: bool = False

    def expect(self, expected_s: Mapping[str, float]) -> None:
        """Add parts with their expected time [s], in order; those that have begun keep theirs."""
        begun = {name: part for name, part in self._parts.items() if part.began is not None}
        self._parts = begun | {name: _Part(seconds) for name, seconds in expected_s.items() if name not in begun}

    def join(self, names: Collection[str], name: str, share: float = 1.0) -> None:
        """Replace parts that are worked on at once by one; ``share`` of them is still to be done."""
        found = [each for each in names if each in self._parts]
        if found:
            joined = _Part(share * sum(self._parts[each].expected_s for each in found))
            parts = {(name if key == found[0] else key): part for key, part in self._parts.items()}
            self._parts = {key: part for key, part in parts.items() if key not in found}
            self._parts[name] = joined

    def begin(self, name: str, now: float) -> None:
        """Say that a part begins; parts before it that did not are left out."""
        self._start = now if self._start is None else self._start
        self._is_unforeseen, self._tells_itself = name not in self._parts, False
        if self._is_unforeseen:
            return
        names = list(self._parts)
        for skipped in names[: names.index(name)]:
            if self._parts[skipped].began is None:
                del self._parts[skipped]
        self._parts[name].began = now

    def end(self, name: str, now: float) -> None:
        """Say that a part is done."""
        self._is_unforeseen = self._tells_itself = False
        part = self._parts.get(name)
        if part is not None and part.began is not None:
            part.took_s = now - part.began

    def left_s(self, now: float, of_part_s: float | None = None) -> float | None:
        """Time to the end of the run [s]; None before it is steady.

        ``of_part_s`` is that to the end of the part that goes on, by its own pace. None, too, where that is not known
        and the part was not foreseen, where it takes longer than it should by the pace of the others, and where it goes
        on though all of it is done: what is left would stand still, or grow, while time goes on.
        """
        if self._start is None or not self._parts:
            return None
        if of_part_s == 0.0:
            self._tells_itself = True
            return None
        took, expected, running = 0.0, 0.0, None
        for part in self._parts.values():
            if part.took_s is not None:
                took, expected = took + part.took_s, expected + part.expected_s
            elif part.began is not None:
                running = part
        if running is not None and running.began is not None and of_part_s is not None:
            took, expected = took + now - running.began + of_part_s, expected + running.expected_s
        pace = took / expected if expected > 0.0 else self.slowdown
        left = sum(pace * part.expected_s for part in self._parts.values() if part.began is None)
        if of_part_s is not None:
            left += of_part_s
            self._tells_itself = True
        elif self._tells_itself:
            # It takes longer than it said: by the pace of the others much more may be left.
            return None
        elif running is not None and running.began is not None:
            own = pace * running.expected_s - (now - running.began)
            if own <= 0.0:
                return None
            left += own
        elif self._is_unforeseen:
            return None
        total_s = now - self._start + left
        self._steady.add(now, total_s)
        is_early = now - self._start < max(LEAST_SHARE * total_s, _LEAST_S)
        is_told = expected >= _LEAST_TOLD * sum(part.expected_s for part in self._parts.values())
        return float(left) if is_told and self._steady.agrees and not is_early else None
