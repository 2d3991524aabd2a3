"""One ladder of heights for one view: in strips of rows that bound the memory, or in tiles."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any

import cv2
import numpy as np

from fields.sweep.arrays import floats
from fields.sweep.backends import scoring, warping
from fields.sweep.in_turn import Job, Launched, alone
from fields.sweep.stack import ViewStack
from fields.sweep.tiles import Tiles

# Height [m], score and curvature [1/m^2] of each pixel.
Found = tuple[np.ndarray, np.ndarray, np.ndarray]
# A score below this is meaningless: no window was complete (-1), or the windows have no texture (0, but for rounding).
MATCHED_NCC = 0.05
# Floats of the widest vectors.
_VECTOR = 16
# A run of tiles costs, beside its samples, as much as so many.
_LAUNCH_SAMPLES = 600_000


def climb_view(
    stack: ViewStack,
    view: int,
    others: list[int],
    start: np.ndarray,
    step: float,
    rungs: int,
    radius: int,
    columns: np.ndarray | None = None,
    least_known: float = 1.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Best height of each pixel of a view on a ladder that begins at ``start``.

    Parameters
    ----------
    stack : ViewStack
    view, others : indices of the reference view and the views it is compared with
    start : (height, width) [m]
        Height over the water plane of the first rung, per pixel; rung j is ``start + j * step``.
    step : [m]
    radius : [px]
        Of the NCC window.
    columns : (height, 2) int, optional
        First column, and the one after the last, in which each row is wanted; equal ones where none is. The others are
        as if no window were complete.
    least_known : [-]
        Windows of which such a share is not masked count as complete.

    Returns
    -------
    height [m], score [-], curvature [1/m^2] : each (height, width) float32
        Where no window is complete (at the image's edge, by masked pixels, out of sight of the others) the score is
        -1 and the curvature 0. There, and where there is no texture, the height is that of the nearest matched pixel.
    """
    job = climbing_view(stack, view, others, start, step, rungs, radius, columns, least_known)
    return alone(stack.device, job)


def climbing_view(
    stack: ViewStack,
    view: int,
    others: list[int],
    start: np.ndarray,
    step: float,
    rungs: int,
    radius: int,
    columns: np.ndarray | None = None,
    least_known: float = 1.0,
) -> Job[Found]:
    """`climb_view` as a job."""
    images = warping(stack.device)
    width, height = stack.width, stack.height
    rows = max(4 * radius + 4, min(height, images.STRIP_SAMPLES // (len(others) * rungs * width)))
    found = [np.array(start, dtype=np.float32), *(np.full((height, width), v, np.float32) for v in (-1.0, 0.0))]
    columns = np.tile([0, width], (height, 1)) if columns is None else columns
    wanted = np.flatnonzero(columns[:, 1] > columns[:, 0])
    wanted = wanted[(wanted >= radius) & (wanted < height - radius)] if width > 2 * radius else wanted[:0]
    for first in range(wanted[0], wanted[-1] + 1, rows) if len(wanted) else ():
        last = min(first + rows, wanted[-1] + 1)
        here = columns[wanted[(wanted >= first) & (wanted < last)]]
        if not len(here):
            continue
        left, right = _span(int(here[:, 0].min()), int(here[:, 1].max()), width, radius)
        inner = np.s_[max(int(here[:, 0].min()), radius) : min(int(here[:, 1].max()), width - radius)]
        strip = np.s_[first - radius : last + radius, left:right]
        legs = partial(_legs, images, stack, view, strip)
        grey, begin = stack.images[view][strip], start[strip]
        results = yield partial(
            _launch, stack, others, legs, grey, begin, step, rungs, right - left, radius, least_known
        )
        for target, result in zip(found, results, strict=True):
            # The results begin with the first whole window: `radius` pixels into the first row of the target.
            image = np.pad(result, radius).reshape(-1, right - left)
            target[first:last, inner] = image[:, inner.start - left : inner.stop - left]
    return _filled(found[0], found[1] > MATCHED_NCC), found[1], found[2]


def climbing_tiles(
    stack: ViewStack,
    view: int,
    others: list[int],
    tiles: Tiles,
    starts: Callable[[slice, np.ndarray], np.ndarray],
    step: float,
    take: Callable[[np.ndarray, np.ndarray, list[np.ndarray]], None],
    least_known: float = 1.0,
) -> Job[None]:
    """As `climbing_view`, of tiles with their halos, a run of n of them at a time.

    ``starts`` gives the first rungs [m] of a run, with the flat indices of its pixels, both (n, side, side).
    ``take`` is called with what each run finds:

    own : (n, side, side) bool
        Which pixels are wanted, in their own tile, and have a whole window.
    pixels : (n, side, side) int
        Flat indices.
    height [m], score [-], curvature [1/m^2] : list of (n, side, side) float32
    """
    images, side, radius = warping(stack.device), tiles.side, tiles.radius
    for part, rungs in tiles.batches(images.STRIP_SAMPLES // len(others), _LAUNCH_SAMPLES // len(others)):
        pixels = tiles.pixels(part)
        legs = partial(images.legs_at, stack, view, pixels.ravel())
        grey, begin = stack.images[view].ravel()[pixels], starts(part, pixels)
        results = yield partial(_launch, stack, others, legs, grey, begin, step, rungs, side, radius, least_known)
        # The first window begins `radius` pixels into the first row.
        climbed = [np.pad(each, radius * (side + 1)).reshape(pixels.shape) for each in results]
        take(tiles.own(part, pixels), pixels, climbed)


def _launch(
    stack: ViewStack,
    others: list[int],
    legs: Callable[[], Any],
    grey: np.ndarray,
    start: np.ndarray,
    step: float,
    rungs: int,
    width: int,
    radius: int,
    least_known: float,
) -> Launched:
    """Kernels for a strip, or for tiles, of a width: its grey levels and first rungs [m], of one shape."""
    device = stack.device
    images, scores = warping(device), scoring(device)
    # Before anything is launched.
    rooms = scores.rooms(device, len(others), start.size * rungs)
    paths, reference, begin = legs(), floats(device, grey), floats(device, start)
    images.warp_into(rooms, stack, paths, start, others, step, rungs)
    windows = scores.windows(device, reference, rooms, width, radius)
    mean = scores.best_half(device, scores.ncc_of(windows, radius, least_known))
    return Launched(list(scores.climb(device, mean, begin, step, rungs)), (paths, reference, windows, begin))


def _span(first: int, last: int, width: int, radius: int) -> tuple[int, int]:
    """Columns of an image that a strip takes for wanted ones: with a halo, and whole vectors where there is room.

    Which rows of a window begin a vector in memory is a part of the kernel: other widths would need other kernels.
    """
    left = max(first - radius, 0)
    # At least one window wide, where no column is wanted too.
    right = max(min(last + radius, width), left + 2 * radius + 1)
    right = left + _VECTOR * -(-(right - left) // _VECTOR)
    left = max(left - max(right - width, 0), 0)
    return left, min(right, width)


def _legs(images: ModuleType, stack: ViewStack, view: int, strip: tuple[slice, slice]):
    """Legs of a strip of pixels: of whole rows, or of a part of their columns."""
    rows, columns = strip
    if columns.stop - columns.start == stack.width:
        return images.legs_of(stack, view, rows.start, rows.stop - rows.start)
    index = np.arange(rows.start, rows.stop)[:, None] * stack.width + np.arange(columns.start, columns.stop)
    return images.legs_at(stack, view, index.ravel())


def _filled(height: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Heights in which unknown ones are replaced by that of the nearest known pixel.

    Otherwise they would stay at the lowest rung in all views alike, and seem to agree.
    """
    if known.all() or not known.any():
        return height
    _, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.empty(nearest.max() + 1, dtype=np.float32)
    of_label[nearest[known]] = height[known]
    return of_label[nearest]
