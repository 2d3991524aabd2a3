"""Waves: a sum of sinusoids over a mean plane."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, final

import numpy as np

from refract import kernels
from refract._array import namespace
from refract._implicit import along_ray
from refract._numbers import hold, moved, number, plain, read, require_index
from refract._solvers import solved, solver
from refract.curved import fermat
from refract.curved._disc import Bounds

# The most steps along a ray to its first intersection with the waves: usual are 4 to 8; at 89.9 deg to the vertical
# over waves of slope 0.3 some 40, and 130 at worst. A ray that needs this many runs along the surface.
_MOST_STEPS = 10_000
# Steps between checks for rays that have not arrived.
_ROUND = 4
# A step below this part of the distance has reached its rounding.
_TINY = 4 * float(np.finfo(np.float64).eps)
# A leg has reached the crossing when this part of it remains: roots are accurate to 1e-14 of it, near tangency 1e-8.
_ARRIVED = 1e-7


@solved
@final
@dataclass(frozen=True)
class WavyWater:
    """A plane with a sum of sinusoidal waves, in a right-handed frame with z up.

    The surface is ``z = plane + sum_i a_i sin(k_i . (r - r0) + phi_i)``.
    All numbers may be 0-d tensors or Dr.Jit scalars, and amplitudes, wave vectors and phases tensors of the shapes
    below: gradients then flow to them, and the rays must come from the same library.

    Parameters
    ----------
    point : (3,) [m], local
        Any point r0 of the mean plane; phases count from there.
    amplitudes : (waves,) [m]
        From the mean plane to the crest: half the wave height.
    wave_vectors : (waves, 2) [rad/m], local x and y
        In the direction of propagation, of length 2 pi over the wavelength.
    phases : (waves,) [rad]
        At the point; zero by default.
    frequencies : (waves,) [rad/s]
        Angular; zero by default. Only `at` reads them.
    n_water : [-]
        Refractive index of the water relative to the air above it, at least 1.
    slope_x, slope_y : [-]
        Rise of the mean plane per metre along local x and y.

    Raises
    ------
    ValueError
        If the numbers of waves differ, the index is outside 1 to 2, or a number is not finite.

    Notes
    -----
    A ray so flat that its first meeting is more than 10 000 steps away counts as one that never meets the water.
    """

    point: tuple[Any, Any, Any]
    amplitudes: Any
    wave_vectors: Any
    phases: Any = None
    _: KW_ONLY
    frequencies: Any = None
    n_water: Any = 1.333
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
        if not hold(np.isfinite, *self.numbers):
            raise ValueError(f"expected finite numbers, got {self.numbers}")
        require_index(self.n_water)

    def to(self, *place, **options) -> WavyWater:
        """The same water with its tensors moved, by the arguments of `torch.Tensor.to`."""
        return moved(self, place, options)

    @property
    def numbers(self) -> tuple:
        """All numbers of the waves in one row."""
        vectors = (v for k in self.wave_vectors for v in k)
        own = (self.n_water, self.slope_x, self.slope_y)
        return (*self.point, *own, *self.amplitudes, *vectors, *self.phases, *self.frequencies)

    @classmethod
    def from_numbers(cls, *numbers) -> WavyWater:
        """The waves with these `numbers`."""
        x, y, z, n_water, slope_x, slope_y, *coefficients = numbers
        waves = len(coefficients) // 5
        amplitudes, kx_ky, phases, frequencies = (
            coefficients[:waves],
            coefficients[waves : -2 * waves],
            coefficients[-2 * waves : -waves],
            coefficients[-waves:],
        )
        return cls(
            (x, y, z), amplitudes, tuple(zip(kx_ky[::2], kx_ky[1::2], strict=True)), phases,
            frequencies=frequencies, n_water=n_water, slope_x=slope_x, slope_y=slope_y,
        )  # fmt: skip

    def _waves(self):
        return zip(self.amplitudes, self.wave_vectors, self.phases, strict=True)

    def at(self, time) -> WavyWater:
        """The waves ``time`` [s] later: each phase reduced by its frequency times the time."""
        phases = tuple(p - w * time for p, w in zip(self.phases, self.frequencies, strict=True))
        return replace(self, phases=phases)

    def detached(self) -> WavyWater:
        """The same water in plain numbers, without gradients."""
        return WavyWater.from_numbers(*map(plain, self.numbers))

    def derivatives(self, x, y) -> tuple:
        """Height [m], slopes along x and y [-] and second derivatives xx, xy, yy [1/m] at local x, y [m]."""
        xp = namespace(x, y)
        rx, ry = x - self.point[0], y - self.point[1]
        z = self.point[2] + self.slope_x * rx + self.slope_y * ry
        zx, zy, zxx, zxy, zyy = self.slope_x, self.slope_y, 0.0, 0.0, 0.0
        for amplitude, (kx, ky), phase in self._waves():
            angle = kx * rx + ky * ry + phase
            sine, cosine = amplitude * xp.sin(angle), amplitude * xp.cos(angle)
            z, zx, zy = z + sine, zx + kx * cosine, zy + ky * cosine
            zxx, zxy, zyy = zxx - kx * kx * sine, zxy - kx * ky * sine, zyy - ky * ky * sine
        return z, zx, zy, zxx, zxy, zyy

    def height(self, x, y):
        """Height z of the surface [m] at local x, y [m]."""
        xp = namespace(x, y)
        return xp.like(self.derivatives(xp.double(x), xp.double(y))[0], x)

    def normal(self, x, y) -> tuple[Any, Any, Any]:
        """Unit normal of the surface at x, y, pointing up into the air."""
        xp = namespace(x, y)
        # In float64: a kilometre away the phase of a ripple has five digits before the point.
        _, zx, zy, *_ = self.derivatives(xp.double(x), xp.double(y))
        up = 1.0 / xp.sqrt(1.0 + zx * zx + zy * zy + x * 0.0)  # the shape of x also where there are no waves
        return tuple(xp.like(c, x) for c in (-zx * up, -zy * up, up))

    def bounds(self, x, y, radius) -> Bounds:
        """Bounds over a disc; slope and curvature are those of the whole sea."""
        crest = sum(abs(a) for a in self.amplitudes)
        tilt = (self.slope_x * self.slope_x + self.slope_y * self.slope_y) ** 0.5
        steep = sum(abs(a) * (kx * kx + ky * ky) ** 0.5 for a, (kx, ky), _ in self._waves())
        curved = sum(abs(a) * (kx * kx + ky * ky) for a, (kx, ky), _ in self._waves())
        mean = self.point[2] + self.slope_x * (x - self.point[0]) + self.slope_y * (y - self.point[1])
        return Bounds(mean - crest - tilt * radius, mean + crest + tilt * radius, steep + tilt, curved)

    def anchor(self) -> tuple:
        """Some x, y where the surface is defined."""
        return plain(self.point[0]), plain(self.point[1])

    def intersect(self, origin, direction):
        """Distance [m] to the first meeting with the waves along unit rays from above; NaN where there is none."""
        like = origin[0] + direction[0]
        origin, direction = fermat.together(origin, direction)
        xp = namespace(*origin)
        if xp.name == "drjit":
            start, ray = (tuple(map(xp.fixed, v)) for v in (origin, direction))
            t = self.detached()._first_meeting(start, ray, side=1.0)
        else:
            (t,) = read(first_meeting, self, origin + direction)
        meets = t >= 0.0
        t = along_ray(lambda t: self._clearance(origin, direction, t), xp.where(meets, t, 0.0), meets)
        return xp.like(xp.where(meets, xp.maximum(t, 0.0), math.nan), like)

    def _clearance(self, origin, direction, t):
        """Height [m] of a ray above the waves at distance t, and its rate [-]."""
        x, y = (o + t * d for o, d in zip(origin[:2], direction[:2], strict=True))
        z, zx, zy, *_ = self.derivatives(x, y)
        return origin[2] + t * direction[2] - z, direction[2] - zx * direction[0] - zy * direction[1]

    def _first_meeting(self, origin, direction, side):
        """Distance to the first root of the clearance along rays from above (side 1) or below (-1); no gradients.

        Between crest and trough level the clearance g obeys ``g(t + s) >= g + g' s - M s^2 / 2``, with M the sum of
        ``|a| (k . d)^2``. A step to the root of that parabola never passes a root of g, and near one it is Newton's.
        """
        xp = namespace(*origin)
        crest = sum(abs(a) for a in self.amplitudes)
        bend = sum(abs(a) * (kx * direction[0] + ky * direction[1]) ** 2 for a, (kx, ky), _ in self._waves())
        bend = bend + origin[0] * 0.0
        rate = side * (direction[2] - self.slope_x * direction[0] - self.slope_y * direction[1])
        over = origin[2] - self.point[2]
        for slope, o, p in zip((self.slope_x, self.slope_y), origin, self.point, strict=False):
            over = over - slope * (o - p)
        over = side * over
        level = xp.where(rate == 0.0, rate * 0.0 + 1.0, rate)
        start = xp.where(over > crest, xp.where(rate < 0.0, (crest - over) / level, float("nan")), over * 0.0)
        end = xp.where(rate > 0.0, (crest - over) / level, float("inf"))  # where a rising ray leaves the waves
        if xp.name == "numpy":
            return self._marched(origin, direction, start, end, bend, side)
        import drjit

        t, active = start, start >= 0.0
        for _ in range(_MOST_STEPS // _ROUND):
            t, active = self._round((origin, direction), t, end, bend, side, active)
            drjit.eval(t, active)
            if not drjit.any(active):
                break
        return xp.where(active, float("nan"), t)

    def _marched(self, origin, direction, start, end, bend, side):
        """The rounds of `_first_meeting` in numpy, each for the rays that are still under way."""
        shape = np.shape(start)
        origin, direction = (tuple(np.broadcast_to(c, shape).ravel() for c in v) for v in (origin, direction))
        t, end, bend = np.array(start).ravel(), np.ravel(end), np.ravel(bend)
        left = np.flatnonzero(t >= 0.0)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # a ray that rises from flat water
            for _ in range(_MOST_STEPS // _ROUND):
                if left.size == 0:
                    break
                o, d = (tuple(c[left] for c in v) for v in (origin, direction))
                t[left], active = self._round((o, d), t[left], end[left], bend[left], side, np.ones(left.size, bool))
                left = left[active]
        t[left] = np.nan
        return t.reshape(shape)

    def _round(self, ray, t, end, bend, side, active):
        """A few steps, for the rays (origin, direction) that are going; a ray that has left the waves is NaN."""
        xp, (origin, direction) = namespace(t), ray
        for _ in range(_ROUND):
            clearance, rate = self._clearance(origin, direction, t)
            clearance, rate = side * clearance, side * rate
            root = xp.sqrt(rate * rate + 2.0 * bend * xp.maximum(clearance, 0.0))
            step = xp.where(rate < 0.0, 2.0 * clearance / (root - rate), (rate + root) / bend)
            active = active & (clearance > 0.0)
            t = xp.where(active, t + step, t)
            active = active & (step > _TINY * t)
            gone = active & (t > end)
            t, active = xp.where(gone, float("nan"), t), active & ~gone
        return t, active

    def clear(self, camera, crossing, point):
        """True where neither leg meets the waves before the crossing (numpy)."""
        clear = np.ones(np.shape(crossing[0]), dtype=bool)
        for end, side in ((camera, 1.0), (point, -1.0)):
            leg = kernels.minus(crossing, end)
            length = np.sqrt(kernels.dot(leg, leg))
            first = self._first_meeting(end, tuple(w / length for w in leg), side)
            clear &= ~(first < length * (1.0 - _ARRIVED))
        return clear

    def crossing(self, camera, point, steps: int):
        """See `WaterSurface.crossing`: all stationary paths are counted, the shortest taken (`fermat`)."""
        return fermat.crossing(self, camera, point)


@solver(outputs=1)
def first_meeting(water: WavyWater, *ends):
    """Distance [m] to the first meeting of rays from above with the waves, in numpy: see `WavyWater.intersect`."""
    return (water._first_meeting(ends[:3], ends[3:], 1.0),)
