"""Poses as files have them, and photographs with their cameras in the local frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from refract import PinholeCamera
from refract.lens import Lens

# Camera axes of photogrammetry (x right, y up, z back) to ours (x right, y down, z forward).
CAM_FROM_OPK_CAM = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Pose:
    """One line of a poses file.

    Attributes
    ----------
    name : str
        Of the image, as the file has it.
    centre : (3,) float64
        Of the camera: in crs where `in_crs`, else [m] in the topocentric frame of [local].
    cam_from_world : (3, 3) float64
        Rotation into cam (x right, y down, z forward), from the grid axes (east, north, up) at the camera
        where `in_crs`, else from the axes of the topocentric frame.
    in_crs : bool
    lens : Lens or None
        None if the file has no lens.
    """

    name: str
    centre: np.ndarray
    cam_from_world: np.ndarray
    in_crs: bool
    lens: Lens | None


@dataclass(frozen=True)
class View:
    """One photograph with its camera.

    Attributes
    ----------
    name : str
        Path of the image below the image folder, with forward slashes.
    path : Path
    camera : PinholeCamera
        Of the photograph as it was taken, lens distortion included; local frame, at full size.
    lens : Lens
        The same inside, as the poses file or survey.toml gives it.
    mask_path : Path or None
        Image of the stored size; black is left out.
    """

    name: str
    path: Path
    camera: PinholeCamera
    lens: Lens
    mask_path: Path | None = None


def grid_from_opk(omega: float, phi: float, kappa: float) -> np.ndarray:
    """Rotation (3, 3) from photogrammetry's camera axes (x right, y up, z back) to the grid axes.

    ``Rx(omega) Ry(phi) Rz(kappa)``, angles in radians.
    """
    co, so, cp, sp, ck, sk = (f(a) for a in (omega, phi, kappa) for f in (math.cos, math.sin))
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, co, -so], [0.0, so, co]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_z = np.array([[ck, -sk, 0.0], [sk, ck, 0.0], [0.0, 0.0, 1.0]])
    return about_x @ about_y @ about_z


def rotation_from_quaternion(w: float, x: float, y: float, z: float) -> np.ndarray:
    """Rotation (3, 3) of a quaternion of any length but zero (Hamilton's convention, as COLMAP has it)."""
    w, x, y, z = np.array([w, x, y, z]) / math.sqrt(w * w + x * x + y * y + z * z)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
