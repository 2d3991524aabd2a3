"""Time budget of a run.

A file of its own: the stages that ask for the time left do not depend on recipes.
"""

from __future__ import annotations

import time
from collections.abc import Callable


class OutOfTimeError(Exception):
    """Optional work would take the time that required work needs."""


class Clock:
    """Counts down from a number of seconds.

    Parameters
    ----------
    gone_s : float
        How long ago the time began [s].
    now : callable
        Seconds that only rise.
    """

    def __init__(self, seconds: float, gone_s: float = 0.0, now: Callable[[], float] = time.monotonic):
        self._now, self._end = now, now() + seconds - gone_s

    @property
    def left_s(self) -> float:
        """Remaining time [s]; negative when it is over."""
        return self._end - self._now()

    def require(self, seconds: float) -> None:
        """Raise where less time is left than the required work takes."""
        if self.left_s < seconds:
            raise OutOfTimeError
