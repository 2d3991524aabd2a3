"""Images of one size with their cameras and the water, laid out on the device that compares them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from fields.device import Device, memory_bytes
from fields.image_store import Lazy, Recent, most_kept
from fields.skips import SKIPS, Skips
from fields.sweep.kernels.arrays import constant, floats, words
from refract import FlatWater, PinholeCamera
from refract.distortion import KINDS, kinds_of, row_of
from refract.distortion import ROW as LENS_ROW

_PINHOLE_ROW, _MOTION_ROW, _TIDE_ROW = 18, 3, 1
# The first level of a word of 16 bits a level where any of its four pixels is masked.
MASKED = 2**16 - 1
# Packed images that are kept on a processor, in bytes, or so many: a view's neighbours and those of the next.
KEPT_BYTES, FEWEST_KEPT = 200_000_000, 20
# Share of the memory of a device that is apart: height maps take half of it.
_OF_MEMORY = 0.25
# Levels that span less are taken to span so much.
LEAST_SPAN = 1e-3


@dataclass(frozen=True)
class Beyond:
    """What some of a number of cameras have beyond a pinhole: kernels leave out the rest when they are traced.

    Attributes
    ----------
    lenses : frozenset of str
        Kinds of distortion, see `refract.distortion`.
    moves : bool
        Whether any shutter rolls.
    tides : bool
        Whether any camera had another level of the water than the plane.
    """

    lenses: frozenset[str]
    moves: bool
    tides: bool

    @staticmethod
    def of(cameras: list[PinholeCamera], skips: Skips = SKIPS) -> Beyond:
        """That of cameras, or all that there may be."""
        if not skips.lens:
            return Beyond(KINDS, True, True)
        moves, tides = any(c.motion is not None for c in cameras), any(c.tide != 0.0 for c in cameras)
        return Beyond(kinds_of(c.distortion for c in cameras), moves, tides)

    @property
    def row(self) -> int:
        """Length of a row of the table of these cameras."""
        return self._tide_at + (_TIDE_ROW if self.tides else 0) + (LENS_ROW if self.lenses else 0)

    @property
    def _tide_at(self) -> int:
        return _PINHOLE_ROW + (_MOTION_ROW if self.moves else 0)

    def motion(self, row):
        """The part of a row that says how far the camera flies from one row of the image to the next [m/px]."""
        return row[_PINHOLE_ROW : _PINHOLE_ROW + _MOTION_ROW]

    def tide(self, row):
        """The number of a row that says how high the camera's own water is over the plane, along its normal [m]."""
        return row[self._tide_at]

    def lens(self, row):
        """The part of a row that is that of `refract.distortion`."""
        return row[len(row) - LENS_ROW :]


@dataclass(frozen=True)
class PlaneFrame:
    """The frame of the water plane, in which z is the height over it; local itself in a dry survey.

    Attributes
    ----------
    origin : (3,) [m], local
        The point of the plane nearest to the origin of local.
    from_local : (3, 3)
        Rotation; ``p = from_local @ (p_in_local - origin)``.
    """

    origin: np.ndarray
    from_local: np.ndarray

    @staticmethod
    def of(water: FlatWater | None) -> PlaneFrame:
        """That of a plane of water."""
        if water is None:
            return PlaneFrame(np.zeros(3), np.eye(3))
        up = np.asarray(water.up, dtype=np.float64)
        east = np.array([1.0, 0.0, 0.0]) - up[0] * up
        east /= np.linalg.norm(east)
        return PlaneFrame(up * (up @ np.asarray(water.point)), np.stack([east, np.cross(up, east), up]))


def index_of(water: FlatWater | None, skips: Skips) -> float | None:
    """Index of the water; None where rays are straight, and nothing need be bent."""
    index = 1.0 if water is None else water.n_water
    return None if index == 1.0 and skips.air else index


def camera_table(cameras: list[PinholeCamera], beyond: Beyond, frame: PlaneFrame) -> np.ndarray:
    """Rotation (9), centre (3), fx, fy, cx, cy, width, height of each camera, and what it has beyond a pinhole.

    (cameras, 18 and more) float64, in a frame. The height of a centre is over the camera's own water, where the water
    moves: the frame is lower by the tide.
    """
    rows = []
    for c in cameras:
        rotation, centre = c.cam_from_local @ frame.from_local.T, frame.from_local @ (c.centre - frame.origin)
        tide = c.tide * frame.from_local[2, 2]
        centre[2] -= tide
        inner = (c.fx, c.fy, c.cx, c.cy, c.width, c.height)
        motion = (np.zeros(3) if c.motion is None else frame.from_local @ c.motion) if beyond.moves else ()
        own = (tide,) if beyond.tides else ()
        lens = row_of(c.distortion) if beyond.lenses else ()
        rows.append(np.concatenate([rotation.ravel(), centre, inner, motion, own, lens]))
    return np.asarray(rows)


@dataclass(frozen=True)
class Hypotheses:
    """Height hypotheses of a number of pixels: ``start + j * step`` over the water plane, for j from 0 to count - 1.

    Attributes
    ----------
    start : array of the pixels, on the host or on the device [m]
    step : [m]
    count : int
    """

    start: Any
    step: float
    count: int


@dataclass(frozen=True)
class ViewStack:
    """Scalar images of equal size with their cameras and the water, for one device.

    Attributes
    ----------
    cameras : list of PinholeCamera, all of one size
    images : (height, width) float32 each
    water : FlatWater or None
    skips : Skips
    """

    device: Device
    cameras: list[PinholeCamera]
    images: Sequence[np.ndarray]
    water: FlatWater | None
    skips: Skips = SKIPS

    @staticmethod
    def build(device: Device, cameras, images, water, skips: Skips = SKIPS) -> ViewStack:
        """Stack images (height, width) float; all must have the size of their camera, and one size.

        Raises
        ------
        ValueError
            If a size differs.
        """
        size = (cameras[0].height, cameras[0].width)
        if not isinstance(images, Lazy):
            images = [np.asarray(image, dtype=np.float32) for image in images]
        shapes = [images.shape] * len(images) if isinstance(images, Lazy) else [i.shape for i in images]
        for camera, shape in zip(cameras, shapes, strict=True):
            if shape != size or (camera.height, camera.width) != size:
                raise ValueError(
                    f"a stack holds images of one size {size}, that of their cameras; got an image of {shape} "
                    f"with a camera of {(camera.height, camera.width)}"
                )
        return ViewStack(device, list(cameras), images, water, skips)

    @property
    def height(self) -> int:
        return self.cameras[0].height

    @property
    def width(self) -> int:
        return self.cameras[0].width

    @property
    def n_water(self) -> float | None:
        """Index of the water; None where rays are straight."""
        return index_of(self.water, self.skips)

    @cached_property
    def beyond(self) -> Beyond:
        """What its cameras have beyond pinholes."""
        return Beyond.of(self.cameras, self.skips)

    @cached_property
    def frame(self) -> PlaneFrame:
        """The frame of the water plane."""
        return PlaneFrame.of(self.water)

    @cached_property
    def numbers(self) -> list[list]:
        """The row of `camera_table` of each camera, as constants of the device."""
        table = camera_table(self.cameras, self.beyond, self.frame)
        return [[constant(self.device, c) for c in row] for row in table]

    @cached_property
    def pixels(self) -> Recent[int, Any]:
        """Images as flat arrays (height * width) of the device, float32: of height maps, which are compared."""
        most = most_kept(4 * self.height * self.width, KEPT_BYTES, FEWEST_KEPT)
        # Without the stack itself: in a circle with it they would stay until the next search for circles.
        device, images = self.device, self.images
        return Recent(lambda view: floats(device, images[view]), most)

    @cached_property
    def quads(self) -> Quads:
        """All images, packed for sampling."""
        return Quads.build(self.device, self.images)


@dataclass(frozen=True)
class Quads:
    """Images of one size, packed.

    Attributes
    ----------
    values : (height * width) words of the device, by the number of the image; the last few are kept
    bits : of a level in a word, 8 or 16
    low, step : of the levels, ``low + step * whole``
    """

    values: Recent[int, Any]
    bits: int
    low: float
    step: float

    @staticmethod
    def build(device: Device, images: Sequence[np.ndarray]) -> Quads:
        """Pack images (height, width) float32 of one size, each when it is needed; NaN is masked."""
        least, most, are_whole = np.inf, -np.inf, True
        for image in images:
            if not np.isnan(image).all():
                least, most = min(least, float(np.nanmin(image))), max(most, float(np.nanmax(image)))
            are_whole = are_whole and np.array_equal(np.rint(image), image)
        least, most = (0.0, 0.0) if most < least else (least, most)
        bits = 8 if most - least < 2**8 and are_whole else 16
        step = 1.0 if bits == 8 else 2.0 ** np.ceil(np.log2(max(most - least, LEAST_SPAN) / (MASKED - 2)))
        low = step * np.floor(least / step)
        size = images[0].size * bits // 2
        budget = max(int(_OF_MEMORY * memory_bytes(device)), KEPT_BYTES)
        kept = most_kept(size, budget, FEWEST_KEPT)
        values: Recent[int, Any] = Recent(lambda view: words(device, _packed(images[view], low, step, bits)), kept)
        return Quads(values, bits, float(low), float(step))


def _packed(image: np.ndarray, low: float, step: float, bits: int) -> np.ndarray:
    """The words (height, width) of one image; the last row and column are neighbours of themselves."""
    if bits == 8:
        return _words((image - np.float32(low)).astype(np.uint8), np.uint32)
    masked = np.isnan(image)
    levels = np.where(masked, np.float32(low), image).astype(np.float64)
    levels -= low
    levels /= step
    target = _words(np.rint(levels, out=levels).clip(min=0.0, out=levels).astype(np.uint16), np.uint64)
    if masked.any():
        four = _four(masked.astype(np.uint8))
        target.view(np.uint16)[..., ::4][(four[0] | four[1] | four[2] | four[3]).view(bool)] = MASKED
    return target


def _words(levels: np.ndarray, word: type) -> np.ndarray:
    """Four levels a word."""
    return cv2.merge(_four(levels)).view(word)[..., 0]


def _four(image: np.ndarray) -> list[np.ndarray]:
    """An image, and what lies to the right of, below, and below to the right of each pixel."""
    image = cv2.copyMakeBorder(image, 0, 1, 0, 1, cv2.BORDER_REPLICATE)
    return [image[:-1, :-1], image[:-1, 1:], image[1:, :-1], image[1:, 1:]]
