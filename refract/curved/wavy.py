"""Waves: a sum of sinusoids over a mean plane."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, final

import numpy as np

from refract._array import hold, namespace, number, require_index
from refract.curved.curved_water import CurvedWater


@final
@dataclass(frozen=True)
class WavyWater(CurvedWater):
    """A plane with a sum of sinusoidal waves, in a right-handed frame with z up.

    The surface is ``z = plane + sum_i a_i sin(k_i . (r - r0) + phi_i)``. All numbers may be 0-d tensors, and
    amplitudes, wave vectors and phases tensors of the shapes below: gradients then flow to them, and the rays must be
    tensors, too. Raises ValueError if the numbers of waves differ, the index is outside 1 to 2, or a number is not
    finite. A ray so flat that its first meeting is more than 10 000 steps away counts as one that never meets the
    water.
    """

    point: tuple[Any, Any, Any]  # (3,) [m], local: any point r0 of the mean plane; phases count from there
    amplitudes: Any  # (waves,) [m]: from the mean plane to the crest, half the wave height
    # (waves, 2) [rad/m], local x and y: in the direction of propagation, of length 2 pi over the wavelength
    wave_vectors: Any
    phases: Any = None  # (waves,) [rad]: at the point; zero by default
    _: KW_ONLY
    frequencies: Any = None  # (waves,) [rad/s]: angular; zero by default. Only `at` reads them
    n_water: Any = 1.333  # [-]: refractive index of the water relative to the air above it, at least 1
    # slope_x, slope_y [-]: rise of the mean plane per metre along local x and y
    slope_x: Any = 0.0
    slope_y: Any = 0.0

    def __post_init__(self):
        count = len(self.amplitudes)
        for name in ("phases", "frequencies"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, (0.0,) * count)
        for name in ("point", "amplitudes", "phases", "frequencies"):
            object.__setattr__(self, name, tuple(number(v) for v in getattr(self, name)))
        object.__setattr__(self, "wave_vectors", tuple(tuple(number(v) for v in k) for k in self.wave_vectors))
        for name in ("n_water", "slope_x", "slope_y"):
            object.__setattr__(self, name, number(getattr(self, name)))
        counts = (count, len(self.wave_vectors), len(self.phases), len(self.frequencies))
        if len(set(counts)) != 1 or any(len(k) != 2 for k in self.wave_vectors) or len(self.point) != 3:
            raise ValueError(
                f"expected a point (3,), and amplitudes, phases and frequencies (waves,) with wave vectors (waves, 2), "
                f"got {len(self.point)} coordinates and {counts} amplitudes, wave vectors, phases and frequencies"
            )
        vectors = (v for k in self.wave_vectors for v in k)
        plane = (*self.point, self.n_water, self.slope_x, self.slope_y)
        numbers = (*plane, *self.amplitudes, *vectors, *self.phases, *self.frequencies)
        if not hold(np.isfinite, *numbers):
            raise ValueError(f"expected finite numbers, got {numbers}")
        require_index(self.n_water)

    def _waves(self):
        return zip(self.amplitudes, self.wave_vectors, self.phases, strict=True)

    def at(self, time) -> WavyWater:
        """The waves ``time`` [s] later: each phase reduced by its frequency times the time."""
        phases = tuple(p - w * time for p, w in zip(self.phases, self.frequencies, strict=True))
        return replace(self, phases=phases)

    def _offsets(self, x, y):
        """x, y from the point, in float64: a kilometre away the phase of a ripple has five digits before the point."""
        xp = namespace(x, y)
        return xp.double(x) - self.point[0], xp.double(y) - self.point[1]

    def height(self, x, y):
        """Height z of the surface [m] at local x, y [m]."""
        xp, (rx, ry) = namespace(x, y), self._offsets(x, y)
        z = self.point[2] + self.slope_x * rx + self.slope_y * ry
        for amplitude, (kx, ky), phase in self._waves():
            z = z + amplitude * xp.sin(kx * rx + ky * ry + phase)
        return xp.like(z, x)

    def gradient(self, x, y) -> tuple[Any, Any]:
        """Slopes of the surface along x and y [-] at local x, y [m]."""
        xp, (rx, ry) = namespace(x, y), self._offsets(x, y)
        zx, zy = self.slope_x + rx * 0.0, self.slope_y + rx * 0.0
        for amplitude, (kx, ky), phase in self._waves():
            cosine = amplitude * xp.cos(kx * rx + ky * ry + phase)
            zx, zy = zx + kx * cosine, zy + ky * cosine
        return xp.like(zx, x), xp.like(zy, x)

    def hessian(self, x, y) -> tuple[Any, Any, Any]:
        """Second derivatives xx, xy, yy of the height [1/m]."""
        xp, (rx, ry) = namespace(x, y), self._offsets(x, y)
        zxx = zxy = zyy = rx * 0.0
        for amplitude, (kx, ky), phase in self._waves():
            sine = amplitude * xp.sin(kx * rx + ky * ry + phase)
            zxx, zxy, zyy = zxx - kx * kx * sine, zxy - kx * ky * sine, zyy - ky * ky * sine
        return zxx, zxy, zyy

    def curvature(self, dx, dy) -> Any:
        """A bound of the second derivative of the height [1/m] along (dx, dy): the sum over all waves."""
        return sum(abs(a) * (kx * dx + ky * dy) ** 2 for a, (kx, ky), _ in self._waves())

    def span(self, origin, direction) -> tuple[Any, Any]:
        """Distances [m] along rays where they fall below all crests and where they rise above these; NaN if never."""
        xp = namespace(*origin)
        crest = sum(abs(a) for a in self.amplitudes)
        rx, ry = self._offsets(*origin[:2])
        over = origin[2] - self.point[2] - self.slope_x * rx - self.slope_y * ry
        rate = direction[2] - self.slope_x * direction[0] - self.slope_y * direction[1]
        reached = (crest - over) / xp.where(rate == 0.0, rate * 0.0 + 1.0, rate)
        start = xp.where(over > crest, xp.where(rate < 0.0, reached, math.nan), over * 0.0)
        return tuple(map(xp.fixed, (start, xp.where(rate > 0.0, reached, math.inf))))
