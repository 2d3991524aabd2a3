"""Measurements of a survey besides its photographs, sources of its poses, and the views that these placed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from geo.frames import LocalFrame
from survey.control.points import Checkpoint, Control, StableGround
from survey.errors import GivenValueTest
from survey.folder.found import Found
from survey.folder.local_frame import TiePointMisfit
from survey.folder.motion import Velocity
from survey.folder.pose_priors import PosePrior
from survey.photos.cameras import View
from survey.photos.poses import TiePoints
from survey.water.level_observation import LevelObservation
from survey.water.surface import Departure
from survey.water.tides import Tide


@dataclass(frozen=True, eq=False, repr=False)
class Observations:
    """Measurements of a survey besides its photographs."""

    # (N, 3) float64 [m], local, or None: matched points with three observations or more, on straight rays, or those of
    # an adjustment with bent rays; None where the poses came without any
    points: np.ndarray | None = None
    # These with their observations, in pixels of the original photographs, where structure from motion found them
    ties: TiePoints | None = None
    priors: Mapping[str, PosePrior] = field(default_factory=dict)  # Of the pose of each view, by name
    # [px]: by EXIF, of views that structure from motion placed, by name; without doubtful ones
    exif_focals: Mapping[str, float] = field(default_factory=dict)
    control: Control | None = None  # Control points that the photographs show
    checkpoints: tuple[Checkpoint, ...] = ()  # Points that results are compared with
    # Measurements of the water level; the settings have their mean and its standard deviation
    levels: tuple[LevelObservation, ...] = ()
    velocities: Mapping[str, Velocity] = field(default_factory=dict)  # Of the views for which one is known, by name
    # Change of the level from photograph to photograph, where it is known; cameras have it where it matters
    # (`PinholeCamera.tide`)
    tide: Tide | None = None
    ground: StableGround | None = None  # Dry ground of an earlier survey that the block is aligned to
    departure: Departure | None = None  # Of the water from its plane; None where none is given


@dataclass(frozen=True)
class Provenance:
    """Sources of poses, level and index of a survey, and their fit to the photographs."""

    tool: str | None = None  # That adjusted the poses of the poses file on straight rays, where it is known
    reprojection: TiePointMisfit | None = None  # Of the tie points of the poses file, where there are some
    # Reprojection misfit between photographs under the given poses [px]; below 0 where too little matches, None before
    # it is measured
    pose_misfit_px: float | None = None
    # What a sample of photographs contradicts, of the given water or lens, under poses that it confirms
    contradiction: GivenValueTest | None = None
    is_adjusted: bool = False  # Whether views, water and points are those of an adjustment with bent rays
    is_level_known: bool = True  # Whether survey.toml gives the level of the water; else that of the survey is a guess
    # Whether survey.toml determines the index of the water; else the settings have an assumed one with a matching
    # standard deviation
    is_index_known: bool = True


@dataclass(frozen=True)
class PlacedViews:
    """Views that a poses file or structure from motion placed."""

    found: Found  # The contents of the survey folder, with the level that clicks give where a poses file places these
    frame: LocalFrame
    views: list[View]  # Sorted by name
    observations: Observations = field(default_factory=Observations)
    provenance: Provenance = field(default_factory=Provenance)
