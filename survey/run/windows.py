"""Windows of photographs that show a tile of the ground, all of one size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fields.sweep.view_pass import outline_of
from fields.sweep.views import Footprint
from refract import FlatWater, PinholeCamera
from survey.photos.cameras import View
from survey.photos.store import ImageStore
from survey.plan.tiling import Area, Tiling

# Windows begin at whole pixels of images at a quarter of the size, and have whole pixels at an eighth.
_BEGIN_PX, _WHOLE_PX = 4, 8
# Beyond what shows the ground: windows of the first pass, at a quarter of the size, and their surroundings.
_MARGIN_PX = 32
# Smaller windows would hold few tiles of the sweep; a photograph with less of a tile than this adds nothing to it.
_LEAST_PX, _LEAST_SEEN_PX = 96, 8


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


def windows_of(
    cameras: Sequence[PinholeCamera], water: FlatWater | None, tiling: Tiling, number: int, bound: tuple[float, float]
) -> list[Window]:
    """Windows of the views that show a tile, with its rim.

    Parameters
    ----------
    cameras : sequence of PinholeCamera
        Of one size.
    water : FlatWater or None
    tiling, number :
        The tile.
    bound : (low, high) [m]
        Heights over the water plane between which the bed lies.
    """
    boxes, area = {}, np.array(tiling.ground(number, 0.0))
    ground = Footprint(area[:2], area[2:])
    for view, camera in enumerate(cameras):
        # Of ground behind a camera nothing can be projected.
        if not Footprint.of(camera, water, bound).meets(ground):
            continue
        own = _box(camera, water, tiling.ground(number, 0.0), bound, 0)
        if min(own[2] - own[0], own[3] - own[1]) >= _LEAST_SEEN_PX:
            boxes[view] = _box(camera, water, tiling.ground(number, tiling.rim), bound, _MARGIN_PX)
    if not boxes:
        return []
    whole = (cameras[0].height, cameras[0].width)
    sides = [
        min(max(_up(max(box[axis + 2] - _down(box[axis]) for box in boxes.values())), _LEAST_PX), whole[axis])
        for axis in (0, 1)
    ]
    found = []
    for view, box in boxes.items():
        row, column = (_down(min(box[axis], whole[axis] - sides[axis])) for axis in (0, 1))
        found.append(Window(view, row, column, *sides))
    return found


def _down(value: int) -> int:
    return value // _BEGIN_PX * _BEGIN_PX


def _up(value: int) -> int:
    return -(-value // _WHOLE_PX) * _WHOLE_PX


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
