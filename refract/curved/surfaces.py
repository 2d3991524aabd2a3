"""Waves, a sum of sinusoids over a mean plane; and a measured surface of bicubic pieces, with a continuous normal."""

from __future__ import annotations

import math
import sys
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Any, final

import numpy as np

from refract._array import as_like, as_numpy, hold, namespace, number, require_index, transformed
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


# No piece is higher or lower than its sixteen nodes by more than this part of their range: along one axis the weights
# below zero sum to -1/8 at most.
_OVERSHOOT = 9.0 / 32.0
_ON_EDGE = 1e-9  # A place this far beyond the nodes, as part of their spacing, is on the edge
_MOST_NODES = 250_000  # Nodes through scattered points at most


@final
@dataclass(frozen=True, eq=False)
class BicubicWater(CurvedWater):
    """Cubic pieces (Catmull and Rom's) between the nodes of an even raster, in a right-handed frame with z up.

    Heights pass through the nodes, and slopes are continuous. Over a spacing s, of a smooth surface, heights are good
    to the third power of s and slopes to the second. numpy and torch. Raises ValueError if shapes do not fit, a height
    is not finite, the spacing not positive, or the index outside 1 to 2.
    """

    corner: tuple[float, float]  # [m], local: x and y of the node ``heights[0, 0]``
    spacing: float  # [m]: between nodes, along x and y
    # (rows, columns) [m], local: at the nodes, x along columns; at least 3 by 3. A tensor lets gradients flow to them.
    # Beyond the nodes there is no water
    heights: Any
    _: KW_ONLY
    n_water: Any = 1.333  # [-]: refractive index of the water relative to the air above it, at least 1

    def __post_init__(self):
        shape = tuple(np.shape(self.heights))
        if len(shape) != 2 or min(shape) < 3 or len(self.corner) != 2:
            raise ValueError(f"expected heights (rows, columns), at least 3 each, and a corner (2,), got {shape}")
        if not hold(lambda v: np.isfinite(v) & (v > 0.0), self.spacing):
            raise ValueError(f"expected a positive spacing, got {self.spacing}")
        object.__setattr__(self, "n_water", number(self.n_water))
        require_index(self.n_water)
        if namespace(self.heights).name == "numpy":
            object.__setattr__(self, "heights", np.asarray(self.heights, dtype=np.float64))
        if not hold(np.isfinite, self.heights):
            raise ValueError(f"expected finite heights, got {int((~np.isfinite(as_numpy(self.heights))).sum())} others")

    @classmethod
    def from_points(cls, points, heights, *, n_water=1.333) -> BicubicWater:
        """Water through scattered points (points, 2) [m], local, of heights (points,) [m].

        The nodes are as far apart as the points are, and interpolated linearly; beyond the points as at the nearest.
        Raises ValueError if the points are fewer than three, on one line, or not finite.
        """
        from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
        from scipy.spatial import Delaunay, KDTree, QhullError

        points, heights = np.asarray(points, dtype=np.float64), np.asarray(heights, dtype=np.float64)
        try:
            inside = LinearNDInterpolator(Delaunay(points), heights)
        except (QhullError, ValueError) as error:
            raise ValueError(f"expected three points or more, finite and not on one line, got {len(points)}") from error
        low, size = points.min(axis=0), np.ptp(points, axis=0)
        apart = float(np.median(KDTree(points).query(points, k=2)[0][:, 1]))
        spacing = max(apart, math.sqrt(float(np.prod(size)) / _MOST_NODES))
        columns, rows = np.maximum(np.ceil(size / spacing).astype(int) + 1, 3).tolist()
        x, y = np.meshgrid(low[0] + spacing * np.arange(columns), low[1] + spacing * np.arange(rows))
        nodes = inside(x, y)
        beyond = np.isnan(nodes)
        nodes[beyond] = NearestNDInterpolator(points, heights)(x[beyond], y[beyond])
        return cls((float(low[0]), float(low[1])), spacing, nodes, n_water=n_water)

    @property
    def area(self) -> tuple[np.ndarray, np.ndarray]:
        """x, y (2,) [m] of the first and the last node."""
        rows, columns = self.heights.shape
        first = np.array(self.corner)
        return first, first + self.spacing * np.array([columns - 1, rows - 1])

    def height(self, x, y):
        """Height z of the surface [m] at local x, y [m]; NaN beyond the nodes."""
        return self._interpolated(x, y, (0, 0))[0]

    def gradient(self, x, y) -> tuple[Any, Any]:
        """Slopes of the surface along x and y [-] at local x, y [m]; NaN beyond the nodes."""
        return self._interpolated(x, y, (1, 0), (0, 1))

    def hessian(self, x, y) -> tuple[Any, Any, Any]:
        """Second derivatives xx, xy, yy of the height [1/m]; they jump between the pieces."""
        return self._interpolated(x, y, (2, 0), (1, 1), (0, 2))

    def span(self, origin, direction) -> tuple[Any, Any]:
        """Distances [m] along rays from where they are over the nodes, at the highest, to where they leave them."""
        xp = namespace(*origin)
        start, end = origin[0] * 0.0, origin[0] * 0.0 + math.inf
        sides = (*np.transpose(self.area).tolist(), self._range)
        for o, d, (first, last) in zip(origin, direction, sides, strict=True):
            still = d == 0.0
            ways = [xp.where(still, at - o, (at - o) / xp.where(still, 1.0, d)) for at in (first, last)]
            outside = still & (ways[0] * ways[1] > 0.0)
            start = xp.where(outside, math.nan, xp.where(still, start, xp.maximum(start, xp.minimum(*ways))))
            end = xp.where(still, end, xp.minimum(end, xp.maximum(*ways)))
        return start, end

    @property
    def _range(self) -> tuple[float, float]:
        """Bounds of the height [m]; none while a transform of torch hides the nodes."""
        if transformed():
            return -math.inf, math.inf
        nodes = as_numpy(self._padded)
        low, high = float(nodes.min()), float(nodes.max())
        return low - _OVERSHOOT * (high - low), high + _OVERSHOOT * (high - low)

    def _interpolated(self, x, y, *orders) -> tuple:
        """Derivatives of the height of some orders (along x, along y), each a sum over 4 by 4 nodes."""
        xp = namespace(x, y)
        x, y = x + 0.0 * y, y + 0.0 * x
        rows, columns = self.heights.shape
        (column, u, in_x), (row, v, in_y) = (
            _cell((at - start) / self.spacing, nodes)
            for at, start, nodes in zip((x, y), self.corner, (columns, rows), strict=True)
        )
        padded = as_like(self._padded, x)
        along_x, along_y = {m: _WEIGHTS[m](u) for m, _ in orders}, {m: _WEIGHTS[m](v) for _, m in orders}
        totals = dict.fromkeys(orders, 0.0)
        for j in range(4):
            nodes = [padded[row + j, column + i] for i in range(4)]
            lines = {m: sum(w * z for w, z in zip(weights, nodes, strict=True)) for m, weights in along_x.items()}
            totals = {each: total + along_y[each[1]][j] * lines[each[0]] for each, total in totals.items()}
        return tuple(
            xp.where(in_x & in_y, total / self.spacing ** sum(each), math.nan) for each, total in totals.items()
        )

    @property
    def _padded(self):
        """The heights with one more node all around, on the parabola through the last three."""
        return _with_margin(self.heights) if namespace(self.heights).name == "torch" else self._padded_numpy

    @cached_property
    def _padded_numpy(self) -> np.ndarray:
        return _with_margin(self.heights)


def _with_margin(z):
    for _ in range(2):
        parts = 3.0 * (z[:1] - z[1:2]) + z[2:3], z, 3.0 * (z[-1:] - z[-2:-1]) + z[-3:-2]
        z = (np.concatenate if isinstance(z, np.ndarray) else sys.modules["torch"].cat)(parts).swapaxes(0, 1)
    return z


def _cell(at, nodes: int):
    """The cell of a place among nodes, the fractional position in it, and whether there is one."""
    xp = namespace(at)
    inside = (at >= -_ON_EDGE) & (at <= nodes - 1.0 + _ON_EDGE)
    at = xp.where(inside, at, 0.0)
    if xp.name == "torch":
        cell = at.detach().floor().clamp(0.0, nodes - 2.0)
        return cell.long(), at - cell, inside
    cell = np.clip(np.floor(at), 0.0, nodes - 2.0)
    return cell.astype(np.int64), at - cell, inside


# By order of the derivative by u: weights of the four nodes around, at the part u of the cell between the middle two.
_WEIGHTS = (
    lambda u: (
        ((-0.5 * u + 1.0) * u - 0.5) * u,
        (1.5 * u - 2.5) * u * u + 1.0,
        ((-1.5 * u + 2.0) * u + 0.5) * u,
        (0.5 * u - 0.5) * u * u,
    ),
    lambda u: ((-1.5 * u + 2.0) * u - 0.5, (4.5 * u - 5.0) * u, (-4.5 * u + 4.0) * u + 0.5, (1.5 * u - 1.0) * u),
    lambda u: (2.0 - 3.0 * u, 9.0 * u - 5.0, 4.0 - 9.0 * u, 3.0 * u - 1.0),
)
