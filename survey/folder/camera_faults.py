"""Inconsistent lenses and poses: faults that no single number shows.

A focal length in the wrong unit, angles in radians, one pose for all photographs. What cannot be true of any survey is
an error; what is unlikely is a warning.
"""

from __future__ import annotations

import math

import numpy as np

from refract.lens import Lens
from survey.display.quantities import named
from survey.errors import ConfigError, PosesError
from survey.photos.cameras import CAM_FROM_OPK_CAM, View, grid_from_opk
from survey.photos.exif import Exif
from survey.photos.poses import Pose, PoseFrame

# Diagonal field of view [degrees] of a pinhole of the same focal length: a fisheye lens of 180 degrees has 115, the
# longest lens of a drone 3.
_WIDEST_DEG, _NARROWEST_DEG = 135.0, 1.0
# Below this only the longest lenses lie; a common lens whose focal length is ten times too long does too.
_NARROW_DEG = 12.0
# EXIF has design values, of the whole sensor; a photograph may be cropped or enlarged a little, but not to a fifth.
_DOUBTFUL_RATIO, _WRONG_RATIO = 1.5, 5.0
# Cameras closer together than this show no parallax.
_ONE_PLACE_M = 0.01
# As radians all angles are below this; as degrees they may be too where all views look down and north.
_FULL_TURN = 2.0 * math.pi + 0.01
_LOOKS_DOWN = math.cos(math.radians(75.0))
# A gimbal keeps the rows of an image level to this sine. Degrees read as radians tilt rows at random.
_LEVEL_ROWS = 0.03
# Of drawn surveys rows are level to fewer digits than angles are written with [degrees].
_EXACT = 1e-4


def require_focal_lengths(lenses: dict[str, Lens], heads: dict[str, Exif]) -> list[str]:
    """Warnings about focal lengths that disagree with EXIF.

    Parameters
    ----------
    lenses, heads : by name of the image

    Raises
    ------
    ConfigError
        If a field of view is impossible for a lens, or EXIF gives another order of magnitude.
    """
    warnings: list[str] = []
    for name, lens in lenses.items():
        degrees = 2.0 * math.degrees(math.atan(0.5 * math.hypot(lens.width, lens.height) / min(lens.focal)))
        if not _NARROWEST_DEG < degrees < _WIDEST_DEG:
            raise ConfigError(
                f"the focal length of {name} is {min(lens.focal):g} px, so that its {lens.width} x {lens.height} px "
                f"span {degrees:.1f} degrees from corner to corner, expected {_NARROWEST_DEG:g} to {_WIDEST_DEG:g}; "
                f"give it in pixels of these images{_by_exif(heads[name])}"
            )
        if degrees < _NARROW_DEG and not warnings:
            warnings.append(
                f"the focal length of {name} is {min(lens.focal):g} px, a view of {degrees:.1f} degrees from "
                "corner to corner; check that it is in pixels of these images, unless it is a telephoto lens"
            )
    known = {name: head.focal_px for name, head in heads.items() if name in lenses and head.focal_px is not None}
    if not known:
        return warnings
    ratios = [lenses[name].focal[0] / by_exif for name, by_exif in known.items()]
    name = list(known)[int(np.argsort(ratios)[len(ratios) // 2])]
    focal, by_exif = lenses[name].focal[0], known[name]
    ratio = focal / by_exif
    said = f"the focal length of {name} is {focal:g} px, and EXIF gives {by_exif:.0f} px"
    if max(ratio, 1.0 / ratio) > _WRONG_RATIO:
        raise ConfigError(
            f"{said}, expected a factor of at most {_WRONG_RATIO:g} between them; give it in pixels of these images, "
            "in [cameras] focal_px or in the poses file"
        )
    if max(ratio, 1.0 / ratio) > _DOUBTFUL_RATIO:
        warnings.append(f"{said}; check that it is in pixels of these images, unless they are cropped")
    return warnings


def require_apart(views: list[View], over_water: np.ndarray | None) -> list[str]:
    """Warnings about views that share a pose, by their heights (N,) [m] over the water; None for a dry survey.

    Raises
    ------
    PosesError
        If all cameras are at one place, or most of them do not overlap any other at the water.
    """
    centres = np.array([view.camera.centre for view in views])
    if np.ptp(centres, axis=0).max() < _ONE_PLACE_M:
        raise PosesError(
            f"all {len(views)} cameras are at one place within {1000.0 * _ONE_PLACE_M:.0f} mm, expected places some "
            "metres apart; give each photograph its own pose"
        )
    warnings = [] if over_water is None else _overlap_doubts(views, over_water)
    poses = [(*view.camera.centre, *view.camera.cam_from_local.ravel()) for view in views]
    first = {pose: i for i, pose in reversed(list(enumerate(poses)))}
    again = [view.name for i, view in enumerate(views) if first[poses[i]] != i]
    return warnings + named(again, "image", "with the pose of another one")


def _overlap_doubts(views: list[View], over_water: np.ndarray) -> list[str]:
    """Warnings about views that overlap no other at the water; circles around footprints allow for a bed far below it.

    Raises
    ------
    PosesError
        Where most views do.
    """
    places, radii = [], []
    for view, height in zip(views, over_water.tolist(), strict=True):
        camera = view.camera
        # Along the optical axis; at most three flying heights for views to the horizon.
        falling = max(-camera.cam_from_local[2, 2], 1.0 / 3.0)
        along = height / falling
        places.append((camera.centre + along * camera.cam_from_local[2])[:2])
        radii.append(0.5 * along * math.hypot(camera.width / camera.fx, camera.height / camera.fy) / falling)
    apart = _gaps(np.array(places), np.array(radii))
    alone = apart > 0.0
    if alone.mean() > 0.5:
        gap = np.median(apart[alone])
        raise PosesError(
            f"{alone.sum()} of {len(views)} views overlap no other at the water: one covers "
            f"{2.0 * np.median(radii):.2f} m, and the next one begins {gap:.2f} m away, expected an overlap of "
            "half a view or more; correct the focal length, the positions or [water] level_m"
        )
    names = [view.name for view, is_alone in zip(views, alone, strict=True) if is_alone]
    return named(names, "view", "without overlap with another one at the water")


def _gaps(places: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Distance (N,) [m] from each circle (N, 2), (N,) to the nearest other; below zero where they overlap."""
    gaps = np.empty(len(places))
    for i, (place, radius) in enumerate(zip(places, radii, strict=True)):
        others = np.hypot(*(places - place).T) - radii - radius
        others[i] = np.inf
        gaps[i] = others.min()
    return gaps


def angle_doubts(poses: list[Pose], frame: PoseFrame) -> list[str]:
    """Warning where omega, phi and kappa look like radians.

    All are below a full turn in radians; read as radians, all cameras look down, and their image rows are level, as
    those of a gimbal are in nadir and oblique views alike. Beside that they turn by more than a radian, or rows would
    be level as degrees to a thirtieth of a degree, which no gimbal does.
    """
    if frame is not PoseFrame.GRID:
        return []
    angles = np.array([_opk_deg(pose.cam_from_world) for pose in poses])
    tilts = float(np.median(np.abs(angles[:, 1])))
    if np.abs(angles).max() > _FULL_TURN or (np.ptp(angles[:, 2]) < 1.0 and not _EXACT < tilts < _LEVEL_ROWS):
        return []
    as_radians = np.array([grid_from_opk(*three) for three in angles])
    looks_down = (as_radians[:, 2, 2] > _LOOKS_DOWN).all()
    has_level_rows = np.median(np.abs(as_radians[:, 2, 0])) < _LEVEL_ROWS
    if not (looks_down and has_level_rows):
        return []
    most = np.abs(angles).max()
    return [
        f"omega, phi and kappa lie within {most:.2f}, expected degrees; they look like radians: if they are, multiply "
        "them by 57.29578"
    ]


def _opk_deg(cam_from_grid: np.ndarray) -> tuple[float, float, float]:
    """Omega, phi, kappa [degrees] of a rotation, the inverse of `survey.photos.cameras.grid_from_opk`."""
    r = cam_from_grid.T @ CAM_FROM_OPK_CAM
    omega, kappa = math.atan2(-r[1, 2], r[2, 2]), math.atan2(-r[0, 1], r[0, 0])
    phi = math.asin(max(-1.0, min(r[0, 2], 1.0)))
    return math.degrees(omega), math.degrees(phi), math.degrees(kappa)


def _by_exif(head: Exif) -> str:
    return "" if head.focal_px is None else f"; EXIF gives {head.focal_px:.0f} px"
