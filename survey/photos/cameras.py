"""Lenses in COLMAP's camera models, and poses of cameras on their way into the local frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from refract import PinholeCamera
from survey.errors import PosesError

# Parameters in COLMAP's order; the id is the one of COLMAP's binary files.
MODELS = {
    "SIMPLE_PINHOLE": (0, ("f", "cx", "cy")),
    "PINHOLE": (1, ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": (2, ("f", "cx", "cy", "k1")),
    "RADIAL": (3, ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": (4, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": (5, ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    "FULL_OPENCV": (6, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
}

# Camera axes of photogrammetry (x right, y up, z back) to ours (x right, y down, z forward).
CAM_FROM_OPK_CAM = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Lens:
    """Interior orientation of a photograph as it was taken, distortion included.

    Attributes
    ----------
    model : str
        One of COLMAP's camera models, a key of `MODELS`.
    params : tuple of float
        In COLMAP's order; focal lengths and principal point in px, the centre of the first pixel at (0.5,
        0.5).
    width, height : [px]

    Raises
    ------
    PosesError
        If the model is not supported, or the numbers do not fit it or are not finite.
    """

    model: str
    params: tuple[float, ...]
    width: int
    height: int

    def __post_init__(self):
        if self.model not in MODELS:
            raise PosesError(
                f"camera model {self.model} is not supported, expected one of {', '.join(MODELS)}; undistort the "
                "images with the program that made the poses, or convert the model"
            )
        names = MODELS[self.model][1]
        if len(self.params) != len(names):
            raise PosesError(
                f"camera model {self.model} has {len(self.params)} numbers, expected {len(names)}: {', '.join(names)}"
            )
        if not all(math.isfinite(p) for p in self.params) or min(self.focal) <= 0.0:
            raise PosesError(
                f"camera model {self.model} has the numbers {self.params}, expected finite ones and a focal length "
                "above zero; correct the camera"
            )
        if self.width < 1 or self.height < 1:
            raise PosesError(f"a camera has {self.width} x {self.height} pixels, expected at least one; correct it")

    def __getitem__(self, name: str) -> float:
        """The parameter of that name; zero for a distortion that the model does not have."""
        names = MODELS[self.model][1]
        return self.params[names.index(name)] if name in names else 0.0

    @property
    def focal(self) -> tuple[float, float]:
        """Focal lengths fx, fy [px]."""
        names = MODELS[self.model][1]
        return (self["f"], self["f"]) if "f" in names else (self["fx"], self["fy"])

    @property
    def is_distorted(self) -> bool:
        """Whether any coefficient of distortion differs from zero."""
        names = MODELS[self.model][1]
        distorted = any(p != 0.0 for name, p in zip(names, self.params, strict=True) if name[0] in "kp")
        # A fisheye lens maps by the angle, even with all its coefficients at zero.
        return distorted or self.model == "OPENCV_FISHEYE"

    def pinhole(self, centre, cam_from_local) -> PinholeCamera:
        """The undistorted camera of the same focal length, principal point and size, at a pose in local."""
        fx, fy = self.focal
        return PinholeCamera(centre, cam_from_local, fx, fy, self["cx"], self["cy"], self.width, self.height)


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
        None where the file carries no lens.
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
        Free of distortion, local frame, at full size; `survey.photos.images.load_image` gives the pixels that fit
        it.
    lens : Lens
        Of the photograph as it was taken.
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
