"""Lenses, places and directions of cameras that cannot be true, or are unlikely: faults that several numbers reveal.

What cannot be true of any survey is an error; what is unlikely is a warning.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Geod
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from geo.compatibility import bounds_in_other_order
from geo.crs import height_unit_m
from geo.frames import LocalFrame
from geo.transformation import lon_lat
from refract import PinholeCamera
from refract.lens import Lens
from survey.display.quantities import distance_text, named
from survey.errors import ConfigError, PosesError
from survey.folder.heights import (
    AIRCRAFT_HEIGHT_M,
    DRONE_HEIGHT_M,
    above_start_of,
    explanation,
    place_of,
    require_level_fits,
)
from survey.photos.cameras import View
from survey.photos.exif import Exif
from survey.photos.poses import CAM_FROM_OPK_CAM, Pose, PoseFrame, grid_from_opk
from survey.settings.config import SurveyConfig, WaterConfig

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
# Fewer pairs of axes do not determine a height.
_FEWEST_PAIRS = 10
# Usual overlap along the flight line; used only where nothing else determines the height of dry ground.
USUAL_OVERLAP = 0.75
# Pairs of more cameras than this would fill the memory; every second or third camera gives the same result.
_MOST_PAIRED = 1500
# Photographs of one survey overlap, so cameras are not this many times higher than the usual overlap suggests.
_MOST_OF_OVERLAP = 8.0
# Further apart than this, positions are not of one survey.
ONE_SURVEY_M = 20e3
# A GPS position without corrections is within 10 m.
_EXIF_DOUBT_M = 50.0
# Oblique views reach a few flying heights sideways.
_FARTHEST_BOUNDS_M = 1000.0


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
    ratios = {n: lenses[n].focal[0] / by for n, head in headers.items() if n in lenses and (by := head.focal_px)}
    if not ratios:
        return warnings
    name = sorted(ratios, key=lambda name: ratios[name])[len(ratios) // 2]
    message = (
        f"the focal length of {name} is {lenses[name].focal[0]:g} px, and EXIF gives {headers[name].focal_px:.0f} px"
    )
    factor = max(ratios[name], 1.0 / ratios[name])
    if factor > _WRONG_RATIO:
        raise ConfigError(
            f"{message}, expected a factor of at most {_WRONG_RATIO:g} between them; give it in pixels of these "
            "images, in [cameras] focal_px or in the poses file"
        )
    if factor > _DOUBTFUL_RATIO:
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
    poses, repeated = set[tuple[float, ...]](), []
    for view in views:
        pose = (*view.camera.centre, *view.camera.cam_from_local.ravel())
        repeated += [view.name] if pose in poses else []
        poses.add(pose)
    return warnings + named(repeated, "image", "with the pose of another one")


def _overlap_warnings(views: list[View], over_water: np.ndarray) -> list[str]:
    """Warnings about views that overlap no other; circles around footprints allow for a bed far below the water."""
    cameras = [view.camera for view in views]
    axes = np.array([camera.cam_from_local[2] for camera in cameras])
    # Along the optical axis; at most three flying heights for views to the horizon.
    falling = np.maximum(-axes[:, 2], 1.0 / 3.0)
    along = over_water / falling
    middles = (np.array([camera.centre for camera in cameras]) + along[:, None] * axes)[:, :2]
    tangents = np.array([math.hypot(camera.width / camera.fx, camera.height / camera.fy) for camera in cameras])
    radii = 0.5 * along * tangents / falling
    # Distance from each circle to the nearest other; below zero where they overlap.
    gaps = np.empty(len(views))
    for i, middle in enumerate(middles):
        others = np.hypot(*(middles - middle).T) - radii - radii[i]
        others[i] = np.inf
        gaps[i] = others.min()
    alone = gaps > 0.0
    if alone.mean() > 0.5:
        raise PosesError(
            f"{alone.sum()} of {len(views)} views overlap no other at the water: one covers "
            f"{2.0 * np.median(radii):.2f} m, and the next one begins {np.median(gaps[alone]):.2f} m away, expected an "
            "overlap of half a view or more; correct the focal length, the positions or [water] level_m"
        )
    names = [views[i].name for i in np.flatnonzero(alone).tolist()]
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
    tilts, most = float(np.median(np.abs(angles[:, 1]))), np.abs(angles).max()
    if most > _FULL_TURN or (np.ptp(angles[:, 2]) < 1.0 and not _EXACT < tilts < _LEVEL_ROWS):
        return []
    as_radians = np.array([grid_from_opk(*three) for three in angles])
    if not (as_radians[:, 2, 2] > _LOOKS_DOWN).all() or np.median(np.abs(as_radians[:, 2, 0])) >= _LEVEL_ROWS:
        return []
    return [f"omega, phi, kappa are at most {most:.2f} and look like radians, expected degrees: multiply by 57.29578"]


@dataclass(frozen=True)
class GroundHeight:
    height: float  # [m], local
    source: str  # What it is known from, for the plan
    is_guess: bool = False  # Whether it is known from the usual overlap of photographs alone


def ground_below(cameras: Sequence[PinholeCamera]) -> GroundHeight:
    """Approximate height of the ground below cameras, from their poses alone.

    Where the axes of oblique views converge, the median height at which pairs of them pass each other; else
    the height at which neighbours overlap as usual, a guess.
    """
    centres = np.array([camera.centre for camera in cameras])
    axes = np.array([camera.cam_from_local[2] for camera in cameras])
    every = -(-len(cameras) // _MOST_PAIRED)
    i, j = (every * side for side in np.triu_indices(-(-len(cameras) // every), 1))
    cos = np.sum(axes[i] * axes[j], axis=1)
    convergent = cos < math.cos(math.radians(15.0))
    if convergent.sum() >= _FEWEST_PAIRS:
        i, j, cos = i[convergent], j[convergent], cos[convergent]
        between = centres[j] - centres[i]
        along_i, along_j = np.sum(between * axes[i], axis=1), np.sum(between * axes[j], axis=1)
        t = (along_i - cos * along_j) / (1.0 - cos**2)
        heights = (centres[i] + t[:, None] * axes[i])[t > 0.0, 2]
        if heights.size >= _FEWEST_PAIRS:
            return GroundHeight(float(np.median(heights)), "where the axes of oblique views converge")
    camera = cameras[0]
    seen = min(camera.width / camera.fx, camera.height / camera.fy)
    height = float(np.median(centres[:, 2])) - height_by_overlap(centres[:, :2], seen)
    return GroundHeight(height, f"a guess: neighbours overlap by {100 * USUAL_OVERLAP:.0f} %", is_guess=True)


def height_by_overlap(places: np.ndarray, seen: float) -> float:
    """Height [m] at which neighbours at places (N, 2) [m] overlap as usual, that see ``seen`` times their height."""
    base = float(np.median(KDTree(places).query(places, k=2)[0][:, 1])) if len(places) > 1 else 0.0
    return base / ((1.0 - USUAL_OVERLAP) * seen)


def most_over_water(by_overlap: float) -> float:
    """Largest plausible height of cameras over the water [m], by the height at which they overlap as usual."""
    return float(np.clip(_MOST_OF_OVERLAP * by_overlap, DRONE_HEIGHT_M, AIRCRAFT_HEIGHT_M))


def most_of_cameras(cameras: Sequence[PinholeCamera]) -> float:
    """The same of cameras with poses."""
    return most_over_water(float(np.median([camera.centre[2] for camera in cameras])) - ground_below(cameras).height)


def require_plausible(
    frame: LocalFrame,
    views: list[View],
    over_water: np.ndarray | None,
    config: SurveyConfig,
    headers: Mapping[str, Exif],
    *,
    see_points: bool = False,
) -> None:
    """Raise where cameras lie under the water, far above it, look at the sky, or far from the bounds.

    ``over_water`` are the heights (V,) [m] of the cameras over the water, None in a dry survey. Cameras of a dry survey
    may look up where they see tie points of their poses file (`see_points`), at a cliff or a house.
    """
    rises = np.array([view.camera.cam_from_local[2, 2] for view in views]) > 0.0
    if rises.mean() > 0.5 and not (see_points and over_water is None):
        raise PosesError(
            f"{int(rises.sum())} of {len(views)} cameras look up at the sky, expected down at the bed; check "
            "the convention of the angles (omega, phi, kappa about the grid axes; camera x right, y up, z back)"
        )
    centres = np.array([view.camera.centre for view in views])
    distance = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    worst = int(np.argmax(distance))
    if distance[worst] > ONE_SURVEY_M:
        place = ", ".join(f"{v:.10g}" for v in frame.crs_from_local(centres[worst]))
        raise PosesError(
            f"the camera of {views[worst].name} at {place} lies {distance_text(distance[worst])} from the others, "
            f"expected at most {distance_text(ONE_SURVEY_M)}; correct its pose or leave the image out"
        )
    if over_water is not None and config.water is not None:
        _require_above_water(frame, views, over_water, config.water, headers)
    if config.area.bounds is not None:
        _require_bounds_near(frame, centres, config.area.bounds)


def _require_above_water(
    frame: LocalFrame, views: list[View], over_water: np.ndarray, water: WaterConfig, headers: Mapping[str, Exif]
) -> None:
    centres = frame.crs_from_local(np.array([view.camera.centre for view in views]))
    heights, at = centres[:, 2] * height_unit_m(frame.crs), place_of(frame.crs, np.median(centres, axis=0))
    why = explanation(float(np.median(over_water)), water.known_level_m, at, frame.crs, above_start_of(headers))
    most_m = DRONE_HEIGHT_M if why else most_of_cameras([view.camera for view in views])
    like = f"the poses ({frame.crs.name}){why}"
    require_level_fits(water, "the cameras are", heights, over_water, like, most_m=most_m)
    lowest = int(np.argmin(over_water))
    if over_water[lowest] <= 0.0:
        raise PosesError(
            f"the camera of {views[lowest].name} at {heights[lowest]:.2f} m lies {-over_water[lowest]:.2f} m under "
            f"the water ([water] level_m = {water.level_m:g}); correct its pose or level_m, or leave the image out"
        )


def _require_bounds_near(frame: LocalFrame, centres: np.ndarray, bounds: tuple[float, ...]) -> None:
    e0, n0, e1, n1 = bounds
    cameras = frame.crs_from_local(centres)
    if (meant := bounds_in_other_order(bounds, cameras)) is not None:
        raise ConfigError(
            f"[area] bounds {list(bounds)} are not in the order [easting_low, northing_low, easting_high, "
            f"northing_high]: give bounds = {list(meant)}"
        )
    nearest = cameras.copy()
    nearest[:, 0], nearest[:, 1] = cameras[:, 0].clip(e0, e1), cameras[:, 1].clip(n0, n1)
    distances = np.linalg.norm(frame.local_from_crs(nearest) - centres, axis=1)
    if not distances.min() < _FARTHEST_BOUNDS_M:
        east, north, _ = cameras[int(np.argmin(distances))]
        raise ConfigError(
            f"[area] bounds {list(bounds)} lie {distance_text(distances.min())} from the nearest camera, which is "
            f"at {east:.10g}, {north:.10g}; give them in crs ({frame.crs.name}), or correct what places the cameras"
        )


def place_warnings(
    frame: LocalFrame, views: list[View], over_water: np.ndarray | None, headers: dict[str, Exif]
) -> list[str]:
    """Warnings about positions and heights that are possible but more likely a mistake.

    ``over_water`` (N,) [m] are the heights of the cameras over the water; None for a dry survey.
    """
    up = [view.name for view in views if view.camera.cam_from_local[2, 2] > 0.0]
    warnings = named(up, "camera", "that looks up at the sky by its pose, and shows nothing of the bed")
    if over_water is not None:
        names = [views[i].name for i in np.flatnonzero(over_water > DRONE_HEIGHT_M).tolist()]
        warnings += named(
            names, "camera", f"more than {DRONE_HEIGHT_M:.0f} m over the water: check that both count from one datum"
        )
    in_crs = frame.crs_from_local(np.array([view.camera.centre for view in views]))
    distances = distances_to_exif(frame.crs, {v.name: p for v, p in zip(views, in_crs, strict=True)}, headers)
    away_m = float(np.median(distances)) if distances.size else 0.0
    if away_m > _EXIF_DOUBT_M:
        warnings.append(f"poses lie {distance_text(away_m)} (median) from GPS positions; check crs and [local] origin")
    return warnings


def distances_to_exif(crs: CRS, centres: Mapping[str, np.ndarray], headers: Mapping[str, Exif]) -> np.ndarray:
    """Horizontal distances (N,) [m] between camera centres in crs and the GPS positions of their images."""
    positions = {name: headers[name].lat_lon_height for name in centres if name in headers}
    known = {name: position for name, position in positions.items() if position is not None}
    if not known:
        return np.zeros(0)
    lat, lon = np.array([position[:2] for position in known.values()]).T
    own_lon, own_lat = lon_lat(crs, np.array([centres[name][:2] for name in known])).T
    _, _, metres = Geod(ellps="WGS84").inv(lon, lat, own_lon, own_lat)
    return np.where(np.isfinite(metres), metres, np.inf)
