"""Cameras over water, with their lens: pixel to bent ray, point under water to pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np

from refract.distortion import Distortion
from refract.paths import EXACT_STEPS, BentPaths, crossing_point, trace
from refract.surfaces import WaterSurface

# Poses in files carry six to nine digits; a matrix with a larger deviation is a mistake, not a rotation.
_ROTATION_TOLERANCE = 1e-5

_WHOLE_PIXEL = 1e-9  # 0.29 of 100 px is 29 px, although the product rounds to 28.999999999999996

# Distortion bends a side of the image by a few per cent; divided into this many parts, each by a hundredth of that.
_PLACES_OF_SIDE = 16
# Iterations for the row that images a point. Each leaves a twentieth of the error or less: the ratio of the distance
# flown during readout to the distance of the object.
_ROLLING_STEPS = 12
_WIDEST_TANGENT = 4.0  # Tangent of the widest angle to the axis that is considered [-]


@final
@dataclass(frozen=True)
class PinholeCamera:
    """A camera in the local frame: a pinhole, or one whose lens distorts.

    Raises ValueError if a shape is wrong, the centre is not finite, `cam_from_local` is not a right-handed rotation, or
    a focal length or the image size is not positive.
    """

    centre: np.ndarray  # (3,) float64 [m], local
    cam_from_local: np.ndarray  # (3, 3) float64: rotation; camera axes are x right, y down, z forward
    # fx, fy, cx, cy, width, height [px]: the centre of the first pixel is at (0.5, 0.5)
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: Distortion | None = None  # None for a pinhole; pixels are those of the photograph as it was taken
    # (3,) float64 [m/px], local, or None: how far the camera flies, without turning, from one row of a rolling shutter
    # to the next: velocity times readout time over the rows from the first to the last. `centre` is its place at the
    # row `cy`. None for a global shutter
    motion: np.ndarray | None = None
    # [m]: height of the water, when the photograph was taken, above the `water` that `paths` and `project` are called
    # with. Points and heights are the same for all photographs, whatever their tide
    tide: float = 0.0

    def __post_init__(self):
        centre = np.asarray(self.centre, dtype=np.float64)
        rotation = np.asarray(self.cam_from_local, dtype=np.float64)
        object.__setattr__(self, "centre", centre)
        object.__setattr__(self, "cam_from_local", rotation)
        if centre.shape != (3,) or rotation.shape != (3, 3):
            raise ValueError(f"expected a centre (3,) and a rotation (3, 3), got {centre.shape} and {rotation.shape}")
        is_rotation = np.abs(rotation @ rotation.T - np.eye(3)).max() < _ROTATION_TOLERANCE
        if not (np.isfinite(centre).all() and is_rotation and np.linalg.det(rotation) > 0.0):
            raise ValueError(
                f"expected a finite centre and a right-handed rotation, got {centre} and {rotation.tolist()}"
            )
        if self.motion is not None:
            motion = np.asarray(self.motion, dtype=np.float64)
            object.__setattr__(self, "motion", motion)
            if motion.shape != (3,) or not np.isfinite(motion).all():
                raise ValueError(f"expected a finite motion (3,) in metres per row, got {self.motion}")
        if not np.isfinite(self.tide):
            raise ValueError(f"expected a finite tide, got {self.tide} m")
        if not (self.fx > 0.0 and self.fy > 0.0 and self.width >= 1 and self.height >= 1):
            raise ValueError(
                f"expected positive focal lengths and at least one pixel, got fx {self.fx}, fy {self.fy}, "
                f"{self.width} x {self.height} px"
            )

    def scaled(self, factor: float) -> PinholeCamera:
        """The same camera with an image ``factor`` times as wide and high, rounded down to whole pixels.

        The whole view is kept: both axes scale by the ratio of whole pixels, which may differ a little from
        `factor` and from each other.
        """
        width, height = (int(size * factor + _WHOLE_PIXEL) for size in (self.width, self.height))
        sx, sy = width / self.width, height / self.height
        return replace(
            self, motion=None if self.motion is None else self.motion / sy,
            fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height,
        )  # fmt: skip

    def cropped(self, row: int, column: int, height: int, width: int) -> PinholeCamera:
        """The camera of a window of its image, by the first row and column and the size of the window [px]."""
        return replace(self, cx=self.cx - column, cy=self.cy - row, width=width, height=height)

    def outline(self) -> np.ndarray:
        """Pixels (N, 2) around the border of the image, in order: corners, and points between if the lens distorts."""
        w, h = self.width, self.height
        corners = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])
        if self.distortion is None:
            return corners
        share = np.linspace(0.0, 1.0, _PLACES_OF_SIDE, endpoint=False)[:, None]
        return np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])

    @property
    def widening(self) -> float:
        """Ratio of the field of view at the border of the image to that without distortion, at least 1.

        The ratio of the tangents of the widest angles, which are taken to be at most 76 degrees.
        """
        if self.distortion is None:
            return 1.0
        u, v = self.outline().T
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        farthest = np.hypot(*self.distortion.undistorted(x, y))
        farthest = np.where(np.isnan(farthest), self.distortion.reach, farthest).max()
        return max(min(float(farthest), _WIDEST_TANGENT) / float(np.hypot(x, y).max()), 1.0)

    def pixel_centres(self) -> np.ndarray:
        """Pixel coordinates (height, width, 2) of all pixel centres, img frame [px]."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return np.stack([u, v], axis=-1)

    def centres(self, pixels) -> np.ndarray:
        """Places (..., 3) [m], local, at which the camera takes pixels (..., 2); (3,) with a global shutter."""
        if self.motion is None:
            return self.centre
        return self.centre + (np.asarray(pixels, dtype=np.float64)[..., 1:] - self.cy) * self.motion

    def directions(self, pixels) -> np.ndarray:
        """Unit directions of view (..., 3), local, through pixels (..., 2) [px]; other shapes: ValueError.

        NaN for pixels to which the lens brings no light: beyond the place where its model folds back.
        """
        pixels = np.asarray(pixels, dtype=np.float64)
        if pixels.ndim == 0 or pixels.shape[-1] != 2:
            raise ValueError(f"expected pixels of shape (..., 2), got {pixels.shape}")
        x = (pixels[..., 0] - self.cx) / self.fx
        y = (pixels[..., 1] - self.cy) / self.fy
        if self.distortion is not None:
            x, y = self.distortion.undistorted(x, y)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ self.cam_from_local
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def paths(self, pixels, water: WaterSurface | None) -> BentPaths:
        """Bent paths of pixels (..., 2) [px]; see `refract.paths.trace`."""
        path = trace(self._over_own(self.centres(pixels)), self.directions(pixels), water)
        return path if self.tide == 0.0 else path.raised(self.tide)

    def project(self, points, water: WaterSurface | None, *, steps: int = EXACT_STEPS) -> np.ndarray:
        """Pixels (..., 2) [px] at which points (..., 3) [m], local, appear through the water.

        NaN for points behind the camera, and beyond the reach of its lens; pixels outside the image are returned as
        they are. `steps` as in `refract.crossing_point`.
        """
        points = self._over_own(np.asarray(points, dtype=np.float64))
        pixels = self._project_from(self.centre, points, water, steps)
        for _ in range(0 if self.motion is None else _ROLLING_STEPS):
            pixels = self._project_from(self.centres(pixels), points, water, steps)
        return pixels

    def sees(self, pixels) -> np.ndarray:
        """Whether pixels (..., 2) [px], as `project` returns them, lie within the image; False where they are NaN."""
        pixels = np.asarray(pixels)
        with np.errstate(invalid="ignore"):
            return ((pixels > 0.0) & (pixels < (self.width, self.height))).all(axis=-1)

    def _over_own(self, places: np.ndarray) -> np.ndarray:
        """Places (..., 3) lowered by the tide, so that the water is at its common level."""
        return places if self.tide == 0.0 else places - (0.0, 0.0, self.tide)

    def _project_from(self, centre: np.ndarray, points: np.ndarray, water, steps: int) -> np.ndarray:
        """Projection of points for a centre of projection and the water at the time of the photograph; as `project`."""
        centre = self._over_own(centre)
        return self.pixels_of(crossing_point(points, centre, water, steps=steps) - centre)

    def pixels_of(self, directions: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) [px] of straight rays (..., 3), local, from the centre; NaN as for `project`."""
        seen = directions @ self.cam_from_local.T
        z = np.where(seen[..., 2] > 0.0, seen[..., 2], np.nan)
        if self.distortion is not None:
            x, y = self.distortion.distorted(seen[..., 0] / z, seen[..., 1] / z)
            return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=-1)
        return np.stack([self.fx * seen[..., 0] / z + self.cx, self.fy * seen[..., 1] / z + self.cy], axis=-1)
