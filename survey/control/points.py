"""Control: points, their marks in photographs, check points, and dry ground of an earlier survey; crs and local."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pyproj import CRS

from survey.files.point_table import Units


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A point of known coordinates, which no photograph needs to show."""

    name: str
    crs: tuple[float, float, float]  # (easting, northing, height)
    local: np.ndarray  # (3,) float64 [m]
    # (3,) float64 [m]: of `local`: east, north, up; zeros where nothing states it
    std: np.ndarray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, eq=False)
class ControlPoint(Checkpoint):
    """A point of known coordinates with marks."""

    is_check: bool = False  # Whether the file calls it a check point, which is not to be adjusted to
    # [m]: the part of `std` common to all points of its file, from a transformation of datums
    common_plan_std: float = 0.0


@dataclass(frozen=True)
class Mark:
    """Mark of a point in a photograph, which files may call otherwise than the survey."""

    # point, view: Their names
    point: str
    view: str
    # (x, y): in the stored photograph as it was taken, with its distortion; the centre of the first pixel is 0.5, 0.5
    pixel: tuple[float, float]
    where: str = ""  # File and line, for messages; not of marks in a `Control`


@dataclass(frozen=True, eq=False)
class Control:
    """The control points of a survey that its photographs show."""

    points: tuple[ControlPoint, ...]  # Each has a mark at least; whether a point lies under water is not known here
    marks: tuple[Mark, ...]  # In order of points and then of views; of views that have a pose only
    marks_std_px: float


@dataclass(frozen=True, eq=False)
class StableGround:
    """Points of ground that did not change since they were surveyed."""

    points: np.ndarray  # (N, 3) float64 [m], local
    std_m: tuple[float, float]  # (horizontal, vertical) [m]: standard deviation of a shift that all of them share


@dataclass(frozen=True)
class GivenPoint:
    name: str
    where: str  # File and line, for messages
    # (easting or longitude, northing or latitude, height): horizontally in `crs`; the height has the datum of the crs
    # of the survey, in the unit that the file states
    place: tuple[float, float, float]
    crs: CRS | None = None  # None where it is that of the survey
    # (east, north, up) [m] or None: None where the file does not say it
    std_m: tuple[float, float, float] | None = None
    is_check: bool = False
    as_read: GivenPoint | None = None  # The point as in its file, once `place` is in the crs of the survey
    datum_std_m: float = 0.0  # Std that this transformation adds in plan, common to all points of a file
    units: Units = field(default_factory=Units)  # That the file gives its coordinates beside a CRS


@dataclass(frozen=True)
class Content:
    """Contents of a file: points and marks; either may be empty."""

    points: tuple[GivenPoint, ...] = ()
    marks: tuple[Mark, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class ControlFormat:
    name: str  # In a sentence: "expected ..."
    recognises: Callable[[Path], bool]  # whether a path, which is a file, is of this format
    read: Callable[[Path], Content]  # the content of such a file; raises ControlError
