"""Control: points, their marks in photographs, check points, and dry ground of an earlier survey; crs and local."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class ControlPoint:
    """A point of known coordinates.

    Attributes
    ----------
    name : str
    crs : (easting, northing, height)
    local : (3,) float64 [m]
    std : (3,) float64 [m]
        Of `local`: east, north, up.
    is_check : bool
        Whether the file calls it a check point: it has marks, but is not to be adjusted to.
    common_plan_std : float [m]
        What of `std` all points of its file have in common, by a transformation of datums.
    """

    name: str
    crs: tuple[float, float, float]
    local: np.ndarray
    std: np.ndarray
    is_check: bool = False
    common_plan_std: float = 0.0


@dataclass(frozen=True)
class Mark:
    """Mark of a control point in a photograph.

    Attributes
    ----------
    point, view : str
        Their names.
    pixel : (x, y)
        In the stored photograph as it was taken, with its distortion; the centre of the first pixel is 0.5, 0.5.
    """

    point: str
    view: str
    pixel: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Control:
    """The control points of a survey that its photographs show.

    Attributes
    ----------
    points : tuple of ControlPoint
        Each has a mark at least; whether a point lies under water is not known here.
    marks : tuple of Mark
        In order of points and then of views; of views that have a pose only.
    marks_std_px : float
    """

    points: tuple[ControlPoint, ...]
    marks: tuple[Mark, ...]
    marks_std_px: float


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A point of known coordinates that no photograph needs to show, and nothing is adjusted to.

    Attributes
    ----------
    name : str
    crs : (easting, northing, height)
    local : (3,) float64 [m]
    """

    name: str
    crs: tuple[float, float, float]
    local: np.ndarray


@dataclass(frozen=True, eq=False)
class Ground:
    """Points of ground that did not change since they were surveyed.

    Attributes
    ----------
    points : (N, 3) float64 [m], local
    std_m : (horizontal, vertical) [m]
        Standard deviation of a shift that all of them share.
    """

    points: np.ndarray
    std_m: tuple[float, float]
