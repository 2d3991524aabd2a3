"""Lenses in COLMAP's camera models, distortion included: from pixels to directions and back.

The functions use OpenCV where it has the model. The simulator takes its photographs by them, so that tests of
`refract.distortion` use an independent implementation.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from refract.camera import PinholeCamera
from refract.distortion import AFFINE, BROWN, FISHEYE, RATIONAL, Distortion

# Parameters in COLMAP's order; the id is the one of COLMAP's binary files. COLMAP has no affine model: that is
# Metashape's with p1 and p2 in OpenCV's order, and skew = b2 / fx.
MODELS: dict[str, tuple[int | None, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (0, ("f", "cx", "cy")),
    "PINHOLE": (1, ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": (2, ("f", "cx", "cy", "k1")),
    "RADIAL": (3, ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": (4, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": (5, ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    "FULL_OPENCV": (6, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "BROWN_AFFINE": (None, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "skew")),
}
_INNER = ("f", "fx", "fy", "cx", "cy")


def coefficients_of(model: str) -> tuple[str, ...]:
    """Names of the coefficients of distortion of a model, in its order."""
    return tuple(name for name in MODELS[model][1] if name not in _INNER)


class LensError(ValueError):
    """The parameters of a lens are invalid."""


@dataclass(frozen=True)
class Lens:
    """Interior orientation of a photograph as it was taken, distortion included.

    Raises LensError if the model is not supported, or the numbers do not fit it or are not finite.
    """

    model: str  # A key of `MODELS`: one of COLMAP's camera models, or BROWN_AFFINE
    # In COLMAP's order; focal lengths and principal point in px, the centre of the first pixel at (0.5, 0.5)
    params: tuple[float, ...]
    # width, height: [px]
    width: int
    height: int

    def __post_init__(self):
        if self.model not in MODELS:
            raise LensError(
                f"camera model {self.model} is not supported, expected one of {', '.join(MODELS)}; undistort the "
                "images with the program that made the poses, or convert the model"
            )
        names = MODELS[self.model][1]
        if len(self.params) != len(names):
            raise LensError(
                f"camera model {self.model} has {len(self.params)} numbers, expected {len(names)}: {', '.join(names)}"
            )
        if not all(math.isfinite(p) for p in self.params) or min(self.focal) <= 0.0:
            raise LensError(
                f"camera model {self.model} has the numbers {self.params}, expected finite ones and a focal length "
                "above zero; correct the camera"
            )
        if self.width < 1 or self.height < 1:
            raise LensError(f"a camera has {self.width} x {self.height} pixels, expected at least one; correct it")

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
        distorted = any(self[name] != 0.0 for name in coefficients_of(self.model))
        # A fisheye lens maps by the angle, even with all its coefficients at zero.
        return distorted or self.model == "OPENCV_FISHEYE"

    @property
    def distortion(self) -> Distortion | None:
        """The distortion of its rays; None where no coefficient differs from zero."""
        if not self.is_distorted:
            return None
        if self.model == "OPENCV_FISHEYE":
            return Distortion(FISHEYE, tuple(self[name] for name in ("k1", "k2", "k3", "k4")))
        if self.model == "BROWN_AFFINE":
            return Distortion(AFFINE, tuple(self[name] for name in coefficients_of(self.model)))
        names = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]
        is_rational = any(self[name] for name in names[5:])
        return Distortion(RATIONAL if is_rational else BROWN, tuple(self[n] for n in names[: 8 if is_rational else 5]))

    def camera(self, centre, cam_from_local) -> PinholeCamera:
        """The camera that takes photographs through this lens, at a pose in local."""
        return replace(self.pinhole(centre, cam_from_local), distortion=self.distortion)

    def pinhole(self, centre, cam_from_local) -> PinholeCamera:
        """The undistorted camera of the same focal length, principal point and size, at a pose in local."""
        fx, fy = self.focal
        return PinholeCamera(centre, cam_from_local, fx, fy, self["cx"], self["cy"], self.width, self.height)


def normalised(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Normalised coordinates of pixels, at depth 1 in cam, and their change across a pixel.

    Returns (pixels, 2), (pixels, 2, 2): row by row; the second is d(x, y) / d(u, v) [1/px].
    """
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    fx, fy = lens.focal
    if not lens.is_distorted:
        change = np.broadcast_to(np.diag([1.0 / fx, 1.0 / fy]), (len(pixels), 2, 2))
        return (pixels - (lens["cx"], lens["cy"])) / (fx, fy), change
    across, down = (undistorted(lens, pixels + step) - undistorted(lens, pixels - step) for step in 0.5 * np.eye(2))
    return undistorted(lens, pixels), np.stack([across, down], axis=-1)


def undistorted(lens: Lens, pixels: np.ndarray) -> np.ndarray:
    """Undistorted normalised coordinates (N, 2) of pixels (N, 2), at depth 1 in cam."""
    # OpenCV has no answer to no points.
    if len(pixels) == 0:
        return np.empty((0, 2))
    fx, fy = lens.focal
    distortion = lens.distortion
    if is_affine(lens) and distortion is not None:
        return np.stack(distortion.undistorted(*((pixels - (lens["cx"], lens["cy"])) / (fx, fy)).T), axis=-1)
    matrix = np.array([[fx, 0.0, lens["cx"]], [0.0, fy, lens["cy"]], [0.0, 0.0, 1.0]])
    # Newton-like steps until they are below a billionth of the focal length.
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    points = np.ascontiguousarray(pixels, dtype=np.float64)[:, None]
    if lens.model == "OPENCV_FISHEYE":
        return cv2.fisheye.undistortPoints(points, matrix, _coefficients(lens), criteria=until)[:, 0]
    return cv2.undistortPoints(points, matrix, _coefficients(lens), criteria=until)[:, 0]


def distorted(lens: Lens, pixels: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of the photograph at which those (N, 2) of the pinhole camera appear; undoes `undistorted`."""
    if not lens.is_distorted or len(pixels) == 0:
        return pixels
    (fx, fy), (cx, cy) = lens.focal, (lens["cx"], lens["cy"])
    plane = np.ascontiguousarray((pixels - (cx, cy)) / (fx, fy))
    distortion = lens.distortion
    if is_affine(lens) and distortion is not None:
        return np.stack(distortion.distorted(*plane.T), axis=-1) * (fx, fy) + (cx, cy)
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if lens.model == "OPENCV_FISHEYE":
        return cv2.fisheye.distortPoints(plane[:, None], matrix, _coefficients(lens))[:, 0]
    points = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1)
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, _coefficients(lens))[0][:, 0]


def is_affine(lens: Lens) -> bool:
    """Whether a lens is Brown's with a shear and the eighth power of the radius."""
    return lens.model == "BROWN_AFFINE"


def brown_from_affine(lens: Lens, pixels: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of an affine lens as they would be without its shear and the eighth power of the radius."""
    return distorted(_brown_part(lens), undistorted(lens, pixels) * lens.focal + (lens["cx"], lens["cy"]))


def affine_from_brown(lens: Lens, pixels: np.ndarray) -> np.ndarray:
    """Undoes `brown_from_affine`."""
    return distorted(lens, undistorted(_brown_part(lens), pixels) * lens.focal + (lens["cx"], lens["cy"]))


def _brown_part(lens: Lens) -> Lens:
    return Lens("FULL_OPENCV", (*lens.params[:9], 0.0, 0.0, 0.0), lens.width, lens.height)


def _coefficients(lens: Lens) -> np.ndarray:
    """Coefficients in OpenCV's order."""
    fisheye = lens.model == "OPENCV_FISHEYE"
    return np.array([lens[name] for name in (("k1 k2 k3 k4") if fisheye else "k1 k2 p1 p2 k3 k4 k5 k6").split()])
