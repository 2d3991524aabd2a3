"""Pre-analysis: can the photographs determine a level that is not given, by their directions of view?"""

from __future__ import annotations

import math

import numpy as np

from survey.errors import FILE_NAME
from survey.folder.found import Found
from survey.folder.survey import Survey
from survey.photos.cameras import level_from_yaw_pitch_roll

# Views within this angle of the vertical look straight down. Of blocks of these alone the adjustment leaves the level
# uncertain by 0.1 to 3 m, where 0.05 m would be of use; with a tenth of oblique views it begins to tell it
# (docs/adjustment.md).
DOWN_DEG, FEWEST_OBLIQUE = 10.0, 0.1
GIVE_LEVEL = (
    f"give the level in [water] in {FILE_NAME} (level_m as read at a staff, or shoreline, gnss_points, gauge or "
    "clicks), or add crossing photographs tilted by 25 to 35 degrees"
)
_NO_CLOUD = f"they hardly ever determine the level, without which there is no cloud; {GIVE_LEVEL}"


def level_doubt(found: Found, survey: Survey | None) -> str | None:
    """Warning where an adjustment will hardly determine the level; None where one is given, or it may.

    Parameters
    ----------
    survey : Survey or None
        None where the poses are not known yet: XMP may have the attitudes of the cameras.
    """
    water = found.config.water
    is_given = water is None or water.level_m is not None or water.sources.clicks is not None
    if is_given or (survey is not None and survey.provenance.is_level_known):
        return None
    tilts = (
        _tilts_of_heads(found)
        if survey is None
        else tilts_deg(np.array([v.camera.cam_from_local for v in survey.views]))
    )
    if not len(tilts):
        return (
            "the level of the water is not given, and the viewing directions of the photographs are not known yet: "
            f"where nearly all look straight down {_NO_CLOUD}"
        )
    down = int((tilts <= DOWN_DEG).sum())
    if len(tilts) - down >= FEWEST_OBLIQUE * len(tilts):
        return None
    return (
        f"the level of the water is not given, and {down} of {len(tilts)} photographs look straight down (within "
        f"{DOWN_DEG:g} degrees): {_NO_CLOUD}"
    )


def tilts_deg(cam_from_local: np.ndarray) -> np.ndarray:
    """Angles (V,) [deg] between the directions of views and straight down, from rotations (V, 3, 3)."""
    return np.degrees(np.arccos(np.clip(-cam_from_local[:, 2, 2], -1.0, 1.0)))


def _tilts_of_heads(found: Found) -> np.ndarray:
    """Tilts by the attitudes in XMP, of the photographs that have one."""
    gimbals = [head.motion.gimbal_deg for head in found.heads.values() if head.motion.gimbal_deg is not None]
    rotations = [
        level_from_yaw_pitch_roll(math.radians(yaw), math.radians(pitch + 90.0), math.radians(roll)).T
        for yaw, pitch, roll in gimbals
    ]
    return tilts_deg(np.array(rotations).reshape(-1, 3, 3))
