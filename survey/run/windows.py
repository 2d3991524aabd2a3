"""Windows of photographs that show a tile of the ground.

All tiles are in the local frame of the survey: float32 holds a place to half a millimetre 5 km from its origin, where a
bed comes out 0.4 mm too high.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fields.sweep.view_pass import outline_of
from fields.sweep.views import Footprint, pixels_in
from refract import FlatWater, PinholeCamera
from survey.photos.cameras import View
from survey.photos.images import ImageStore
from survey.plan.area import Area, within

if TYPE_CHECKING:
    from survey.folder.survey import Survey
    from survey.plan.area import Tiling

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
# A survey that reaches further from its origin along x or y is larger than a kilometre [m].
_FAR_M = 500.0


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


@dataclass(frozen=True)
class BedSearch:
    """Heights and photographs of the search for the bed."""

    bound: tuple[float, float]  # (low, high) [m]: heights over the water plane between which the bed lies
    views: list[int]  # Those that get height maps
    # Bound of each tile over a plane of its own [m], where tiles have ranges of their own
    bounds: tuple[tuple[float, float], ...] | None = None
    windows: tuple[list[Window], ...] | None = None  # Those of each tile, where they are known


class Outlines:
    """Rays of the outlines of photographs, to leave out at once those that show nothing of a tile.

    Straight rays reach further than bent ones, so that no photograph is left out that shows it.
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
        self._cameras, self._footprints = cameras, dict[tuple, dict[int, Footprint]]()

    def footprints(
        self, numbers: Sequence[int], water: FlatWater | None, bound: tuple[float, float]
    ) -> dict[int, Footprint]:
        """Footprints of cameras between two heights [m], worked out once for all tiles over one plane."""
        known = self._footprints.setdefault((water, bound), {})
        new = [number for number in numbers if number not in known]
        if new:
            found = Footprint.of_each([self._cameras[number] for number in new], water, bound)
            known.update(zip(new, found, strict=True))
        return {number: known[number] for number in numbers}

    def may_show(self, water: FlatWater | None, area: Area, bound: tuple[float, float]) -> list[int]:
        """Numbers of the cameras that may show an area between two heights [m] over a plane, or over z = 0."""
        centres, rays = self._centres, self._rays
        up = np.array((0.0, 0.0, 1.0) if water is None else water.up)
        over = centres @ up if water is None else (centres - np.array(water.point)) @ up
        cos_nadir = -rays @ up
        is_certain = (cos_nadir > _LEAST_FALL).all(axis=1) & (over > bound[1])
        levels = np.array([bound[0], min(max(0.0, bound[0]), bound[1]), bound[1]])
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (over[:, None] - levels)[:, :, None] / cos_nadir[:, None]
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
    footprints: Mapping[int, Footprint] | None = None,
) -> list[Window]:
    """Windows of the views that show a tile (x0, y0, x1, y1) [m], ``own`` without and ``ground`` with its rim.

    By cameras of one size; ``bound`` (low, high) [m] are the heights over the water plane between which the bed lies,
    ``footprints`` those of the cameras between them, where they are known.
    """
    found = []
    tile = Footprint(np.array(own[:2]), np.array(own[2:]))
    if footprints is None:
        footprints = dict(zip(cameras, Footprint.of_each(list(cameras.values()), water, bound), strict=True))
    # Of ground behind a camera nothing can be projected.
    meeting = [view for view in cameras if footprints[view].meets(tile)]
    outlines = [outline_of(area, water, bound) for area in (own, ground)]
    places = np.concatenate(outlines)
    pixels = pixels_in([cameras[view] for view in meeting], [places] * len(meeting), water)
    for view, of_both in zip(meeting, pixels, strict=True):
        camera, (of_own, of_ground) = cameras[view], np.split(of_both[:, ::-1], [len(outlines[0])])
        seen, box = _box(camera, of_own, 0), _box(camera, of_ground, _MARGIN_PX)
        if min(seen[2] - seen[0], seen[3] - seen[1]) < _LEAST_SEEN_PX:
            continue
        row, height = _side(box[0], box[2], camera.height, _ROWS_PX)
        column, width = _side(box[1], box[3], camera.width, _COLUMNS_PX)
        found.append(Window(view, row, column, height, width))
    return found


def _side(first: int, last: int, size: int, step: int) -> tuple[int, int]:
    """Begin and length of a window along an axis of an image that is so long."""
    begin = first // _BEGIN_PX * _BEGIN_PX
    length = min(max(-(-(last - begin) // step) * step, _LEAST_PX), size)
    return min(begin, size - length) // _BEGIN_PX * _BEGIN_PX, length


def _box(camera: PinholeCamera, seen: np.ndarray, margin: int) -> tuple[int, int, int, int]:
    """Top, left, bottom and right of an image about places (N, 2), (row, column) [px], with a margin [px].

    The whole image where it is not certain.
    """
    size = np.array([camera.height, camera.width])
    if not np.isfinite(seen).all():
        return 0, 0, camera.height, camera.width
    low, high = np.floor(seen.min(axis=0)) - margin, np.ceil(seen.max(axis=0)) + margin
    # Equal ones, or in the wrong order, where it is not seen.
    top, left = np.maximum(low, 0.0).clip(max=size).astype(int).tolist()
    bottom, right = np.minimum(high, size).clip(min=0.0).astype(int).tolist()
    return top, left, bottom, right


class WindowStore:
    """Photographs of an `ImageStore` of which only windows, cut at a scale, are seen.

    ``views`` has the whole photograph and its window, by name.
    """

    def __init__(self, store: ImageStore, views: Mapping[str, tuple[View, Window]], scale: float):
        self._store, self._views, self._scale = store, views, scale

    def load(self, view: View, *, scale: float = 1.0) -> np.ndarray:
        """The window (height, width, 3) uint8, RGB, of a view; black beyond the photograph."""
        if scale != 1.0:
            raise ValueError(f"windows are of one scale, expected 1, got {scale:g}")
        full_view, window = self._views[view.name]
        image = self._store.load(full_view, scale=self._scale)[window.part]
        rows, columns = window.height - image.shape[0], window.width - image.shape[1]
        return np.pad(image, ((0, rows), (0, columns), (0, 0))) if rows or columns else image


def has_own_ranges(tiling: Tiling) -> bool:
    """Whether each tile of a survey has a range of heights of its own: where it is larger than a kilometre."""
    return max(map(abs, (*tiling.x, *tiling.y))) > _FAR_M


def survey_over(survey: Survey, ground: Area) -> Survey:
    """The survey with the views and matched points over some ground alone; with all views where none is over it."""
    views = tuple(view for view in survey.views if within(view.camera.centre[None], ground)[0])
    points = survey.observations.points
    points = None if points is None else points[within(points, ground)]
    return replace(survey, views=views or survey.views, observations=replace(survey.observations, points=points))
