"""Water whose level changes with time: a gauge series, and the flat water at the time of each photograph."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any, final

import numpy as np

from refract._numbers import moved
from refract.surfaces import FlatWater


@final
@dataclass(frozen=True, eq=False)
class TidalWater:
    """A level from a gauge, in a right-handed frame with z up.

    Between two readings the level is interpolated linearly. Of a tide with amplitude a and period T, read every dt
    seconds, that misses at most ``a (pi dt / T)^2 / 2``: 0.9 mm per metre of amplitude for 10 minutes and the
    half-daily tide of 12.42 h; 32 mm for hourly readings.

    Parameters
    ----------
    times : (readings,)
        Rising: seconds since any one moment, or numpy datetime64 (which knows no time zone: UTC throughout).
    levels : (readings,) [m], local
        Height z of the water at x, y of `point`.
    point : (2,) [m], local
        Place of the gauge; matters only with slopes.
    n_water, slope_x, slope_y :
        As for `FlatWater`.

    Raises
    ------
    ValueError
        If there are less than two readings, shapes differ, times do not rise, or a reading is not finite.
    """

    times: Any
    levels: Any
    _: KW_ONLY
    point: tuple[float, float] = (0.0, 0.0)
    n_water: Any = 1.333
    slope_x: Any = 0.0
    slope_y: Any = 0.0

    def __post_init__(self):
        times, levels = np.asarray(self.times), np.asarray(self.levels, dtype=np.float64)
        if not np.issubdtype(times.dtype, np.datetime64):
            times = times.astype(np.float64)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "levels", levels)
        if times.ndim != 1 or times.shape != levels.shape or times.size < 2:
            raise ValueError(
                f"expected times and levels (readings,), at least two of each, got {times.shape} and {levels.shape}"
            )
        missing = np.isnat(times) if times.dtype.kind == "M" else ~np.isfinite(times)
        if missing.any() or not np.isfinite(levels).all():
            bad = int(np.flatnonzero(missing | ~np.isfinite(levels))[0])
            raise ValueError(f"expected finite times and levels, got {levels[bad]} m at {times[bad]}; leave it out")
        falls = np.flatnonzero(times[1:] <= times[:-1])
        if falls.size:
            raise ValueError(f"expected rising times, got {times[falls[0]]} before {times[falls[0] + 1]}; sort them")
        self.at(times[0])  # FlatWater checks the other numbers

    def to(self, *place, **options) -> TidalWater:
        """The same series with its tensors moved, by the arguments of `torch.Tensor.to`."""
        return moved(self, place, options)

    def at(self, time) -> FlatWater:
        """The flat water at one time, or at each of several, of the same kind as the times of the readings.

        Parameters
        ----------
        time : number or datetime64, or (...) of them
            Of photographs, say: `trace` and `project` then take one ray, or one row of rays, for each.

        Raises
        ------
        ValueError
            If a time lies outside the readings, or is not of their kind.
        """
        times = np.asarray(time)
        if (self.times.dtype.kind == "M") != (times.dtype.kind == "M"):
            raise ValueError(f"expected times like {self.times[0]!r}, as the readings have, got {time!r}")
        inside = (self.times[0] <= times) & (times <= self.times[-1])
        if not inside.all():
            raise ValueError(
                f"no level at {times[~inside][0]}: the readings run from {self.times[0]} to {self.times[-1]}; "
                "extend the gauge series, a level outside it would be a guess"
            )
        # Seconds since the first reading: dates as they are would round to nanoseconds in 1e18.
        step = np.timedelta64(1, "ns") if self.times.dtype.kind == "M" else 1.0
        level = np.interp((times - self.times[0]) / step, (self.times - self.times[0]) / step, self.levels)
        x, y = self.point
        return FlatWater((x, y, level), n_water=self.n_water, slope_x=self.slope_x, slope_y=self.slope_y)
