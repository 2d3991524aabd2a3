"""Images of one size with their cameras and the water, laid out on the device that compares them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from fields.device import Device
from fields.sweep.arrays import floats
from refract import FlatWater, PinholeCamera
from refract.distortion import ROW as LENS_ROW
from refract.distortion import kinds_of, row_of

# Length of the row of a pinhole; that of its lens follows where any camera of a table has one.
PINHOLE_ROW = 18


def camera_table(cameras: list[PinholeCamera]) -> np.ndarray:
    """Rotation (9), centre (3), fx, fy, cx, cy, width, height of each camera, and the row of its lens.

    (cameras, 18) float32, or (cameras, 28) where any of them distorts, see `refract.distortion`.
    """
    has_lens = any(c.distortion is not None for c in cameras)
    rows = []
    for c in cameras:
        inner = (c.fx, c.fy, c.cx, c.cy, c.width, c.height)
        lens = row_of(c.distortion) if has_lens else ()
        rows.append(np.concatenate([c.cam_from_local.ravel(), c.centre, inner, lens]))
    return np.asarray(rows, dtype=np.float32)


@dataclass(frozen=True)
class ViewStack:
    """Scalar images of equal size with their cameras and the water, on one device.

    Attributes
    ----------
    cameras : list of PinholeCamera, all of one size
    pixels : (views * height * width) float32 of the device
    table : `camera_table`, flattened, float32 of the device
    water : FlatWater or None
    """

    device: Device
    cameras: list[PinholeCamera]
    pixels: Any
    table: Any
    water: FlatWater | None

    @staticmethod
    def build(device: Device, cameras, images, water) -> ViewStack:
        """Stack images (height, width) float; all must have the size of their camera, and one size.

        Raises
        ------
        ValueError
            If a size differs.
        """
        size = (cameras[0].height, cameras[0].width)
        for camera, image in zip(cameras, images, strict=True):
            if image.shape != size or (camera.height, camera.width) != size:
                raise ValueError(
                    f"a stack holds images of one size {size}, that of their cameras; got an image of {image.shape} "
                    f"with a camera of {(camera.height, camera.width)}"
                )
        flat = np.concatenate([np.asarray(image, dtype=np.float32).ravel() for image in images])
        return ViewStack(device, list(cameras), floats(device, flat), floats(device, camera_table(cameras)), water)

    @property
    def height(self) -> int:
        return self.cameras[0].height

    @property
    def width(self) -> int:
        return self.cameras[0].width

    @property
    def row(self) -> int:
        """Length of a row of the table."""
        return PINHOLE_ROW + (LENS_ROW if self.lenses else 0)

    @cached_property
    def lenses(self) -> frozenset[str]:
        """The kinds of distortion of its cameras; kernels leave out the terms of others."""
        return kinds_of(camera.distortion for camera in self.cameras)

    @property
    def plane(self) -> tuple[tuple[float, ...], tuple[float, ...], float]:
        """Point and normal of the water plane, local, and index; local z = 0 and index 1 for a dry survey."""
        if self.water is None:
            return (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0
        return self.water.point, self.water.up, self.water.n_water
