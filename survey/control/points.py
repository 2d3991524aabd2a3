"""Control: points, their marks in photographs, check points, and dry ground of an earlier survey; crs and local."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class ControlPoint:
    """A point of known coordinates."""

    name: str
    crs: tuple[float, float, float]  # (easting, northing, height)
    local: np.ndarray  # (3,) float64 [m]
    std: np.ndarray  # (3,) float64 [m]: of `local`: east, north, up
    is_check: bool = False  # Whether the file calls it a check point: it has marks, but is not to be adjusted to
    # [m]: what of `std` all points of its file have in common, by a transformation of datums
    common_plan_std: float = 0.0


@dataclass(frozen=True)
class Mark:
    """Mark of a control point in a photograph."""

    # point, view: Their names
    point: str
    view: str
    # (x, y): in the stored photograph as it was taken, with its distortion; the centre of the first pixel is 0.5, 0.5
    pixel: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Control:
    """The control points of a survey that its photographs show."""

    points: tuple[ControlPoint, ...]  # Each has a mark at least; whether a point lies under water is not known here
    marks: tuple[Mark, ...]  # In order of points and then of views; of views that have a pose only
    marks_std_px: float


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A point of known coordinates that no photograph needs to show, and nothing is adjusted to."""

    name: str
    crs: tuple[float, float, float]  # (easting, northing, height)
    local: np.ndarray  # (3,) float64 [m]


@dataclass(frozen=True, eq=False)
class Ground:
    """Points of ground that did not change since they were surveyed."""

    points: np.ndarray  # (N, 3) float64 [m], local
    std_m: tuple[float, float]  # (horizontal, vertical) [m]: standard deviation of a shift that all of them share
