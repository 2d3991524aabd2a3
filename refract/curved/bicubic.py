"""A measured water surface of bicubic pieces over a raster, with a continuous normal."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from typing import Any, final

import numpy as np

from refract._array import as_like, as_numpy, compiling, namespace
from refract._numbers import hold, moved, number, read, require_index
from refract._solvers import solved
from refract.curved.any_surface import AnySurface, newton_crossing, newton_distance


@solved
@final
@dataclass(frozen=True, eq=False)
class BicubicWater(AnySurface):
    """Cubic pieces (Catmull and Rom's) between the nodes of an even raster, in a right-handed frame with z up.

    Heights pass through the nodes, and slopes are continuous. Over a spacing s, of a smooth surface, heights are good
    to the third power of s and slopes to the second, where the triangles of `HeightFieldWater` have the second and the
    first. numpy and torch; tracing and projection are those of `AnySurface`, not proven.

    Parameters
    ----------
    corner : (2,) [m], local
        x and y of the node ``heights[0, 0]``.
    spacing : [m]
        Between nodes, along x and y.
    heights : (rows, columns) [m], local
        At the nodes, x along columns; at least 3 by 3. A tensor lets gradients flow to them. NaN where there is no
        water; the surface has no water within two nodes of such a node either.
    n_water : [-]
        Refractive index of the water relative to the air above it, at least 1.

    Raises
    ------
    ValueError
        If shapes do not fit, the spacing is not positive, or the index is outside 1 to 2.
    """

    corner: tuple[float, float]
    spacing: float
    heights: Any
    _: KW_ONLY
    n_water: Any = 1.333

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

    def to(self, *place, **options) -> BicubicWater:
        """The same water with its tensors moved, by the arguments of `torch.Tensor.to`."""
        return moved(self, place, options)

    @property
    def numbers(self) -> tuple:
        """Parameters of the surface."""
        return *self.corner, self.spacing, self.heights, self.n_water

    @classmethod
    def from_numbers(cls, x, y, spacing, heights, n_water) -> BicubicWater:
        """The surface with these `numbers`."""
        return cls((x, y), spacing, heights, n_water=n_water)

    def detached(self) -> BicubicWater:
        """The same water in numpy, without gradients."""
        return BicubicWater.from_numbers(*map(as_numpy, self.numbers))

    def height(self, x, y):
        """Height z of the surface [m] at local x, y [m]; NaN where there is no water."""
        return self._interpolated(x, y, _weights, _weights)

    def normal(self, x, y) -> tuple[Any, Any, Any]:
        """Unit normal of the surface at x, y, pointing up into the air; NaN where there is no water."""
        zx = self._interpolated(x, y, _rates, _weights) / self.spacing
        zy = self._interpolated(x, y, _weights, _rates) / self.spacing
        up = 1.0 / namespace(zx).sqrt(1.0 + zx * zx + zy * zy)
        return -zx * up, -zy * up, up

    # torch.compile would unroll each of thirty steps with sixteen nodes per height.
    def _newton_distance(self, origin, direction):
        if not compiling():
            return super()._newton_distance(origin, direction)
        t, is_converged = read(newton_distance, self, (*origin, *direction))
        return t, is_converged > 0.0

    def _newton_crossing(self, camera, point, depth):
        if not compiling():
            return super()._newton_crossing(camera, point, depth)
        x, y, is_converged = read(newton_crossing, self, (*camera, *point, depth))
        return x, y, is_converged > 0.0

    def _interpolated(self, x, y, along_x, along_y):
        """The sum over 4 by 4 nodes with weights along x and y."""
        if namespace(x).name == "drjit":
            raise TypeError("BicubicWater runs on numpy and torch, got Dr.Jit arrays; convert them")
        x, y = x + 0.0 * y, y + 0.0 * x
        rows, columns = self.heights.shape
        (column, u, in_x), (row, v, in_y) = (
            _cell((at - start) / self.spacing, nodes)
            for at, start, nodes in zip((x, y), self.corner, (columns, rows), strict=True)
        )
        padded, is_complete = _filled(self._padded(x))
        total = 0.0
        for j, weight_y in enumerate(along_y(v)):
            line = sum(weight * padded[row + j, column + i] for i, weight in enumerate(along_x(u)))
            total = total + weight_y * line
        return namespace(x).where(in_x & in_y & is_complete[row, column], total, math.nan)

    def _padded(self, like):
        """The heights with one more node all around, on the parabola through the last three."""
        z = self.heights if namespace(self.heights).name == "torch" else as_like(self.heights, like)
        for _ in range(2):
            first, last = 3.0 * (z[:1] - z[1:2]) + z[2:3], 3.0 * (z[-1:] - z[-2:-1]) + z[-3:-2]
            z = _concatenated(first, z, last).swapaxes(0, 1)
        return z


def _filled(z):
    """Nodes with zeros for those that are missing, and which cells have all of their four by four nodes."""
    xp = namespace(z)
    missing = xp.isnan(z)
    rows, columns = (size - 3 for size in z.shape)
    hole = sum(1.0 * missing[j : j + rows, i : i + columns] for j in range(4) for i in range(4))
    return xp.where(missing, 0.0, z), hole < 1


def _concatenated(*parts):
    if namespace(*parts).name == "numpy":
        return np.concatenate(parts)
    import torch

    return torch.cat(parts)


def _cell(at, nodes: int):
    """The cell of a place among nodes, the fractional position in it, and whether there is one."""
    xp = namespace(at)
    inside = (at >= 0.0) & (at <= nodes - 1.0)
    at = xp.where(inside, at, 0.0)
    if xp.name == "torch":
        cell = at.detach().floor().clamp(max=nodes - 2.0)
        return cell.long(), at - cell, inside
    cell = np.minimum(np.floor(at), nodes - 2.0)
    return cell.astype(np.int64), at - cell, inside


def _weights(u):
    """Weights of the four nodes around, at the part u of the cell between the middle two."""
    return (
        ((-0.5 * u + 1.0) * u - 0.5) * u,
        (1.5 * u - 2.5) * u * u + 1.0,
        ((-1.5 * u + 2.0) * u + 0.5) * u,
        (0.5 * u - 0.5) * u * u,
    )


def _rates(u):
    """Derivatives of `_weights`."""
    return (
        (-1.5 * u + 2.0) * u - 0.5,
        (4.5 * u - 5.0) * u,
        (-4.5 * u + 4.0) * u + 0.5,
        (1.5 * u - 1.0) * u,
    )
