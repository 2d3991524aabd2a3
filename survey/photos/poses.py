"""Poses and tie points as files of other programs have them, and the frames that they count from."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

import numpy as np
from pyproj import CRS

from refract.lens import Lens
from survey.errors import PosesError
from survey.files.csv_table import shortened


class SecondPose(PosesError):
    """A file has two poses under one name.

    Attributes
    ----------
    called : str
        The name, as the file has it.
    """

    def __init__(self, called: str, where: str):
        super().__init__(
            f"{where}: image {shortened(called)} has a second pose; keep one of the two, or, if they are of two "
            "photographs in different folders, write the folder before the name"
        )
        self.called = called


class PoseFrame(Enum):
    """Frame of the positions and rotations of a poses file.

    | frame | positions | rotations, from |
    |---|---|---|
    | GRID | in crs | the grid axes at the camera: easting, northing, height |
    | LEVEL | in crs | true east, true north and up at the camera |
    | GEOCENTRIC | x, y, z [m] from the centre of the Earth | the same axes |
    | LOCAL | [m] in the topocentric frame of [local] | its axes |
    """

    GRID = "grid"
    LEVEL = "level"
    GEOCENTRIC = "geocentric"
    LOCAL = "local"


@dataclass(frozen=True, eq=False)
class GivenPosition:
    """Position of a camera before any adjustment, by GPS, as a file has it."""

    place: np.ndarray  # (3,) float64: easting or longitude, northing or latitude and height in the crs of its file
    std: np.ndarray  # (3,) float64 [m]: East, north, up


@dataclass(frozen=True, eq=False)
class Pose:
    """The pose of one photograph in a poses file."""

    name: str  # Of the image, as the file has it
    centre: np.ndarray  # (3,) float64: of the camera, in the frame of the file
    # (3, 3) float64: rotation into cam (x right, y down, z forward), from the axes of the frame of the file
    cam_from_world: np.ndarray
    lens: Lens | None = None  # None if the file has no lens
    given: GivenPosition | None = None  # None where the file does not say how well the position was known beforehand


@dataclass(frozen=True)
class PoseFile:
    """Contents of a poses file."""

    poses: tuple[Pose, ...]  # Of different names
    frame: PoseFrame
    # Of GRID and LEVEL: that of the positions; of GEOCENTRIC: the one on whose datum they are. None: the crs of the
    # survey, or WGS 84 for GEOCENTRIC.
    crs: CRS | None = None
    # The program that adjusted the poses, which knows straight rays only; None where the format does not tell
    tool: str | None = None
    masks: Path | None = None  # Folder of the masks that the program used
    # notes, warnings sentences: what was assumed of the file, and what it has that is not used
    notes: tuple[str, ...] = field(default=(), compare=False)
    warnings: tuple[str, ...] = field(default=(), compare=False)
    # height_unit_m, plan_unit_m: Units of heights, and of eastings and northings [m], where the file tells them beside
    # ``crs``
    height_unit_m: float | None = None
    plan_unit_m: float | None = None


@dataclass(frozen=True, eq=False)
class FileTies:
    """Tie points of the program that made the poses."""

    points: np.ndarray  # (N, 3) float64: in the frame of the poses file
    num_views: np.ndarray  # (N,) int64: how many photographs see each
    names: tuple[str, ...] = ()  # Of photographs, as the file has them
    # point, image (M,) int64: which point is seen in which photograph, a number into `names`
    point: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    image: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    pixel: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))  # (M, 2) float64 [px], img
