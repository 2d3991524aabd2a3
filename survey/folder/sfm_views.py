"""A survey without poses: what structure from motion needs, tests of its level before that, and the views it finds."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geo.crs import EARTH_RADIUS_M, height_unit_m, middle_lon_lat
from refract.lens import Lens
from survey.control.reading import require_near
from survey.display.quantities import distance_text, named
from survey.errors import FILE_NAME, ControlError, Findings, ImageError, PosesError, SurveyError
from survey.folder import heights as height_checks
from survey.folder.checked_control import control_of_block, may_hold_roll, require_placing_control, with_two_marks
from survey.folder.found import Found
from survey.folder.observations import shutter_warnings
from survey.folder.plausible import height_by_overlap, most_over_water, require_focal_lengths
from survey.folder.pose_priors import GPS_STD_M, best_plan_std, common_up_std_of_exif
from survey.photos.images import require_all_complete
from survey.photos.pixels import HEIC_SUFFIXES, require_pixels
from survey.photos.poses import least_track
from survey.sfm.control_fit import BlockControl, line_of_control
from survey.sfm.gps import gps_positions, is_whole, positions_in_crs, require_accurate, transforms_into_crs
from survey.sfm.gps_fit import FOCAL_SHARE, MIN_STD_M, ROLL_REMEDY, is_contradicted, line_of
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


def require_level_fits_exif(found: Found) -> None:
    """Raise where the level cannot fit the heights in EXIF, which structure from motion would use."""
    config, headers, water = found.config, found.headers, found.config.water
    places = np.array([h.lat_lon_height for h in headers.values() if h.lat_lon_height is not None]).reshape(-1, 3)
    places = places[np.isfinite(places).all(axis=1)]
    if water is None or water.level_m is None or config.cameras.gps_height != "crs" or not len(places):
        return
    heights = places[:, 2]
    over_water = heights - water.level_m
    lon, lat = middle_lon_lat(places[:, 1::-1]).tolist()
    why = height_checks.explanation(
        float(np.median(over_water)), water.level_m, (lat, lon), found.crs, height_checks.above_start_of(headers)
    )
    unknown_m = _MOST_STD * common_up_std_of_exif(config.cameras, headers)
    most_m = height_checks.DRONE_HEIGHT_M
    if why and config.cameras.position_std_m is None:
        unknown_m = 0.0
    if not why:
        metres = EARTH_RADIUS_M * np.radians(places[:, :2]) * [1.0, np.cos(np.radians(np.median(places[:, 0])))]
        most_m = most_over_water(height_by_overlap(metres, _SHORT_SIDE))
    if over_water.max() > -unknown_m and over_water.min() <= most_m + unknown_m:
        return
    like = f"the heights in EXIF{why}; if they are a barometer's, say so: [cameras] position_std_m = [3, 3, 80]"
    height_checks.require_level_fits(water, "EXIF has the cameras", heights, over_water, like, most_m=most_m)


def require_solver(module: str = "pycolmap") -> None:
    """Raise SurveyError where structure from motion is not installed: there is no pycolmap for every machine."""
    if find_spec(module) is None:
        raise SurveyError(
            "the survey has no poses, and pycolmap, which finds them from the photographs, is not installed; it has no "
            "package for Linux on ARM (aarch64). Name a file of poses in [cameras] poses, e.g. of Metashape, "
            "OpenDroneMap or COLMAP, or run structure from motion on another machine"
        )


def require_solvable(found: Found) -> list[str]:
    """Warnings about a survey without poses that structure from motion can start with."""
    require_solver()
    cameras, headers, crs = found.config.cameras, found.headers, found.crs
    require_level_fits_exif(found)
    for transform in transforms_into_crs(headers, crs, cameras.gps_height):
        std = best_plan_std(cameras, [headers[name] for name in transform.names])
        require_accurate(transform.plan, std, transform.label, len(found.control.given))
    if cameras.size_px is not None:
        remedy = f"correct it in {FILE_NAME}, or leave the image out"
        for name, header in headers.items():
            require_pixels(found.images[name], header.size_px, cameras.size_px, "[cameras] size_px", remedy)
    focal = cameras.square_focal_px
    lacking = [name for name, header in headers.items() if header.focal_px is None]
    if len(headers) == 2 and lacking and focal is None:
        # Over flat ground two photographs do not determine it.
        raise ImageError(f"{lacking[0]} has no focal length in EXIF and two images tell none; give [cameras] focal_px")
    if placing_control(found) is None:
        _require_scale(found)
    positions, _ = positions_in_crs(headers, crs, cameras.gps_height)
    warnings: list[str] = []
    if positions:
        in_crs = np.array(list(positions.values()))
        warnings += require_near(found.control.points, in_crs, crs)
        if found.config.water is not None and (level_m := found.config.water.level_m) is not None:
            over = dict(zip(positions, (in_crs[:, 2] * height_unit_m(crs) - level_m).tolist(), strict=True))
            at = height_checks.place_of(crs, np.median(in_crs, axis=0))
            warnings += height_checks.start_height_warnings(over, headers, level_m, at, crs)
    warnings += height_checks.xmp_height_warnings(cameras.gps_height, crs, headers)
    warnings += shutter_warnings(cameras, headers, None)
    for path in found.images.values():
        if path.suffix.lower() in HEIC_SUFFIXES:
            raise ImageError(
                f"{path} is HEIC, which structure from motion does not read; convert the images to JPEG with their "
                "EXIF, or give poses made elsewhere in [cameras] poses"
            )
    require_all_complete(found.images.values())
    if focal is None:
        return warnings
    sizes = {name: header.size_px for name, header in headers.items()}
    lenses = {name: Lens("SIMPLE_PINHOLE", (focal, 0.5 * w, 0.5 * h), w, h) for name, (w, h) in sizes.items()}
    return warnings + require_focal_lengths(lenses, headers)


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
    if control is not None:
        # Whether control points place the survey without anything else.
        with suppress(ControlError):
            if line_of_control(with_two_marks(require_placing_control(found))) is None:
                return control
    if not may_hold_roll(found) and (control is None or not control.marks):
        raise PosesError(f"{line.describe(len(positions.local))}; {ROLL_REMEDY}")
    return None


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
    residuals = result.gps_residual_m - _heights_by_focals(result)
    rejected = {
        result.views[i].name: float(np.linalg.norm(residuals[i]))
        for i in np.flatnonzero(is_contradicted(residuals)).tolist()
    }
    parts = [f"{name} (by {distance_text(metres)})" for name, metres in rejected.items()]
    warnings += named(
        parts, "GPS position", "that the block contradicts on straight rays, left out before the adjustment"
    )
    return result, set(rejected), Findings(tuple(result.notes), tuple(warnings))


def _heights_by_focals(result: SfmResult) -> np.ndarray:
    """Offsets in height (V, 3) [m] of positions of a camera that a wrong focal length of it makes on straight rays."""
    residuals, ground = result.gps_residual_m, np.median(result.ties.start[:, 2])
    known, off = np.isfinite(residuals).all(axis=1), np.zeros_like(residuals)
    heights = np.array([view.camera.centre[2] for view in result.views])
    for lens in dict.fromkeys(view.lens for view in result.views):
        own = np.array([view.lens == lens for view in result.views])
        if (own & known).any():
            up = np.median(residuals[own & known, 2]) - np.median(residuals[known, 2])
            off[own, 2] = up if abs(up) < FOCAL_SHARE * (np.median(heights[own]) - ground) else 0.0
    return off


def _require_scale(found: Found) -> None:
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
        control = control_of_block(found)
        marked = (
            f"; of {len(control.points)} there, {len(with_two_marks(control))} are marked in both"
            if control is not None
            else ""
        )
        raise PosesError(
            f"the scale of two photographs is not known: their GPS positions lie {distance:.3g} m apart, {message} "
            f"{std:.2g} m each, which tells it to {100.0 * share:.0f} %, and {100.0 * _MOST_SCALE_STD:.0f} % would be "
            f"of use; give three control points in both ([control] gcps{marked}), or [cameras] position_std_m"
        )
