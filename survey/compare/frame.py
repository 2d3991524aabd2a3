"""The local frame of a comparison, and the points that lie in its bounds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geo import LocalFrame
from survey.compare.options import Bounds, CompareError


@dataclass(frozen=True)
class ShiftedFrame:
    """Substitute for a `LocalFrame` if no file has a CRS: coordinates in metres, shifted near zero."""

    origin: tuple[float, float, float]

    def local_from_crs(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) as given, minus the origin [m]."""
        return np.asarray(points, dtype=np.float64) - self.origin

    def crs_from_local(self, points: np.ndarray) -> np.ndarray:
        """The inverse."""
        return np.asarray(points, dtype=np.float64) + self.origin


def within(points: np.ndarray, bounds: Bounds | None, margins: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Whether points (N, 3) lie in bounds (edges included) that grow by margins in easting and northing."""
    if bounds is None:
        return np.ones(len(points), dtype=bool)
    e0, n0, e1, n1 = bounds
    east, north = points[:, 0], points[:, 1]
    return (
        (east >= e0 - margins[0]) & (east <= e1 + margins[0]) & (north >= n0 - margins[1]) & (north <= n1 + margins[1])
    )


def to_local(frame: LocalFrame | ShiftedFrame, points: np.ndarray, name: Path) -> np.ndarray:
    """Points (N, 3) in the local frame [m]."""
    local = frame.local_from_crs(points)
    if isinstance(frame, ShiftedFrame):
        return local
    bad = int((~np.isfinite(local).all(axis=1)).sum())
    if bad:
        raise CompareError(
            f"{bad} of {len(points)} points of {name} lie where {frame.crs.name} is not defined; remove them or "
            "correct the CRS of the file"
        )
    return local


def metres_in_crs(frame: LocalFrame | ShiftedFrame, length_m: float) -> tuple[float, float]:
    """A length [m] near the origin in units of easting and of northing (degrees in a geographic CRS)."""
    e, n, h = frame.origin
    step = 1e-6 * max(abs(e), abs(n), 1.0)
    ends = np.array([[e + step, n, h], [e - step, n, h], [e, n + step, h], [e, n - step, h]])
    local = frame.local_from_crs(ends)
    east = float(np.linalg.norm(local[0] - local[1])) / (2.0 * step)
    north = float(np.linalg.norm(local[2] - local[3])) / (2.0 * step)
    return length_m / east, length_m / north
