"""Stack of images with their cameras and the water, on the device of the kernels.

Kernels work in a frame of the water in which z is the height over it. A ray bends where it enters the water, and a
point is seen from a camera by way of its crossing; no other part of a kernel knows what surface there is. A second kind
of surface is a class with the members of `KernelWater` and a line in `kernel_water`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Protocol

import cv2
import numpy as np

from fields.device import Device, memory_bytes
from fields.image_store import LazyImages, num_cached
from fields.sweep.kernels.arrays import constant, floats, words
from refract import FlatWater, PinholeCamera, kernels
from refract.distortion import ROW as LENS_ROW
from refract.distortion import kinds_of, row_of

_POINT, _NORMAL = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)  # The water plane in its own frame

Triple = tuple[Any, Any, Any]


class KernelWater(Protocol):
    """Water as the kernels take it; triples are arrays of a device, numpy or numbers, in the frame of the water."""

    @property
    def origin(self) -> np.ndarray:
        """Origin (3,) [m], local, of the frame."""

    @property
    def from_local(self) -> np.ndarray:
        """Rotation (3, 3) into the frame; ``p = from_local @ (p_in_local - origin)``."""

    @property
    def is_refracting(self) -> bool:
        """Whether rays bend."""

    def bend(self, ray: Triple) -> Triple:
        """Direction of a ray in water, from its unit direction in air."""

    def crossing(self, centre: Triple, point: Triple, steps: int) -> Triple:
        """Crossing of the ray from a camera to a point; the point itself where the ray is straight."""


@dataclass(frozen=True)
class PlaneWater:
    """A plane, in whose frame z is the height over it along its normal; local itself in a dry survey."""

    origin: np.ndarray  # (3,) [m], local: the point of the plane nearest to the origin of local
    from_local: np.ndarray  # (3, 3)
    n_water: float | None  # Refractive index; None where rays are straight

    @staticmethod
    def of(water: FlatWater | None) -> PlaneWater:
        """The plane of a survey; in water of index one rays are straight."""
        if water is None:
            return PlaneWater(np.zeros(3), np.eye(3), None)
        up = np.asarray(water.up, dtype=np.float64)
        east = np.array([1.0, 0.0, 0.0]) - up[0] * up
        east /= np.linalg.norm(east)
        index = None if water.n_water == 1.0 else water.n_water
        return PlaneWater(up * (up @ np.asarray(water.point)), np.stack([east, np.cross(up, east), up]), index)

    @property
    def is_refracting(self) -> bool:
        """Whether there is water whose index counts."""
        return self.n_water is not None

    def bend(self, ray: Triple) -> Triple:
        """See `KernelWater.bend`; the ray itself where none bends."""
        return kernels.bend(ray, _NORMAL, 1.0, self.n_water or 1.0)

    def crossing(self, centre: Triple, point: Triple, steps: int) -> Triple:
        """See `KernelWater.crossing`; ``steps`` are those of `refract.kernels.air_share`."""
        if self.n_water is None:
            return point
        plane = kernels.WaterPlane(_POINT, _NORMAL, self.n_water)
        return kernels.crossing_of_point(centre, point, plane, steps)[0]


def kernel_water(water: FlatWater | None) -> KernelWater:
    """The water of a survey as the kernels take it. Raises TypeError if no kernel is written for this surface."""
    if water is None or isinstance(water, FlatWater):
        return PlaneWater.of(water)
    raise TypeError(f"sweep and solver take FlatWater or None, got {type(water).__name__}")


# Numbers in a row of `camera_table`: rotation (9), centre (3) and six of the image; motion.
_PINHOLE_ROW, _MOTION_ROW = 18, 3
# A window flatter than this (grey levels squared, at 8 bits) holds noise, not texture; it lowers NCC there.
NOISE_VARIANCE = 1.0
MASKED = 2**16 - 1  # The first level of a word of 16 bits a level where any of its four pixels is masked
# Cache of packed images on a processor, in bytes, and at least so many: the neighbours of two views.
KEPT_BYTES, FEWEST_KEPT = 200_000_000, 20
_OF_MEMORY = 0.25  # Share of the memory of a device that packed images take: height maps take half
LEAST_SPAN = 1e-3  # Levels that span less are taken to span so much


@dataclass(frozen=True)
class CameraTerms:
    """Terms beyond the pinhole model that any of some cameras has; kernels are traced without the others."""

    lenses: frozenset[str]  # Kinds of distortion, see `refract.distortion`
    moves: bool  # Whether any shutter rolls
    tides: bool  # Whether any camera had another level of the water than the plane

    @staticmethod
    def of(cameras: list[PinholeCamera]) -> CameraTerms:
        moves, tides = any(c.motion is not None for c in cameras), any(c.tide != 0.0 for c in cameras)
        return CameraTerms(kinds_of(c.distortion for c in cameras), moves, tides)

    def motion(self, row):
        """Motion of the camera from one row of the image to the next [m/px]."""
        return row[_PINHOLE_ROW : _PINHOLE_ROW + _MOTION_ROW]

    def tide(self, row):
        """Height of the camera's own water level over the plane, along its normal [m]."""
        return row[_PINHOLE_ROW + (_MOTION_ROW if self.moves else 0)]

    def lens(self, row):
        """Parameters of `refract.distortion`."""
        return row[len(row) - LENS_ROW :]


def camera_table(cameras: list[PinholeCamera], terms: CameraTerms, water: KernelWater) -> np.ndarray:
    """Parameters of each camera: rotation (9), centre (3), fx, fy, cx, cy, width, height, and `CameraTerms`.

    (cameras, 18 and more) float64, in the frame of the water. The height of a centre is over the camera's own water,
    where the water moves: the frame is lower by the tide.
    """
    rows = []
    for c in cameras:
        rotation, centre = c.cam_from_local @ water.from_local.T, water.from_local @ (c.centre - water.origin)
        tide = c.tide * water.from_local[2, 2]
        centre[2] -= tide
        inner = (c.fx, c.fy, c.cx, c.cy, c.width, c.height)
        motion = (np.zeros(3) if c.motion is None else water.from_local @ c.motion) if terms.moves else ()
        own = (tide,) if terms.tides else ()
        lens = row_of(c.distortion) if terms.lenses else ()
        rows.append(np.concatenate([rotation.ravel(), centre, inner, motion, own, lens]))
    return np.asarray(rows)


def largest(cameras: Sequence[PinholeCamera]) -> tuple[int, int]:
    """Height and width that hold the images of all cameras [px]; zeros of none."""
    return max((c.height for c in cameras), default=0), max((c.width for c in cameras), default=0)


@dataclass(frozen=True)
class Hypotheses:
    """Height hypotheses of a number of pixels: ``start + j * step`` over the water plane, for j from 0 to count - 1."""

    start: np.ndarray  # of the pixels [m]
    step: float  # [m]
    count: int


@dataclass(frozen=True)
class ViewStack:
    """Scalar images with their cameras and the water, for one device."""

    device: Device
    cameras: list[PinholeCamera]
    images: Sequence[np.ndarray]  # (height, width) float32 each
    water: FlatWater | None

    @staticmethod
    def build(device: Device, cameras, images, water) -> ViewStack:
        """Stack images (height, width) float; all must have the size of their camera, `LazyImages` that of the largest.

        Raises ValueError if a size differs.
        """
        sizes = [(camera.height, camera.width) for camera in cameras]
        if isinstance(images, LazyImages):
            expected, found = [largest(cameras)], [images.shape]
        else:
            images = [np.asarray(image, dtype=np.float32) for image in images]
            expected, found = sizes, [image.shape for image in images]
        if len(images) != len(sizes) or found != expected:
            raise ValueError(f"a stack holds images of the sizes of their cameras {expected}; got images of {found}")
        return ViewStack(device, list(cameras), images, water)

    @staticmethod
    def lazy(device: Device, cameras, make: Callable[[int], np.ndarray], water) -> ViewStack:
        """Stack of images of the size of the largest camera that ``make`` gives by number, whenever one is read."""
        return ViewStack.build(device, cameras, LazyImages(make, len(cameras), largest(cameras), 1), water)

    @property
    def height(self) -> int:
        return self.cameras[0].height

    @property
    def width(self) -> int:
        return self.cameras[0].width

    @cached_property
    def kernel_water(self) -> KernelWater:
        """The water as the kernels take it."""
        return kernel_water(self.water)

    @cached_property
    def terms(self) -> CameraTerms:
        """Terms beyond the pinhole model of its cameras."""
        return CameraTerms.of(self.cameras)

    @cached_property
    def camera_rows(self) -> list[list]:
        """The row of `camera_table` of each camera, as constants of the device."""
        table = camera_table(self.cameras, self.terms, self.kernel_water)
        return [[constant(self.device, c) for c in row] for row in table]

    @cached_property
    def pixels(self) -> Callable[[int], Any]:
        """Images by number as flat arrays (height * width) of the device, float32: of height maps, to be compared."""
        most = num_cached(4 * max(c.height * c.width for c in self.cameras), KEPT_BYTES, FEWEST_KEPT)
        # Without the stack itself: a reference cycle would keep the arrays until the next garbage collection.
        device, images = self.device, self.images
        return lru_cache(most)(lambda view: floats(device, images[view]))

    @cached_property
    def packed(self) -> PackedImages:
        """All images, packed for sampling."""
        return PackedImages.build(self.device, self.images)


@dataclass(frozen=True)
class PackedImages:
    """Images of one size, packed for one lookup per bilinear sample."""

    values: Callable[[int], Any]  # (height * width) words of the device, by the number of the image
    kept: int  # Number of them that are kept, those that were read last
    bits: int  # of a level in a word, 8 or 16
    # low, step: of the levels, ``low + step * whole``
    low: float
    step: float

    @staticmethod
    def build(device: Device, images: Sequence[np.ndarray], kept: int | None = None) -> PackedImages:
        """Pack images (height, width) float32 of one size, each when it is needed; NaN is masked.

        The last ``kept`` stay on the device, by default as many as its memory has room for.
        """
        least, most, are_unmasked, pixels = np.inf, -np.inf, True, 0
        for image in images:
            pixels = max(pixels, image.size)
            low, high = image.min(), image.max()
            if np.isnan(low):  # Slower, and infinite where all are masked
                low, high = np.nanmin(image, initial=np.inf), np.nanmax(image, initial=-np.inf)
            least, most = min(least, float(low)), max(most, float(high))
            are_unmasked = are_unmasked and np.array_equal(np.rint(image), image)
        least, most = (0.0, 0.0) if most < least else (least, most)
        bits = 8 if most - least < 2**8 and are_unmasked else 16
        step = 1.0 if bits == 8 else 2.0 ** np.ceil(np.log2(max(most - least, LEAST_SPAN) / (MASKED - 2)))
        low = step * np.floor(least / step)
        budget = max(int(_OF_MEMORY * memory_bytes(device)), KEPT_BYTES)
        kept = num_cached(pixels * bits // 2, budget, FEWEST_KEPT) if kept is None else kept
        values = lru_cache(kept)(lambda view: words(device, _packed(images[view], low, step, bits)))
        return PackedImages(values, kept, bits, float(low), float(step))


def _packed(image: np.ndarray, low: float, step: float, bits: int) -> np.ndarray:
    """Words (height, width) of one image; the last row and column repeat."""
    if bits == 8:
        return _words((image - np.float32(low)).astype(np.uint8), np.uint32)
    masked = np.isnan(image)
    levels = np.where(masked, np.float32(low), image).astype(np.float64)
    levels -= low
    levels /= step
    target = _words(np.rint(levels, out=levels).clip(min=0.0, out=levels).astype(np.uint16), np.uint64)
    if masked.any():
        four = _shifted_images(masked.astype(np.uint8))
        target.view(np.uint16)[..., ::4][(four[0] | four[1] | four[2] | four[3]).view(bool)] = MASKED
    return target


def _words(levels: np.ndarray, word: type) -> np.ndarray:
    """Words of four levels each."""
    return cv2.merge(_shifted_images(levels)).view(word)[..., 0]


def _shifted_images(image: np.ndarray) -> list[np.ndarray]:
    """An image and its shifts to the right, below, and below right."""
    image = cv2.copyMakeBorder(image, 0, 1, 0, 1, cv2.BORDER_REPLICATE)
    return [image[:-1, :-1], image[:-1, 1:], image[1:, :-1], image[1:, 1:]]
