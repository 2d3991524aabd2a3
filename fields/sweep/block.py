"""The views of one survey as the sweep matches them: images, cameras, water, overlap."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property

import cv2
import numpy as np
from scipy.sparse import csr_array

from fields.device import Device
from fields.image_store import GreyImages, LazyImages
from fields.sweep import views
from fields.sweep.kernels.arrays import release
from fields.sweep.kernels.stack import ViewStack, largest
from fields.sweep.tiles import CornerRays
from refract import BentPaths, FlatWater, PinholeCamera

MOST_NEIGHBOURS = 12  # Neighbours that are found at once
AGREEMENT_PX = 0.7  # Two heights agree when their difference would show as less than this parallax
# Side of the surroundings of a hole [px], and the least known share of them, and of the area of a reduced pixel.
_AROUND_PX, _KNOWN, _KNOWN_OF_AREA = 5, 0.5, 0.2
_REACH_PX = 1.5  # Standard deviation of the weights of the mean [px]


class Overlap:
    """Overlap of cameras on a level bed, in the local frame; needs no images.

    Raises ValueError if no camera looks down. ``height`` [m]: rough height of the bed over the water plane (over local
    z = 0 in a dry survey): overlap is judged there. ``ground`` (x0, y0, x1, y1) [m], local, optional: where overlap
    counts; by default everywhere.
    """

    def __init__(
        self,
        cameras: list[PinholeCamera],
        water: FlatWater | None,
        height: float,
        ground: tuple[float, float, float, float] | None = None,
    ):
        self.cameras, self.water, self.ground = cameras, water, ground
        self._middle_paths = dict[int, BentPaths]()
        self.set_overlap_height(height)

    def set_overlap_height(self, height: float) -> None:
        """Set the height [m] over the water plane at which overlap is judged; clears neighbours and coverage."""
        views.require_ground(self.cameras, self._z_of(height))
        self.height = height
        self._found_neighbours = dict[tuple[int, tuple[int, ...] | None], list[int]]()
        self.__dict__.pop("_coverage", None)

    def _z_of(self, height: float) -> float:
        if self.water is None:
            return height
        # Under the cameras: the reference point of the plane may be far away.
        x, y, _ = np.mean([camera.centre for camera in self.cameras], axis=0)
        return float(self.water.height(x, y)) + height

    @cached_property
    def _coverage(self) -> tuple[csr_array, np.ndarray]:
        return views.coverage(self.cameras, self.water, self._z_of(self.height), self.ground)

    @property
    def seen(self) -> csr_array:
        """Visibility of cells of the ground in views, (views, cells) bool, sparse; `fields.sweep.views.coverage`."""
        return self._coverage[0]

    @property
    def cells(self) -> np.ndarray:
        """The cells (cells, 3) [m], local."""
        return self._coverage[1]

    def cover(self, times: int, times_oblique: int, area: tuple[float, float, float, float] | None = None) -> list[int]:
        """Set of views that see every place from every side: `fields.sweep.views.cover`.

        ``area`` (x0, y0, x1, y1) [m], local, leaves out the places beyond it.
        """
        seen = self.seen
        if area is not None:
            x, y = self.cells[:, 0], self.cells[:, 1]
            inside = (x >= area[0]) & (y >= area[1]) & (x <= area[2]) & (y <= area[3])
            seen = csr_array(seen.multiply(inside)) if inside.any() else seen
        return views.cover(seen, self.cells, self.cameras, times, times_oblique)

    def neighbours(self, view: int, count: int, candidates: list[int] | None = None) -> list[int]:
        """Neighbour views of a view (of ``candidates``, default all), best first, at most ``count``."""
        # Each is the best beside those before it: fewer of them are the first of more.
        key, most = (view, None if candidates is None else tuple(candidates)), max(count, MOST_NEIGHBOURS)
        if count > MOST_NEIGHBOURS or key not in self._found_neighbours:
            candidates = list(range(len(self.cameras))) if candidates is None else candidates
            self._found_neighbours[key] = views.neighbours(self.cameras, self.seen, self.cells, view, candidates, most)
        return self._found_neighbours[key][:count]

    def parallax(self, view: int, others: list[int], height: float) -> float:
        """Parallax [px/m] at full size in other views per metre of height of a bed point of `view`."""
        if view not in self._middle_paths:
            self._middle_paths[view] = views.middle_path(self.cameras[view], self.water)
        return views.parallax(self.cameras, self.water, self._middle_paths[view], others, height)

    def agreement_tolerance(self, view: int, others: list[int], height: float) -> float:
        """Height difference [m] that shows as a parallax of `AGREEMENT_PX`: closer heights agree."""
        return AGREEMENT_PX / self.parallax(view, others, height)


class Block(Overlap):
    """Grey images of one size with their cameras, in the local frame.

    Raises ValueError if fewer than two views are given, or none looks down. ``cameras``: all of the images' size;
    smaller images are padded with NaN, as are masked and saturated pixels. ``images`` (height, width) float32 each:
    grey levels about zero; read once and kept as `GreyImages`. ``water``, ``height``, ``ground``: as `Overlap`.
    ``saturated``: share of each photograph that is masked as saturated; empty where it was not measured.
    """

    def __init__(
        self,
        device: Device,
        cameras: list[PinholeCamera],
        images: Iterable[np.ndarray],
        water: FlatWater | None,
        height: float,
        saturated: Sequence[float] = (),
        ground: tuple[float, float, float, float] | None = None,
    ):
        self.device = device
        self.images = images if isinstance(images, GreyImages) else GreyImages(images)
        if len(cameras) < 2 or len(cameras) != len(self.images):
            raise ValueError(
                f"a block needs two views or more, each with an image; got {len(cameras)} and {len(self.images)}"
            )
        super().__init__(cameras, water, height, ground)
        self.saturated = tuple(saturated)
        self._stacks: dict[float, ViewStack] = {}
        self._corner_rays: dict[tuple[int, tuple[int, int]], CornerRays] = {}

    def stack(self, scale: float) -> ViewStack:
        """Images and cameras at a scale, kept on the device until `release`."""
        if scale not in self._stacks:
            cameras = [c.scaled(scale) if scale != 1.0 else c for c in self.cameras]
            full_size = self.images
            images: Sequence[np.ndarray] = full_size
            if scale != 1.0:
                images = LazyImages(
                    lambda view: fill_small_holes(
                        downsample(full_size[view], (cameras[view].width, cameras[view].height))
                    ),
                    len(cameras),
                    largest(cameras),
                )
            elif not self.images.are_unmasked:
                images = LazyImages(lambda view: fill_small_holes(full_size[view]), len(cameras), largest(cameras))
            self._stacks[scale] = ViewStack.build(self.device, cameras, images, self.water)
        return self._stacks[scale]

    def corner_rays(self, view: int, squares: tuple[int, int]) -> CornerRays:
        """Rays through the corners of the squares of a view, so many rows and columns; found once."""
        key = view, squares
        if key not in self._corner_rays:
            self._corner_rays[key] = CornerRays.of(self.cameras[view], self.water, squares)
        return self._corner_rays[key]

    def with_images(self, images: GreyImages) -> Block:
        return Block(self.device, self.cameras, images, self.water, self.height, self.saturated, self.ground)

    def part(self, chosen: list[int]) -> Block:
        cameras, images = [self.cameras[view] for view in chosen], (self.images[view] for view in chosen)
        return Block(self.device, cameras, images, self.water, self.height)

    def release(self, scale: float) -> None:
        """Drop the images at a scale."""
        self._stacks.pop(scale, None)
        release(self.device)


def fill_small_holes(image: np.ndarray) -> np.ndarray:
    """Image (height, width) float32 with small holes of NaN filled by whole levels."""
    known = np.isfinite(image)
    if known.all():
        return image
    weight = known.astype(np.float32)
    share = cv2.blur(weight, (_AROUND_PX, _AROUND_PX), borderType=cv2.BORDER_REPLICATE)
    values, weights = (
        cv2.GaussianBlur(each, (0, 0), _REACH_PX, borderType=cv2.BORDER_REPLICATE)
        for each in (np.where(known, image, np.float32(0.0)), weight)
    )
    mean = np.rint(values / np.maximum(weights, 1e-6))
    return np.where(known, image, np.where(share >= _KNOWN, mean, np.float32(np.nan)))


def downsample(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Image reduced to a size (width, height): means over what is known of each pixel's area, NaN below a fifth."""
    known = np.isfinite(image)
    if known.all():
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    value, share = (
        cv2.resize(each.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        for each in (np.where(known, image, np.float32(0.0)), known)
    )
    return np.where(share >= _KNOWN_OF_AREA, value / np.maximum(share, 1e-6), np.float32(np.nan))
