"""One ladder of heights for one view: in strips of rows that bound the memory, or in tiles."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from fields.sweep.arrays import floats
from fields.sweep.backends import images, scoring, warping
from fields.sweep.in_turn import Job, Launched, alone
from fields.sweep.stack import ViewStack
from fields.sweep.tiles import Tiles

# Height [m], score and curvature [1/m^2] of each pixel: images of `fields.sweep.backends.images`.
Found = tuple[Any, Any, Any]
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
    beside = images(stack.device)
    start = beside.placed(stack.device, start)
    job = climbing_view(stack, view, others, start, step, rungs, radius, columns, least_known)
    height, score, curvature = (beside.fetched(each) for each in alone(stack.device, job))
    return height, score, curvature


def climbing_view(
    stack: ViewStack,
    view: int,
    others: list[int],
    start: Any,
    step: float,
    rungs: int,
    radius: int,
    columns: np.ndarray | None = None,
    least_known: float = 1.0,
) -> Job[Found]:
    """`climb_view` as a job, from heights and to what it finds where the device has its images."""
    beside = images(stack.device)
    width, height = stack.width, stack.height
    rows = max(4 * radius + 4, min(height, warping(stack.device).STRIP_SAMPLES // (len(others) * rungs * width)))
    none = (beside.full(stack.device, (height, width), value) for value in (-1.0, 0.0))
    found = [beside.flat_copy(start), *(beside.pixels_of(each) for each in none)]
    columns = np.tile([0, width], (height, 1)) if columns is None else columns
    wanted = np.flatnonzero(columns[:, 1] > columns[:, 0])
    wanted = wanted[(wanted >= radius) & (wanted < height - radius)] if width > 2 * radius else wanted[:0]
    for first in range(wanted[0], wanted[-1] + 1, rows) if len(wanted) else ():
        last = min(first + rows, wanted[-1] + 1)
        here = columns[wanted[(wanted >= first) & (wanted < last)]]
        if not len(here):
            continue
        left, right = _span(int(here[:, 0].min()), int(here[:, 1].max()), width, radius)
        inner = slice(max(int(here[:, 0].min()), radius), min(int(here[:, 1].max()), width - radius))
        strip = np.s_[first - radius : last + radius, left:right]
        grey, begin = beside.grey(stack, view, strip), beside.cut(start, strip)
        legs = partial(_legs, stack, view, strip)
        results = yield partial(
            _launch, stack, others, legs, grey, begin, step, rungs, right - left, radius, least_known
        )
        for target, result in zip(found, results, strict=True):
            beside.put_strip(target, width, result, slice(first, last), inner, strip[1], radius)
    best, score, curvature = (beside.shaped(each, (height, width)) for each in found)
    return beside.filled(best, score > MATCHED_NCC), score, curvature


def climbing_tiles(
    stack: ViewStack,
    view: int,
    others: list[int],
    tiles: Tiles,
    starts: Callable[[slice, Any], Any],
    step: float,
    take: Callable[[Any, Any, list[Any]], None],
    least_known: float = 1.0,
) -> Job[None]:
    """As `climbing_view`, of tiles with their halos, a run of them at a time.

    ``starts`` gives the first rungs [m] of a run, with the flat indices of its pixels. ``take`` is called with what
    each run finds, flat, for those of its pixels around which a whole window may lie:

    own : bool
        Which pixels are wanted, in their own tile, and have a whole window.
    pixels : int
        Flat indices.
    height [m], score [-], curvature [1/m^2] : list of float32
    """
    beside, side, radius = images(stack.device), tiles.side, tiles.radius
    most, launch = (num // len(others) for num in (warping(stack.device).STRIP_SAMPLES, _LAUNCH_SAMPLES))
    # The first window begins so many pixels into the first tile.
    lost = radius * (side + 1)
    for part, rungs in tiles.batches(most, launch):
        pixels = beside.tile_pixels(stack.device, tiles, part)
        legs = partial(warping(stack.device).legs_at, stack, view, pixels)
        grey, begin = beside.grey_at(stack, view, pixels), starts(part, pixels)
        results = yield partial(_launch, stack, others, legs, grey, begin, step, rungs, side, radius, least_known)
        take(beside.own(stack.device, tiles, part, pixels, lost), beside.whole_windows(pixels, lost), results)


def _launch(
    stack: ViewStack,
    others: list[int],
    legs: Callable[[], Any],
    grey: Any,
    start: Any,
    step: float,
    rungs: int,
    width: int,
    radius: int,
    least_known: float,
) -> Launched:
    """Kernels for a strip, or for tiles, of a width: its grey levels and first rungs [m], of one shape."""
    device, scores = stack.device, scoring(stack.device)
    # Before anything is launched.
    rooms = scores.rooms(device, len(others), math.prod(start.shape) * rungs)
    paths, reference, begin = legs(), floats(device, grey), floats(device, start)
    warping(device).warp_into(rooms, stack, paths, start, others, step, rungs)
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


def _legs(stack: ViewStack, view: int, strip: tuple[slice, slice]):
    """Legs of a strip of pixels: of whole rows, or of a part of their columns."""
    rows, columns = strip
    if columns.stop - columns.start == stack.width:
        return warping(stack.device).legs_of(stack, view, rows.start, rows.stop - rows.start)
    places = images(stack.device).places_in(stack.device, strip, stack.width)
    return warping(stack.device).legs_at(stack, view, places)
