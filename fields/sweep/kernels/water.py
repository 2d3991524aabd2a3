"""Water of the kernels of sweep and solver: the protocol of a surface, and its implementation for each kind.

Kernels work in a frame of the water in which z is the height over it. A ray bends where it enters the water, and a
point is seen from a camera by way of its crossing; no other part of a kernel knows what surface there is. A second kind
of surface is a class with the members of `KernelWater` and a line in `kernel_water`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from refract import FlatWater, kernels

# The water plane in its own frame.
_POINT, _NORMAL = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)

Triple = tuple[Any, Any, Any]


class KernelWater(Protocol):
    """Water as the kernels take it; triples are arrays of a device, numpy or numbers, in the frame of the water."""

    @property
    def origin(self) -> np.ndarray:
        """Origin (3,) [m], local, of the frame."""

    @property
    def from_local(self) -> np.ndarray:
        """Rotation (3, 3) into the frame; ``p = from_local @ (p_in_local - origin)``."""

    @property
    def is_refracting(self) -> bool:
        """Whether rays bend."""

    def bend(self, ray: Triple) -> Triple:
        """Direction of a ray in water, from its unit direction in air."""

    def crossing(self, centre: Triple, point: Triple, steps: int) -> Triple:
        """Crossing of the ray from a camera to a point; the point itself where the ray is straight."""


@dataclass(frozen=True)
class PlaneWater:
    """A plane, in whose frame z is the height over it along its normal; local itself in a dry survey."""

    origin: np.ndarray  # (3,) [m], local: the point of the plane nearest to the origin of local
    from_local: np.ndarray  # (3, 3)
    n_water: float | None  # Refractive index; None where rays are straight

    @staticmethod
    def of(water: FlatWater | None) -> PlaneWater:
        """The plane of a survey; in water of index one rays are straight."""
        if water is None:
            return PlaneWater(np.zeros(3), np.eye(3), None)
        up = np.asarray(water.up, dtype=np.float64)
        east = np.array([1.0, 0.0, 0.0]) - up[0] * up
        east /= np.linalg.norm(east)
        index = None if water.n_water == 1.0 else water.n_water
        return PlaneWater(up * (up @ np.asarray(water.point)), np.stack([east, np.cross(up, east), up]), index)

    @property
    def is_refracting(self) -> bool:
        """Whether there is water whose index counts."""
        return self.n_water is not None

    def bend(self, ray: Triple) -> Triple:
        """See `KernelWater.bend`; the ray itself where none bends."""
        return kernels.bend(ray, _NORMAL, 1.0, self.n_water or 1.0)

    def crossing(self, centre: Triple, point: Triple, steps: int) -> Triple:
        """See `KernelWater.crossing`; ``steps`` are those of `refract.kernels.air_share`."""
        if self.n_water is None:
            return point
        plane = kernels.WaterPlane(_POINT, _NORMAL, self.n_water)
        return kernels.crossing_of_point(centre, point, plane, steps)[0]


def kernel_water(water: FlatWater | None) -> KernelWater:
    """The water of a survey as the kernels take it.

    Raises TypeError if no kernel is written for this surface.
    """
    if water is None or isinstance(water, FlatWater):
        return PlaneWater.of(water)
    raise TypeError(f"sweep and solver take FlatWater or None, got {type(water).__name__}")
