"""Rolling shutters: motion of the camera per row, and its effect if unknown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from refract import FlatWater
from survey.display.words import named
from survey.errors import FILE_NAME
from survey.findings import Findings
from survey.folder.velocities import Velocity, velocities_by_xmp
from survey.photos.cameras import View, metres_per_px
from survey.photos.exif import Exif
from survey.settings.config import CamerasConfig

# What drones need to read out an image [s]: 10 to 60 ms; for the effect of a readout that is not known.
_USUAL_READOUT_S = 0.03
# Slower than this the usual readout moves the last row by a millimetre: the drone hovers.
_HOVERS_M_S = 0.05


def with_motion(
    views: Sequence[View], velocities: Mapping[str, Velocity], cameras: CamerasConfig
) -> tuple[list[View], Findings]:
    """The views with the motion of their cameras from row to row; as they are where no shutter is said to roll."""
    if not cameras.rolls:
        return list(views), Findings()
    unknown = [view.name for view in views if view.name not in velocities]
    if len(unknown) == len(views):
        warnings = [
            "[cameras] rolling_shutter_s is not used: nothing tells how fast the camera flew (no FlightXSpeed in XMP, "
            f"no times in EXIF of photographs along lines); give speed_m_s in {FILE_NAME}"
        ]
    else:
        warnings = named(unknown, "image", "of unknown velocity (at a turn?), whose rows count as exposed at once")
    readout = cameras.rolling_shutter_s or 0.0
    moving = [replace(view, camera=replace(view.camera, motion=_motion(view, velocities, readout))) for view in views]
    return moving, Findings(warnings=tuple(warnings))


def _motion(view: View, velocities: Mapping[str, Velocity], readout: float) -> np.ndarray | None:
    velocity = velocities.get(view.name)
    if velocity is None or velocity.speed == 0.0 or readout == 0.0:
        return None
    return velocity.local * (readout / rows_between(view.lens.height))


def rows_between(height: int) -> int:
    """From the first to the last row of an image."""
    return max(height - 1, 1)


def shutter_doubts(cameras: CamerasConfig, heads: Mapping[str, Exif], metres_per_px: float | None) -> list[str]:
    """A warning about photographs that XMP says were taken in flight, while nothing is said of the shutter.

    Parameters
    ----------
    cameras : CamerasConfig
    heads : name to Exif
        Of the photographs.
    metres_per_px : [m/px] or None
        On the ground; None where it is not known.
    """
    if cameras.rolling_shutter_s is not None:
        return []
    rolling = {name: head for name, head in heads.items() if not head.motion.is_mechanical}
    speeds = [velocity.speed for velocity in velocities_by_xmp(rolling).values()]
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
    """What is known of the shutter and of how fast the cameras flew, and what it does; None where nothing is said."""
    readout = cameras.rolling_shutter_s
    if readout is None:
        return None
    if not cameras.rolls:
        return "exposes all rows at once"
    sources = Counter(velocity.source for velocity in velocities.values())
    by = ", ".join(f"{count} by {source}" for source, count in sources.items())
    fastest = max((velocity.speed for velocity in velocities.values()), default=0.0)
    std = cameras.rolling_shutter_std_s
    rolls = f"rolls in {1000.0 * readout:.3g}" + ("" if std is None else f" +- {1000.0 * std:.2g}") + " ms"
    known = f"velocities of {len(velocities)} of {len(views)} images" + (f" ({by})" if by else "")
    moved = _moved(fastest * readout, metres_per_px(views, water))
    return f"{rolls}; {known}" + (f", which move rows by up to {moved}" if fastest * readout > 0.0 else "")


def _moved(metres: float, per_px: float | None) -> str:
    said = f"{100.0 * metres:.1f} cm" if metres < 0.1 else f"{100.0 * metres:.0f} cm"
    return said if per_px is None or not per_px > 0.0 else f"{said} or {metres / per_px:.1f} px"
