"""Tide: a series of gauge readings, and the plane of water at the time of each photograph."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any, final

import numpy as np

from refract._array import as_numpy, namespace
from refract._numbers import hold, in_library, moved, number
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
        Height z of the water at x, y of `point`; a tensor of torch to derive by the readings,
        under `torch.func`, too (for `torch.compile` call `at` before).
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
        times = np.asarray(self.times)
        levels = number(self.levels) if namespace(self.levels).name == "torch" else np.asarray(self.levels, np.float64)
        if not np.issubdtype(times.dtype, np.datetime64):
            times = times.astype(np.float64)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "levels", levels)
        if times.ndim != 1 or times.shape != tuple(levels.shape) or times.size < 2:
            raise ValueError(
                "expected times and levels (readings,), at least two of each, got "
                f"{times.shape} and {tuple(levels.shape)}"
            )
        missing = np.isnat(times) if times.dtype.kind == "M" else ~np.isfinite(times)
        if missing.any() or not hold(np.isfinite, levels):
            bad = int(np.flatnonzero(missing | ~np.isfinite(as_numpy(levels)))[0])
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
        before = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, self.times.size - 2)
        # Differences of dates: as they are they would round to nanoseconds in 1e18.
        share = (times - self.times[before]) / (self.times[before + 1] - self.times[before])
        share = in_library(share, self.levels) if share.ndim else float(share)
        level = self.levels[before] * (1.0 - share) + self.levels[before + 1] * share
        x, y = self.point
        return FlatWater((x, y, level), n_water=self.n_water, slope_x=self.slope_x, slope_y=self.slope_y)
