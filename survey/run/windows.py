"""Windows of photographs that show a tile of the ground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fields.sweep.view_pass import outline_of
from fields.sweep.views import Footprint
from refract import FlatWater, PinholeCamera
from survey.photos.cameras import View
from survey.photos.images import ImageStore
from survey.plan.tiling import Area

if TYPE_CHECKING:
    from geo.similarity import Similarity

# Windows begin at whole pixels of images at a quarter of the size. Their rows there are whole vectors of 16 pixels:
# other widths would need other kernels.
_BEGIN_PX, _ROWS_PX, _COLUMNS_PX = 4, 8, 64
# Beyond what shows the ground: windows of the first pass, at a quarter of the size, and their surroundings.
_MARGIN_PX = 32
# Smaller windows would hold few tiles of the sweep; a photograph with less of a tile than this adds nothing to it.
_LEAST_PX, _LEAST_SEEN_PX = 128, 8
# Of rays nearer to the horizon than this sine nothing is certain; and the share of its extent by which a footprint is
# wider than its outline says, for the motion of a camera.
_LEAST_FALL, _MARGIN = 0.05, 0.05


@dataclass(frozen=True)
class Window:
    """Part of a photograph at the size that is worked on, by its first row and column."""

    view: int
    row: int
    column: int
    height: int
    width: int

    @property
    def part(self) -> tuple[slice, slice]:
        """Rows and columns."""
        return slice(self.row, self.row + self.height), slice(self.column, self.column + self.width)


class Outlines:
    """Rays of the outlines of photographs, to leave out at once those that show nothing of a tile.

    Straight rays reach further than bent ones, so that no photograph is left out that shows it.

    Parameters
    ----------
    cameras : sequence of PinholeCamera
    """

    def __init__(self, cameras: Sequence[PinholeCamera]):
        self._centres = np.array([camera.centre for camera in cameras])
        outlines = [camera.outline() for camera in cameras]
        most = max(map(len, outlines))
        # Of equal length: the last place of a shorter one is repeated.
        rays = [
            camera.directions(np.pad(outline, ((0, most - len(outline)), (0, 0)), mode="edge"))
            for camera, outline in zip(cameras, outlines, strict=True)
        ]
        self._rays = np.array(rays)

    def may_show(
        self, water: FlatWater | None, area: Area, bound: tuple[float, float], moved: Similarity | None = None
    ) -> list[int]:
        """Numbers of the cameras that may show an area between two heights [m] over a plane, or over z = 0.

        ``moved`` is the transform into the frame of water and area, where this is another than that of the cameras.
        """
        centres = self._centres if moved is None else moved(self._centres)
        rays = self._rays if moved is None else self._rays @ moved.rotation.T
        up = np.array((0.0, 0.0, 1.0) if water is None else water.up)
        over = centres @ up if water is None else (centres - np.array(water.point)) @ up
        fall = -rays @ up
        is_certain = (fall > _LEAST_FALL).all(axis=1) & (over > bound[1])
        levels = np.array([bound[0], min(max(0.0, bound[0]), bound[1]), bound[1]])
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (over[:, None] - levels)[:, :, None] / fall[:, None]
        plan = (centres[:, None, None] + along[..., None] * rays[:, None])[..., :2].reshape(len(centres), -1, 2)
        low, high = np.minimum(plan.min(axis=1), centres[:, :2]), np.maximum(plan.max(axis=1), centres[:, :2])
        margin = _MARGIN * (high - low).max(axis=1, keepdims=True)
        meets = ((low - margin <= area[2:]) & (high + margin >= area[:2])).all(axis=1)
        return np.flatnonzero(meets | ~is_certain).tolist()


def windows_of(
    cameras: Mapping[int, PinholeCamera],
    water: FlatWater | None,
    own: Area,
    ground: Area,
    bound: tuple[float, float],
) -> list[Window]:
    """Windows of the views that show a tile.

    Parameters
    ----------
    cameras : mapping of number to PinholeCamera
        Of one size.
    own, ground : (x0, y0, x1, y1) [m]
        The tile without and with its rim.
    bound : (low, high) [m]
        Heights over the water plane between which the bed lies.
    """
    found = []
    tile = Footprint(np.array(own[:2]), np.array(own[2:]))
    for view, camera in cameras.items():
        # Of ground behind a camera nothing can be projected.
        if not Footprint.of(camera, water, bound).meets(tile):
            continue
        seen = _box(camera, water, own, bound, 0)
        if min(seen[2] - seen[0], seen[3] - seen[1]) < _LEAST_SEEN_PX:
            continue
        box = _box(camera, water, ground, bound, _MARGIN_PX)
        row, height = _side(box[0], box[2], camera.height, _ROWS_PX)
        column, width = _side(box[1], box[3], camera.width, _COLUMNS_PX)
        found.append(Window(view, row, column, height, width))
    return found


def _side(first: int, last: int, whole: int, step: int) -> tuple[int, int]:
    """Begin and length of a window along an axis of an image that is so long."""
    begin = first // _BEGIN_PX * _BEGIN_PX
    length = min(max(-(-(last - begin) // step) * step, _LEAST_PX), whole)
    return min(begin, whole - length) // _BEGIN_PX * _BEGIN_PX, length


def _box(
    camera: PinholeCamera, water: FlatWater | None, area: Area, bound: tuple[float, float], margin: int
) -> tuple[int, int, int, int]:
    """Top, left, bottom and right of the part of an image that may show an area; the whole where it is not certain."""
    size = np.array([camera.height, camera.width])
    seen = camera.project(outline_of(area, water, bound), water)[:, ::-1]
    if not np.isfinite(seen).all():
        return 0, 0, camera.height, camera.width
    low, high = np.floor(seen.min(axis=0)) - margin, np.ceil(seen.max(axis=0)) + margin
    # Equal ones, or in the wrong order, where it is not seen.
    top, left = np.maximum(low, 0.0).clip(max=size).astype(int).tolist()
    bottom, right = np.minimum(high, size).clip(min=0.0).astype(int).tolist()
    return top, left, bottom, right


class WindowStore:
    """Photographs of an `ImageStore` of which only windows are seen.

    Parameters
    ----------
    store : ImageStore
    views : mapping of name to (View, Window)
        The whole photograph, and its window.
    scale : [-]
        At which the windows were cut.
    """

    def __init__(self, store: ImageStore, views: Mapping[str, tuple[View, Window]], scale: float):
        self._store, self._views, self._scale = store, views, scale

    def load(self, view: View, *, scale: float = 1.0) -> np.ndarray:
        """The window (height, width, 3) uint8, RGB, of a view; black beyond the photograph."""
        if scale != 1.0:
            raise ValueError(f"windows are of one scale, expected 1, got {scale:g}")
        whole, window = self._views[view.name]
        image = self._store.load(whole, scale=self._scale)[window.part]
        rows, columns = window.height - image.shape[0], window.width - image.shape[1]
        return np.pad(image, ((0, rows), (0, columns), (0, 0))) if rows or columns else image
