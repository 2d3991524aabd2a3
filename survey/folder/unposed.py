"""A survey without poses: what structure from motion needs, and the views that it finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geo.crs import height_unit_m
from geo.frames import LocalFrame
from refract.lens import Lens
from survey.control.placing import require_near
from survey.display.words import named
from survey.errors import PosesError
from survey.folder.camera_faults import require_focal_lengths
from survey.folder.found import MIN_VIEWS, Found
from survey.folder.plausible import require_level_fits_exif
from survey.folder.shutter import shutter_doubts
from survey.folder.start_height import start_doubts
from survey.names import RUN_FOLDER, SFM_FOLDER
from survey.photos.cameras import View
from survey.photos.images import require_complete
from survey.photos.tie_points import TiePoints
from survey.sfm.gps import gps_positions
from survey.sfm.gps_fit import MIN_STD_M, require_area
from survey.sfm.settings import one_focal, require_size


@dataclass(frozen=True)
class SolvedViews:
    """Views that structure from motion placed.

    Attributes
    ----------
    frame : LocalFrame
    views : tuple of View
    ties : TiePoints
        The points that three views or more see, on straight rays; views are numbered as in `views`.
    assumptions, warnings : sentences
    """

    frame: LocalFrame
    views: tuple[View, ...]
    ties: TiePoints
    assumptions: tuple[str, ...]
    warnings: tuple[str, ...]


def require_solvable(found: Found) -> list[str]:
    """Warnings about a survey without poses that structure from motion can start with.

    Raises
    ------
    SurveyError, GeoError
        If it would fail: sizes, focal length, heights, positions and images are checked, no pixel is decoded.
    """
    cameras = found.config.cameras
    require_level_fits_exif(found.config, found.heads)
    require_size(found.images, found.heads, cameras.size_px)
    focal = one_focal(cameras.focal_px)
    positions = gps_positions(found.heads, found.crs, cameras.gps_height)
    local = np.array(list(positions.local.values()))
    require_area(local, MIN_STD_M)
    cameras_crs = positions.frame.crs_from_local(local)
    warnings = [] if found.control is None else require_near(found.control.points, cameras_crs, found.crs)
    if found.config.water is not None and found.config.water.level_m is not None:
        over_water = cameras_crs[:, 2] * height_unit_m(found.crs) - found.config.water.level_m
        warnings += start_doubts(dict(zip(positions.local, over_water.tolist(), strict=True)), found.heads)
    warnings += shutter_doubts(cameras, found.heads, None)
    for path in found.images.values():
        require_complete(path)
    if focal is None:
        return warnings
    sizes = {name: head.size_px for name, head in found.heads.items()}
    lenses = {name: Lens("SIMPLE_PINHOLE", (focal, 0.5 * w, 0.5 * h), w, h) for name, (w, h) in sizes.items()}
    return warnings + require_focal_lengths(lenses, found.heads)


def solve_views(found: Found, workspace: Path | None, report: Callable[[str], None] | None) -> SolvedViews:
    """The result of structure from motion.

    Raises
    ------
    SurveyError, GeoError
        As `require_solvable`, and where fewer than three poses are found.
    """
    warnings = require_solvable(found)
    # Slow to import, and needed only without poses.
    from survey.sfm.poses import solve_poses

    result = solve_poses(
        list(found.images.values()),
        found.crs,
        workspace or found.folder / RUN_FOLDER / SFM_FOLDER,
        gps_height=found.config.cameras.gps_height,
        size_px=found.config.cameras.size_px,
        focal_px=found.config.cameras.focal_px,
        report=report,
    )
    by_file = {path.name: name for name, path in found.images.items()}
    views = []
    for file_name, lens, centre, cam_from_local in result.views:
        name = file_name if file_name in found.images else by_file[Path(file_name).name]
        views.append(View(name, found.images[name], lens.camera(centre, cam_from_local), lens))
    if len(views) < MIN_VIEWS:
        raise PosesError(
            f"structure from motion found the poses of {len(views)} of {len(found.images)} images, expected at least "
            f"{MIN_VIEWS}; give poses made elsewhere in [cameras] poses"
        )
    solved = {view.name for view in views}
    without = [name for name in found.images if name not in solved]
    warnings += named(without, "image", "without a pose, left out")
    return SolvedViews(result.frame, tuple(views), result.ties, tuple(result.notes), tuple(warnings))
