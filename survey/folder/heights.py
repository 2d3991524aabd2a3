"""Inconsistent lenses, poses and vertical datums: faults that only several numbers together reveal.

A focal length in the wrong unit, angles in radians, one pose for all photographs; cameras and water in different
vertical datums; an implausible height of the take-off point over the water. What cannot be true of any survey is an
error; what is unlikely is a warning.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from pyproj import CRS
from scipy.spatial.transform import Rotation

from geo.compatibility import approximate_undulation_m
from geo.crs import height_unit_m, middle_lon_lat, vertical_crs
from geo.transformation import lon_lat
from refract.lens import Lens
from survey.display.quantities import named
from survey.errors import ConfigError, PosesError
from survey.photos.cameras import View
from survey.photos.exif import Exif
from survey.photos.poses import CAM_FROM_OPK_CAM, Pose, PoseFrame, grid_from_opk
from survey.photos.xmp import ELLIPSOIDAL

# Diagonal field of view [degrees] of a pinhole of the same focal length: a fisheye lens of 180 degrees has 115, the
# longest lens of a drone 3.
_WIDEST_DEG, _NARROWEST_DEG = 135.0, 1.0
# Below this only the longest lenses lie; a common lens whose focal length is ten times too long does too.
_NARROW_DEG = 12.0
# EXIF has design values of the whole sensor. Photographs may be cropped or enlarged somewhat, but not to a fifth.
_DOUBTFUL_RATIO, _WRONG_RATIO = 1.5, 5.0
# Cameras closer together than this show no parallax.
_ONE_PLACE_M = 0.01
# Angles in radians are below this; so may angles in degrees be, where all views look down and north.
_FULL_TURN = 2.0 * math.pi + 0.01
_LOOKS_DOWN = math.cos(math.radians(75.0))
# A gimbal keeps the rows of an image level to this sine. Degrees read as radians tilt rows at random.
_LEVEL_ROWS = 0.03
# In simulated surveys rows are exactly level, to the written digits [degrees].
_EXACT = 1e-4


def require_focal_lengths(lenses: dict[str, Lens], headers: dict[str, Exif]) -> list[str]:
    """Warnings about focal lengths, by name of the image, that disagree with EXIF."""
    warnings: list[str] = []
    for name, lens in lenses.items():
        degrees = 2.0 * math.degrees(math.atan(0.5 * math.hypot(lens.width, lens.height) / min(lens.focal)))
        if not _NARROWEST_DEG < degrees < _WIDEST_DEG:
            by_exif = headers[name].focal_px
            raise ConfigError(
                f"the focal length of {name} is {min(lens.focal):g} px, so that its {lens.width} x {lens.height} px "
                f"span {degrees:.1f} degrees from corner to corner, expected {_NARROWEST_DEG:g} to {_WIDEST_DEG:g}; "
                f"give it in pixels of these images{'' if by_exif is None else f'; EXIF gives {by_exif:.0f} px'}"
            )
        if degrees < _NARROW_DEG and not warnings:
            warnings.append(
                f"the focal length of {name} is {min(lens.focal):g} px, a view of {degrees:.1f} degrees from "
                "corner to corner; check that it is in pixels of these images, unless it is a telephoto lens"
            )
    known = {
        name: header.focal_px for name, header in headers.items() if name in lenses and header.focal_px is not None
    }
    if not known:
        return warnings
    ratios = [lenses[name].focal[0] / by_exif for name, by_exif in known.items()]
    name = list(known)[int(np.argsort(ratios)[len(ratios) // 2])]
    focal, by_exif = lenses[name].focal[0], known[name]
    ratio = focal / by_exif
    message = f"the focal length of {name} is {focal:g} px, and EXIF gives {by_exif:.0f} px"
    if max(ratio, 1.0 / ratio) > _WRONG_RATIO:
        raise ConfigError(
            f"{message}, expected a factor of at most {_WRONG_RATIO:g} between them; give it in pixels of these "
            "images, in [cameras] focal_px or in the poses file"
        )
    if max(ratio, 1.0 / ratio) > _DOUBTFUL_RATIO:
        warnings.append(f"{message}; check that it is in pixels of these images, unless they are cropped")
    return warnings


def require_apart(views: list[View], over_water: np.ndarray | None) -> list[str]:
    """Warnings about views that share a pose; ``over_water`` are their heights (N,) [m], None for a dry survey."""
    centres = np.array([view.camera.centre for view in views])
    if np.ptp(centres, axis=0).max() < _ONE_PLACE_M:
        raise PosesError(
            f"all {len(views)} cameras are at one place within {1000.0 * _ONE_PLACE_M:.0f} mm, expected places some "
            "metres apart; give each photograph its own pose"
        )
    warnings = [] if over_water is None else _overlap_warnings(views, over_water)
    poses = [(*view.camera.centre, *view.camera.cam_from_local.ravel()) for view in views]
    first = {pose: i for i, pose in reversed(list(enumerate(poses)))}
    repeated = [view.name for i, view in enumerate(views) if first[poses[i]] != i]
    return warnings + named(repeated, "image", "with the pose of another one")


def _overlap_warnings(views: list[View], over_water: np.ndarray) -> list[str]:
    """Warnings about views that overlap no other; circles around footprints allow for a bed far below the water."""
    places, radii = [], []
    for view, height in zip(views, over_water.tolist(), strict=True):
        camera = view.camera
        # Along the optical axis; at most three flying heights for views to the horizon.
        falling = max(-camera.cam_from_local[2, 2], 1.0 / 3.0)
        along = height / falling
        places.append((camera.centre + along * camera.cam_from_local[2])[:2])
        radii.append(0.5 * along * math.hypot(camera.width / camera.fx, camera.height / camera.fy) / falling)
    # Distance from each circle to the nearest other; below zero where they overlap.
    gaps, middles, reach = np.empty(len(places)), np.array(places), np.array(radii)
    for i, (place, radius) in enumerate(zip(middles, radii, strict=True)):
        others = np.hypot(*(middles - place).T) - reach - radius
        others[i] = np.inf
        gaps[i] = others.min()
    alone = gaps > 0.0
    if alone.mean() > 0.5:
        gap = np.median(gaps[alone])
        raise PosesError(
            f"{alone.sum()} of {len(views)} views overlap no other at the water: one covers "
            f"{2.0 * np.median(radii):.2f} m, and the next one begins {gap:.2f} m away, expected an overlap of "
            "half a view or more; correct the focal length, the positions or [water] level_m"
        )
    names = [view.name for view, is_alone in zip(views, alone, strict=True) if is_alone]
    return named(names, "view", "without overlap with another one at the water")


def angle_warnings(poses: list[Pose], frame: PoseFrame) -> list[str]:
    """Warning where omega, phi and kappa look like radians.

    All are below a full turn in radians. Read as radians, all cameras look down with level image rows, as on a gimbal,
    in nadir and oblique views alike. In addition they turn by more than a radian, or else rows would, as degrees, be
    level to a thirtieth of a degree, which no gimbal achieves.
    """
    if frame is not PoseFrame.GRID:
        return []
    # Of intrinsic turns about x, y and z, the inverse of `survey.photos.poses.grid_from_opk`.
    grid_from_opk_cam = np.array([pose.cam_from_world.T for pose in poses]) @ CAM_FROM_OPK_CAM
    angles = Rotation.from_matrix(grid_from_opk_cam).as_euler("XYZ", degrees=True)
    tilts = float(np.median(np.abs(angles[:, 1])))
    if np.abs(angles).max() > _FULL_TURN or (np.ptp(angles[:, 2]) < 1.0 and not _EXACT < tilts < _LEVEL_ROWS):
        return []
    as_radians = np.array([grid_from_opk(*three) for three in angles])
    looks_down = (as_radians[:, 2, 2] > _LOOKS_DOWN).all()
    has_level_rows = np.median(np.abs(as_radians[:, 2, 0])) < _LEVEL_ROWS
    if not (looks_down and has_level_rows):
        return []
    most = np.abs(angles).max()
    return [f"omega, phi, kappa are at most {most:.2f} and look like radians, expected degrees: multiply by 57.29578"]


# A barometer drifts by some metres during a flight, and a drone may start from a boat.
UNDER_WATER_M = 5.0
# Take-off points are rarely higher above the water than this; with mixed up ellipsoid and geoid they often seem to be.
ABOVE_WATER_M = 30.0
# Usual flying heights for bathymetry, where the height over the take-off point is not known.
_LOWEST_FLIGHT_M, _HIGHEST_FLIGHT_M = 2.0, 150.0
# The geoid undulation is approximate to some metres here, and so are heights in EXIF.
_ROUGH_M = 10.0
_FOOT_M = 0.3048
# Tolerance for heights over the take-off point that were given as heights in crs.
_SAME_M = 3.0


def place_of(crs: CRS, point_crs: np.ndarray) -> tuple[float, float]:
    """Latitude and longitude [deg] of a point in crs."""
    lon, lat = lon_lat(crs, np.asarray(point_crs, dtype=np.float64)[None])[0]
    return float(lat), float(lon)


def above_start_of(headers: Mapping[str, Exif]) -> float | None:
    """The median height [m] over the take-off point, by XMP; None where no photograph has one."""
    heights = [header.above_start_m for header in headers.values() if header.above_start_m is not None]
    return float(np.median(heights)) if heights else None


def explanation(
    over_m: float, level_m: float, place: tuple[float, float], crs: CRS, above_start_m: float | None
) -> str:
    """Explanation of cameras `over_m` over the water, as the rest of a sentence; empty without one.

    Heights [m] are medians: over the water, over the take-off point. ``place`` is latitude and longitude [deg].
    """
    cameras_m, unit = level_m + over_m, height_unit_m(crs)
    undulation = approximate_undulation_m(*place)
    side = "over" if undulation > 0.0 else "under"
    geoid = f"the geoid lies about {abs(undulation):.0f} m {side} the ellipsoid here"
    candidates = [
        (over_m - undulation, f"{geoid}, and heights of the cameras above the ellipsoid with a level above the sea"),
        (over_m + undulation, f"{geoid}, and a level above the ellipsoid with heights of the cameras above the sea"),
    ]
    if above_start_m is not None and abs(cameras_m - above_start_m) < _SAME_M:
        candidates.append((above_start_m, "heights of the cameras over the take-off point instead of heights in crs"))
    if unit != 1.0:
        candidates.append((cameras_m - level_m * unit, "a level in the unit of crs instead of metres"))
    else:
        candidates.append((cameras_m * _FOOT_M - level_m, "heights of the cameras in feet"))
    lowest, highest = _LOWEST_FLIGHT_M, _HIGHEST_FLIGHT_M
    if above_start_m is not None:
        lowest, highest = above_start_m - UNDER_WATER_M - _ROUGH_M, above_start_m + ABOVE_WATER_M + _ROUGH_M
    found = [
        f"{words} would explain it: the cameras would be {over:.0f} m over the water"
        for over, words in candidates
        if lowest <= over <= highest and abs(over - over_m) > _LOWEST_FLIGHT_M
    ]
    return f"; {'; or '.join(found)}" if found else ""


def low_flight_warnings(over_m: np.ndarray, level_m: float, place: tuple[float, float], crs: CRS) -> list[str]:
    """A warning where cameras (N,) [m] over the water fly nearly on it."""
    middle = float(np.median(over_m))
    if not 0.0 < middle < _LOWEST_FLIGHT_M:
        return []
    return [
        f"the cameras are only {middle:.2f} m over the water (median): check that level_m and the heights of the "
        f"cameras count from the same{explanation(middle, level_m, place, crs, None)}"
    ]


def exif_height_warnings(heights_m: Mapping[str, float], headers: Mapping[str, Exif]) -> list[str]:
    """A warning where poses and EXIF differ in height by as much as the geoid and the ellipsoid do."""
    if above_start_of(headers) is not None:
        return []  # `start_height_warnings` is more specific
    known = [(name, header.lat_lon_height) for name, header in headers.items() if name in heights_m]
    pairs = [(heights_m[name], position) for name, position in known if position is not None]
    pairs = [(height, position) for height, position in pairs if np.isfinite(position[2])]
    if not pairs:
        return []
    higher = float(np.median([height - position[2] for height, position in pairs]))
    lon, lat = middle_lon_lat(np.array([position[1::-1] for _, position in pairs])).tolist()
    undulation = approximate_undulation_m(lat, lon)
    if abs(undulation) < 2.0 * _ROUGH_M or abs(abs(higher) - abs(undulation)) > _ROUGH_M:
        return []
    return [
        f"the poses lie {abs(higher):.0f} m {'above' if higher > 0.0 else 'below'} the heights in EXIF, about as much "
        f"as the geoid differs from the ellipsoid here ({undulation:.0f} m): one of them counts from the ellipsoid; "
        "check that [water] level_m has the datum of the poses"
    ]


def xmp_height_warnings(gps_height: str, crs: CRS, headers: Mapping[str, Exif]) -> list[str]:
    """A warning where XMP says that GPS heights count from something else than `gps_height` takes them for."""
    vertical = vertical_crs(crs)
    datums = [header.height_datum for header in headers.values() if header.height_datum is not None]
    if not datums or vertical is None:
        return []
    ellipsoidal = sum(datum == ELLIPSOIDAL for datum in datums)
    if gps_height == "crs" and ellipsoidal > len(datums) / 2:
        return [
            f"XMP says that the heights of {ellipsoidal} of {len(headers)} images count from the ellipsoid, and "
            f'gps_height = "crs" takes them as {vertical.name}: write gps_height = "ellipsoidal" in [cameras], and '
            "level_m in the heights of crs"
        ]
    if gps_height == "ellipsoidal" and ellipsoidal < len(datums) / 2:
        other = next(datum for datum in datums if datum != ELLIPSOIDAL)
        return [
            f'gps_height = "ellipsoidal", but XMP says that the heights of {len(datums) - ellipsoidal} of '
            f'{len(headers)} images count from {other}: write gps_height = "crs" in [cameras] if that is the '
            "datum of crs"
        ]
    return []


def start_height_warnings(
    over_water: Mapping[str, float], headers: Mapping[str, Exif], level_m: float, place: tuple[float, float], crs: CRS
) -> list[str]:
    """Warning where cameras, water and the drone's height over its take-off point are inconsistent."""
    starts = [
        over - above
        for name, over in over_water.items()
        if (above := headers[name].above_start_m) is not None and np.isfinite(over)
    ]
    if not starts:
        return []
    start = float(np.median(starts))
    if -UNDER_WATER_M <= start <= ABOVE_WATER_M:
        return []
    over = float(np.median(list(over_water.values())))
    side = f"{-start:.1f} m under" if start < 0.0 else f"{start:.1f} m over"
    return [
        f"the cameras are {over:.1f} m over the water (median), and by RelativeAltitude in XMP {over - start:.1f} m "
        f"over the take-off point, which would lie {side} the water; check that [water] level_m and the heights of the "
        f"cameras have the same vertical datum{explanation(over, level_m, place, crs, over - start)}"
    ]
