"""Measurements of a survey besides its photographs, sources of its poses, and the views that these placed.

Velocities of the camera are those of XMP, of positions and times, or of survey.toml; they move the rows of a rolling
shutter.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from geo.frames import LocalFrame
from refract import FlatWater
from survey.control.points import Checkpoint, Control, StableGround
from survey.display.quantities import named
from survey.errors import FILE_NAME, Findings, GivenValueTest
from survey.folder.found import Found
from survey.folder.local_frame import TiePointMisfit
from survey.folder.pose_priors import PosePrior
from survey.photos.cameras import View, metres_per_px
from survey.photos.exif import Exif
from survey.photos.poses import TiePoints
from survey.settings.config import CamerasConfig
from survey.water.level_observation import LevelObservation
from survey.water.surface import Departure
from survey.water.tides import Tide

# Where a velocity comes from, the most certain first.
BY_XMP, BY_TIMES, BY_SETTINGS = "XMP", "positions and times", "survey.toml"
# Photographs farther apart in time are not of one flight line [s].
_LONGEST_S = 60.0
# On a flight line, velocities between successive photographs differ by at most this share: 20 degrees of direction, or
# the rounding of times to whole seconds.
_SAME_LINE = 0.35
# Typical readout time of drones [s], which have 10 to 60 ms; to estimate the effect of an unknown one.
_USUAL_READOUT_S = 0.03
# Slower than this the usual readout moves the last row by a millimetre: the drone hovers.
_HOVERS_M_S = 0.05


@dataclass(frozen=True, eq=False)
class Velocity:
    local: np.ndarray  # (3,) float64 [m/s], local
    source: str  # `BY_XMP`, `BY_TIMES` or `BY_SETTINGS`

    @property
    def speed(self) -> float:
        """[m/s]."""
        return float(np.linalg.norm(self.local))


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


def velocities_of(
    places: Mapping[str, np.ndarray], headers: Mapping[str, Exif], speed_m_s: float | None
) -> dict[str, Velocity]:
    """Velocities of the photographs, where XMP, times or settings give them.

    ``speed_m_s`` is that along flight lines, where neither XMP nor times give it, in the order of times, else of names.
    """
    velocities = _velocities_by_xmp({name: headers[name] for name in places})
    if len(velocities) == len(places):
        return velocities
    # By one clock: the camera's, or where fewer have that, UTC.
    clocks = [
        {name: time for name in places if (time := getattr(headers[name], clock)) is not None}
        for clock in ("clock", "taken")
    ]
    times = max(clocks, key=len)
    first = min(times.values(), default=None)
    seconds = {} if first is None else {name: (time - first).total_seconds() for name, time in times.items()}
    found = [(BY_TIMES, _along_lines(places, seconds, None))]
    if speed_m_s is not None:
        order = seconds if len(seconds) == len(places) else {name: float(i) for i, name in enumerate(sorted(places))}
        found.append((BY_SETTINGS, _along_lines(places, order, speed_m_s)))
    for source, by_line in found:
        for name, local in by_line.items():
            velocities.setdefault(name, Velocity(local, source))
    return velocities


def _velocities_by_xmp(headers: Mapping[str, Exif]) -> dict[str, Velocity]:
    """Velocities in XMP. True east and north are those of local to some thousandths."""
    known = {name: header.motion.velocity for name, header in headers.items()}
    return {name: Velocity(np.array(v), BY_XMP) for name, v in known.items() if v is not None}


def _along_lines(
    places: Mapping[str, np.ndarray], seconds: Mapping[str, float], speed_m_s: float | None
) -> dict[str, np.ndarray]:
    """Velocities (3,) [m/s] of the photographs on flight lines: from the one before to the one after.

    At the end of a line only the neighbour on the line is used. At a turn, where neither or both neighbours could be on
    the line, a photograph has no velocity. A given speed replaces that of positions and times; only their order counts.
    """
    names = sorted(seconds, key=lambda name: (seconds[name], name))
    if len(names) < 3:
        return {}
    steps = np.diff([places[name] for name in names], axis=0)
    times = np.diff([seconds[name] for name in names])
    linked = (times > 0.0) & (times <= _LONGEST_S)
    rates, weights = steps / np.where(linked, times, 1.0)[:, None], times
    if speed_m_s is not None:
        metres = np.linalg.norm(steps, axis=1)
        linked = metres > 0.0
        rates, weights = speed_m_s * steps / np.where(linked, metres, 1.0)[:, None], np.ones(len(times))
    lengths = np.linalg.norm(rates, axis=1)
    rate_changes = np.linalg.norm(np.diff(rates, axis=0), axis=1)
    # Of all photographs: whether they lie inside a line.
    inside = np.zeros(len(names), dtype=bool)
    inside[1:-1] = linked[:-1] & linked[1:] & (rate_changes <= _SAME_LINE * np.maximum(lengths[:-1], lengths[1:]))
    velocities: dict[str, np.ndarray] = {}
    for i, name in enumerate(names):
        comes, goes = bool(i and inside[i - 1]), i + 1 < len(names) and bool(inside[i + 1])
        if inside[i]:
            velocities[name] = weights[i - 1 : i + 1] @ rates[i - 1 : i + 1] / weights[i - 1 : i + 1].sum()
        elif comes != goes:
            velocities[name] = rates[i - 1] if comes else rates[i]
    return velocities


def with_motion(
    views: Sequence[View], velocities: Mapping[str, Velocity], cameras: CamerasConfig
) -> tuple[list[View], Findings]:
    """The views with the motion of their cameras from row to row; unchanged without a rolling shutter."""
    if not cameras.rolls:
        return list(views), Findings()
    unknown = [view.name for view in views if view.name not in velocities]
    if len(unknown) == len(views):
        warnings = [
            "[cameras] rolling_shutter_s is not used: nothing tells how fast the camera flew (no FlightXSpeed in XMP, "
            f"no times in EXIF of photographs along lines); give speed_m_s in {FILE_NAME}"
        ]
    else:
        warnings = named(
            unknown, "image", "of unknown velocity (at a turn?), taken as exposed at once, without a rolling shutter"
        )
    readout, moving = cameras.rolling_shutter_s or 0.0, []
    for view in views:
        velocity, motion = velocities.get(view.name), None
        if velocity is not None and velocity.speed and readout:
            motion = velocity.local * (readout / rows_between(view.lens.height))
        moving.append(replace(view, camera=replace(view.camera, motion=motion)))
    return moving, Findings(warnings=tuple(warnings))


def rows_between(height: int) -> int:
    """Number of row intervals from the first to the last row of an image."""
    return max(height - 1, 1)


def shutter_warnings(cameras: CamerasConfig, headers: Mapping[str, Exif], metres_per_px: float | None) -> list[str]:
    """A warning about photographs that were taken in flight, by XMP, with an unknown type of shutter."""
    if cameras.rolling_shutter_s is not None:
        return []
    rolling = {name: header for name, header in headers.items() if not header.motion.is_mechanical}
    speeds = [velocity.speed for velocity in _velocities_by_xmp(rolling).values()]
    fastest = max(speeds, default=0.0)
    if fastest < _HOVERS_M_S:
        return []
    moves = fastest * _USUAL_READOUT_S
    return [
        f"by XMP the camera flew at up to {fastest:.1f} m/s, and nothing says how its shutter works: a rolling one, "
        f"read out in {1000.0 * _USUAL_READOUT_S:.0f} ms, would move the last row against the first by up to "
        f"{_moved(moves, metres_per_px)}; give [cameras] rolling_shutter_s in {FILE_NAME}, 0 for a mechanical shutter"
    ]


def shutter_text(
    cameras: CamerasConfig, velocities: Mapping[str, Velocity], views: Sequence[View], water: FlatWater | None
) -> str | None:
    """Shutter, speed of the cameras and their effect in words; None where nothing is known."""
    readout = cameras.rolling_shutter_s
    if readout is None:
        return None
    if not cameras.rolls:
        return "exposes all rows at once (global or mechanical)"
    sources = Counter(velocity.source for velocity in velocities.values())
    by = ", ".join(f"{count} by {source}" for source, count in sources.items())
    fastest = max((velocity.speed for velocity in velocities.values()), default=0.0)
    std = cameras.rolling_shutter_std_s
    rolls = f"rolls in {1000.0 * readout:.3g}" + ("" if std is None else f" +- {1000.0 * std:.2g}") + " ms"
    known = f"velocities of {len(velocities)} of {len(views)} images" + (f" ({by})" if by else "")
    moved = _moved(fastest * readout, metres_per_px(views, water))
    return f"{rolls}; {known}" + (f", which move rows by up to {moved}" if fastest * readout > 0.0 else "")


def _moved(metres: float, per_px: float | None) -> str:
    message = f"{100.0 * metres:.1f} cm" if metres < 0.1 else f"{100.0 * metres:.0f} cm"
    return message if per_px is None or not per_px > 0.0 else f"{message} or {metres / per_px:.1f} px"
