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

_PINHOLE_ROW, _MOTION_ROW = 18, 3


@dataclass(frozen=True)
class Beyond:
    """What some of a number of cameras have beyond a pinhole: kernels leave out the rest when they are traced.

    Attributes
    ----------
    lenses : frozenset of str
        Kinds of distortion, see `refract.distortion`.
    moves : bool
        Whether any shutter rolls.
    """

    lenses: frozenset[str]
    moves: bool

    @staticmethod
    def of(cameras: list[PinholeCamera]) -> Beyond:
        """That of cameras."""
        return Beyond(kinds_of(c.distortion for c in cameras), any(c.motion is not None for c in cameras))

    @property
    def row(self) -> int:
        """Length of a row of the table of these cameras."""
        return _PINHOLE_ROW + (_MOTION_ROW if self.moves else 0) + (LENS_ROW if self.lenses else 0)

    def motion(self, row):
        """The part of a row that says how far the camera flies from one row of the image to the next [m/px]."""
        return row[_PINHOLE_ROW : _PINHOLE_ROW + _MOTION_ROW]

    def lens(self, row):
        """The part of a row that is that of `refract.distortion`."""
        return row[len(row) - LENS_ROW :]


def camera_table(cameras: list[PinholeCamera], beyond: Beyond) -> np.ndarray:
    """Rotation (9), centre (3), fx, fy, cx, cy, width, height of each camera, and what it has beyond a pinhole.

    (cameras, 18 and more) float32.
    """
    rows = []
    for c in cameras:
        inner = (c.fx, c.fy, c.cx, c.cy, c.width, c.height)
        motion = (np.zeros(3) if c.motion is None else c.motion) if beyond.moves else ()
        lens = row_of(c.distortion) if beyond.lenses else ()
        rows.append(np.concatenate([c.cam_from_local.ravel(), c.centre, inner, motion, lens]))
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
        table = floats(device, camera_table(cameras, Beyond.of(cameras)))
        return ViewStack(device, list(cameras), floats(device, flat), table, water)

    @property
    def height(self) -> int:
        return self.cameras[0].height

    @property
    def width(self) -> int:
        return self.cameras[0].width

    @cached_property
    def beyond(self) -> Beyond:
        """What its cameras have beyond pinholes."""
        return Beyond.of(self.cameras)

    @property
    def plane(self) -> tuple[tuple[float, ...], tuple[float, ...], float]:
        """Point and normal of the water plane, local, and index; local z = 0 and index 1 for a dry survey."""
        if self.water is None:
            return (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0
        return self.water.point, self.water.up, self.water.n_water
