"""A survey without poses: what structure from motion needs, tests of its level before that, and the views it finds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pyproj import CRS
from scipy.spatial import KDTree

from geo.crs import EARTH_RADIUS_M, height_unit_m, middle_lon_lat
from refract.lens import Lens
from survey.control.reading import require_near
from survey.display.quantities import distance_text, named
from survey.errors import ControlError, Findings, ImageError, PosesError
from survey.folder.checked_control import control_of_block, may_hold_roll, require_placing_control, with_two_marks
from survey.folder.faults import (
    above_start_of,
    explanation,
    place_of,
    require_focal_lengths,
    start_height_warnings,
    xmp_height_warnings,
)
from survey.folder.found import Found
from survey.folder.motion import shutter_warnings
from survey.folder.plausible import (
    AIRCRAFT_HEIGHT_M,
    DRONE_HEIGHT_M,
    MOST_OF_OVERLAP,
    USUAL_OVERLAP,
    require_level_fits,
)
from survey.folder.pose_priors import GPS_STD_M, best_plan_std, common_up_std_of_exif
from survey.photos.exif import Exif
from survey.photos.images import require_all_complete
from survey.photos.pixels import HEIC_SUFFIXES
from survey.photos.poses import least_track
from survey.settings.config import SurveyConfig
from survey.sfm.control_fit import BlockControl, line_of_control
from survey.sfm.gps import gps_positions, is_whole, positions_in_crs, require_accurate, transforms_into_crs
from survey.sfm.gps_fit import FOCAL_SHARE, MIN_STD_M, ROLL_REMEDY, is_contradicted, line_of
from survey.sfm.settings import one_focal, require_size, require_solver
from survey.words import RUN_FOLDER, SFM_FOLDER

if TYPE_CHECKING:
    from survey.sfm.poses import SfmResult

# Heights in EXIF are not off by more standard deviations of what they have in common.
_MOST_STD = 3.0
# Of the shorter side of a photograph over its focal length, of the lenses of drones.
_SHORT_SIDE = 0.6
# With the distance of two positions known no better than to this share, heights over the bed are too wrong to be told a
# standard deviation.
_MOST_SCALE_STD = 0.1


def require_level_fits_exif(config: SurveyConfig, headers: Mapping[str, Exif], crs: CRS) -> None:
    """Raise where the level cannot fit the heights in EXIF, which structure from motion would use."""
    places = np.array([h.lat_lon_height for h in headers.values() if h.lat_lon_height is not None]).reshape(-1, 3)
    places = places[np.isfinite(places).all(axis=1)]
    heights = places[:, 2]
    if config.water is None or config.water.level_m is None or config.cameras.gps_height != "crs" or not heights.size:
        return
    over_water = heights - config.water.known_level_m
    lon, lat = middle_lon_lat(places[:, 1::-1]).tolist()
    why = explanation(
        float(np.median(over_water)), config.water.known_level_m, (lat, lon), crs, above_start_of(headers)
    )
    unknown_m = _MOST_STD * common_up_std_of_exif(config.cameras, headers)
    if why and config.cameras.position_std_m is None:
        unknown_m = 0.0
    most_m = DRONE_HEIGHT_M if why else _most_over_water(places)
    if over_water.max() > -unknown_m and over_water.min() <= most_m + unknown_m:
        return
    like = f"the heights in EXIF{why}; if they are a barometer's, say so: [cameras] position_std_m = [3, 3, 80]"
    require_level_fits(config.water, "EXIF has the cameras", heights, over_water, like, most_m=most_m)


def _most_over_water(places: np.ndarray) -> float:
    """Height over the water [m] that cameras at places (N, 3) can have, by how far apart they are.

    As `survey.folder.plausible.most_over_water` for lenses that are not known yet.
    """
    metres = EARTH_RADIUS_M * np.radians(places[:, :2]) * [1.0, np.cos(np.radians(np.median(places[:, 0])))]
    base = float(np.median(KDTree(metres).query(metres, k=2)[0][:, 1])) if len(places) > 1 else 0.0
    by_overlap = base / ((1.0 - USUAL_OVERLAP) * _SHORT_SIDE)
    return float(np.clip(MOST_OF_OVERLAP * by_overlap, DRONE_HEIGHT_M, AIRCRAFT_HEIGHT_M))


def require_solvable(found: Found) -> list[str]:
    """Warnings about a survey without poses that structure from motion can start with."""
    require_solver()
    cameras = found.config.cameras
    require_level_fits_exif(found.config, found.headers, found.crs)
    for transform in transforms_into_crs(found.headers, found.crs, cameras.gps_height):
        std = best_plan_std(cameras, [found.headers[name] for name in transform.names])
        require_accurate(transform.plan, std, transform.label, len(found.control.given))
    require_size(found.images, found.headers, cameras.size_px)
    focal = one_focal(cameras.focal_px)
    require_focal(found)
    if placing_control(found) is None:
        require_scale(found)
    positions, _ = positions_in_crs(found.headers, found.crs, cameras.gps_height)
    warnings: list[str] = []
    if positions:
        cameras_crs = np.array(list(positions.values()))
        warnings += require_near(found.control.points, cameras_crs, found.crs)
        if found.config.water is not None and found.config.water.level_m is not None:
            over_water = cameras_crs[:, 2] * height_unit_m(found.crs) - found.config.water.level_m
            over = dict(zip(positions, over_water.tolist(), strict=True))
            at = place_of(found.crs, np.median(cameras_crs, axis=0))
            warnings += start_height_warnings(over, found.headers, found.config.water.level_m, at, found.crs)
    warnings += xmp_height_warnings(cameras.gps_height, found.crs, found.headers)
    warnings += shutter_warnings(cameras, found.headers, None)
    _require_readable(found.images)
    if focal is None:
        return warnings
    sizes = {name: header.size_px for name, header in found.headers.items()}
    lenses = {name: Lens("SIMPLE_PINHOLE", (focal, 0.5 * w, 0.5 * h), w, h) for name, (w, h) in sizes.items()}
    return warnings + require_focal_lengths(lenses, found.headers)


def _require_readable(images: Mapping[str, Path]) -> None:
    """Raise ImageError where an image is cut off, or of a format that structure from motion does not read."""
    for path in images.values():
        if path.suffix.lower() in HEIC_SUFFIXES:
            raise ImageError(
                f"{path} is HEIC, which structure from motion does not read; convert the images to JPEG with their "
                "EXIF, or give poses made elsewhere in [cameras] poses"
            )
    require_all_complete(images.values())


def placing_control(found: Found) -> BlockControl | None:
    """The control that places a block of photographs; None where GPS positions do."""
    num = sum(is_whole(header.lat_lon_height) for header in found.headers.values())
    if num < least_track(len(found.headers)):
        return require_placing_control(found)
    positions = gps_positions(found.headers, found.crs, found.config.cameras.gps_height)
    line = line_of(list(positions.local.values()), MIN_STD_M)
    if line is None:
        return None
    control = control_of_block(found)
    if control is not None and _spans_area(found):
        return control
    if not may_hold_roll(found) and (control is None or not control.marks):
        raise PosesError(f"{line.describe(len(positions.local))}; {ROLL_REMEDY}")
    return None


def _spans_area(found: Found) -> bool:
    """Whether control points place the survey without anything else."""
    try:
        control = require_placing_control(found)
    except ControlError:
        return False
    return line_of_control(with_two_marks(control)) is None


def solve_views(
    found: Found, workspace: Path | None, report: Callable[[str], None] | None
) -> tuple[SfmResult, set[str], Findings]:
    """The result of structure from motion, and names of photographs whose GPS positions it contradicts.

    These positions count for nothing before the adjustment.
    """
    warnings = require_solvable(found)
    # Slow to import, and needed only without poses.
    from survey.sfm.poses import solve_poses

    control, water = placing_control(found), found.config.water
    result = solve_poses(
        found.images,
        found.headers,
        found.config.cameras,
        found.crs,
        workspace or found.folder / RUN_FOLDER / SFM_FOLDER,
        level_m=None if water is None else water.level_m,
        control=control,
        # Of blocks that fall apart, positions may place one and control another.
        spare_control=control_of_block(found) if control is None else None,
        report=report,
    )
    if len(result.views) < (least := least_track(len(found.images))):
        raise PosesError(
            f"structure from motion found the poses of {len(result.views)} of {len(found.images)} images, expected at "
            f"least {least}; give poses made elsewhere in [cameras] poses"
        )
    solved = {view.name for view in result.views}
    warnings += named([name for name in found.images if name not in solved], "image", "without a pose, left out")
    rejected = _rejected_positions(result)
    parts = [f"{name} (by {distance_text(metres)})" for name, metres in rejected.items()]
    warnings += named(
        parts, "GPS position", "that the block contradicts on straight rays, left out before the adjustment"
    )
    return result, set(rejected), Findings(tuple(result.notes), tuple(warnings))


def _rejected_positions(result: SfmResult) -> dict[str, float]:
    """Distance [m] of each GPS position that the block contradicts, by name."""
    residuals = result.gps_residual_m - _heights_by_focals(result)
    return {
        view.name: float(np.linalg.norm(residual))
        for view, residual, is_wrong in zip(result.views, residuals, is_contradicted(residuals), strict=True)
        if is_wrong
    }


def _heights_by_focals(result: SfmResult) -> np.ndarray:
    """Heights (V, 3) [m] by which all positions of a camera seem off together, up to what its focal length explains.

    A focal length acts as a flying height does, and straight rays over water put it some per cent off.
    """
    residuals, ground = result.gps_residual_m, np.median(result.ties.start[:, 2])
    known, off = np.isfinite(residuals).all(axis=1), np.zeros_like(residuals)
    for lens in dict.fromkeys(view.lens for view in result.views):
        own = np.array([view.lens == lens for view in result.views])
        if (own & known).any():
            up = np.median(residuals[own & known, 2]) - np.median(residuals[known, 2])
            flown = np.median([view.camera.centre[2] for view in result.views if view.lens == lens]) - ground
            off[own, 2] = up if abs(up) < FOCAL_SHARE * flown else 0.0
    return off


def require_focal(found: Found) -> None:
    """Raise ImageError where two photographs have no focal length: over flat ground they do not determine it."""
    known = one_focal(found.config.cameras.focal_px) is not None
    lacking = [name for name, header in found.headers.items() if header.focal_px is None]
    if len(found.headers) == 2 and lacking and not known:
        raise ImageError(f"{lacking[0]} has no focal length in EXIF and two images tell none; give [cameras] focal_px")


def require_scale(found: Found) -> None:
    """Raise PosesError where two GPS positions are too close, for their accuracy, to determine the scale."""
    if len(found.headers) != 2:
        return
    cameras = found.config.cameras
    positions = list(gps_positions(found.headers, found.crs, cameras.gps_height).local.values())
    distance = float(np.linalg.norm(positions[0] - positions[1]))
    std = best_plan_std(cameras, found.headers.values())
    message = "good to" if math.isfinite(std) else "of unstated accuracy, taken as"
    std = std if math.isfinite(std) else GPS_STD_M
    share = math.sqrt(2.0) * std / max(distance, 1e-9)
    if share > _MOST_SCALE_STD:
        raise PosesError(
            f"the scale of two photographs is not known: their GPS positions lie {distance:.3g} m apart, {message} "
            f"{std:.2g} m each, which tells it to {100.0 * share:.0f} %, and {100.0 * _MOST_SCALE_STD:.0f} % would be "
            f"of use; give three control points that both show ([control] gcps{_marked(found)}), or [cameras] "
            "position_std_m if they are better"
        )


def _marked(found: Found) -> str:
    """Number of control points that both show, as a part of a sentence; empty without control."""
    control = control_of_block(found)
    if control is None:
        return ""
    return f"; of {len(control.points)} there, {len(with_two_marks(control))} are marked in both"
