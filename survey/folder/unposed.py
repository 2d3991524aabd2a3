"""A survey without poses: what structure from motion needs, and the views that it finds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from geo.frames import LocalFrame
from refract.lens import Lens
from survey.errors import PosesError
from survey.folder.camera_faults import require_focal_lengths
from survey.folder.found import MIN_VIEWS, Found
from survey.folder.plausible import require_level_fits_exif
from survey.folder.words import named
from survey.names import RUN_FOLDER, SFM_FOLDER
from survey.photos.cameras import View
from survey.photos.formats import MIN_TRACK
from survey.photos.images import require_complete
from survey.sfm.gps import gps_positions
from survey.sfm.gps_fit import MIN_STD_M, require_area
from survey.sfm.settings import one_focal, require_size


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
    require_area(np.array(list(positions.local.values())), MIN_STD_M)
    for path in found.images.values():
        require_complete(path)
    if focal is None:
        return []
    sizes = {name: head.size_px for name, head in found.heads.items()}
    lenses = {name: Lens("SIMPLE_PINHOLE", (focal, 0.5 * w, 0.5 * h), w, h) for name, (w, h) in sizes.items()}
    return require_focal_lengths(lenses, found.heads)


def solve_views(
    found: Found, workspace: Path | None, report: Callable[[str], None] | None
) -> tuple[LocalFrame, list[View], np.ndarray, list[str], list[str]]:
    """The result of structure from motion: local frame, views and points, with assumptions and warnings.

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
    points = result.points[result.num_views >= MIN_TRACK]
    warnings += named(without, "image", "without a pose, left out")
    return result.frame, views, points, list(result.notes), warnings
