"""Two photographs without poses: what structure from motion cannot find from them and the survey has to say."""

from __future__ import annotations

import math

import numpy as np

from survey.errors import FILE_NAME, ImageError, PosesError
from survey.folder.block_control import control_of_block, of_two_marks
from survey.folder.found import Found
from survey.folder.pose_priors import GPS_STD_M, best_plan_std
from survey.sfm.gps import gps_positions
from survey.sfm.settings import one_focal

# With the distance of two positions known no better than to this share, heights over the bed are too wrong to be told a
# standard deviation.
_MOST_SCALE_STD = 0.1


def require_focal(found: Found) -> None:
    """Raise ImageError where nothing tells the focal length of two photographs: over flat ground they do not."""
    known = one_focal(found.config.cameras.focal_px) is not None
    lacking = [name for name, head in found.heads.items() if head.focal_px is None]
    if len(found.heads) == 2 and lacking and not known:
        raise ImageError(
            f"{lacking[0]} has no focal length in EXIF, and two photographs do not tell it; give [cameras] focal_px in "
            f"{FILE_NAME}"
        )


def require_scale(found: Found) -> None:
    """Raise PosesError where two GPS positions are too near to each other, as good as they are, to tell the scale."""
    if len(found.heads) != 2:
        return
    cameras = found.config.cameras
    positions = list(gps_positions(found.heads, found.crs, cameras.gps_height).local.values())
    apart = float(np.linalg.norm(positions[0] - positions[1]))
    std = best_plan_std(cameras, found.heads.values())
    said = "good to" if math.isfinite(std) else "of unstated accuracy, taken as"
    std = std if math.isfinite(std) else GPS_STD_M
    share = math.sqrt(2.0) * std / max(apart, 1e-9)
    if share > _MOST_SCALE_STD:
        raise PosesError(
            f"the scale of two photographs is not known: their GPS positions lie {apart:.3g} m apart, {said} {std:.2g} "
            f"m each, which tells it to {100.0 * share:.0f} %, and {100.0 * _MOST_SCALE_STD:.0f} % would be of use; "
            f"give three control points that both show ([control] gcps{_marked(found)}), or [cameras] position_std_m "
            "if they are better"
        )


def _marked(found: Found) -> str:
    """How many control points there are that both show, as a part of a sentence; empty without control."""
    control = control_of_block(found)
    if control is None:
        return ""
    return f"; of {len(control.points)} there, {len(of_two_marks(control))} are marked in both"
