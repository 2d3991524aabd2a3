"""Steps of the bed: where the heights around a pixel differ by more than a ladder reaches, all between them are tried.

The window of a coarse pass that holds the edge of a wall and the ground beside it finds one height, that of the side
with more texture, and the ladders of later passes do not reach the other side. Views from one side agree on that error,
so that nothing later takes it away. Here such pixels climb a ladder over all heights around them, in small tiles with
one level ladder each: a window needs its surroundings at its own height, not at those of the pass before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from fields.sweep.arrays import floats, host
from fields.sweep.backends import scoring, warping
from fields.sweep.climbing import MATCHED_NCC
from fields.sweep.stack import ViewStack

# Side of a tile without its halo [px]: small ones share little, large ones hold heights that few of their pixels need.
TILE_PX = 8
# Rungs of a ladder are a multiple of this and one: other numbers would need other kernels.
RUNGS_OF = 8


@dataclass(frozen=True)
class StepSearch:
    """How steps are searched after a pass.

    Attributes
    ----------
    radius : of the NCC window [px]
    step_px : parallax between two rungs [px at the scale of the pass]
    around_px : heights this far around a pixel bound its ladder [px at the scale of the pass]
    least_score : views are searched of which half of the pixels scored so high in the pass: windows of this size can
        tell heights in them
    """

    radius: int
    step_px: float
    around_px: int
    least_score: float


def search_steps(
    stack: ViewStack,
    view: int,
    others: list[int],
    found: tuple[np.ndarray, np.ndarray, np.ndarray],
    parallax: float,
    reach_px: float,
    search: StepSearch,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Height, score and curvature of a pass, with those of the search where heights around differ.

    Parameters
    ----------
    stack : ViewStack
    view, others : indices of the reference view and the views it is compared with
    found : height [m], score, curvature [1/m^2], (height, width) float32 each
        As `fields.sweep.climbing.climb_view` gives.
    parallax : [px/m]
        At the scale of the stack, per metre of height.
    reach_px : [px]
        Parallax from the middle of the pass's ladder to its end: searched are pixels around which heights differ by
        more.
    search : StepSearch
    """
    height, score = found[0], found[1]
    side = TILE_PX + 2 * search.radius
    if min(height.shape) < side or np.median(score) < search.least_score:
        return found
    low, high = _around(height, search.around_px)
    wanted = (high - low) * parallax > reach_px
    if not wanted.any():
        return found
    step = search.step_px / parallax
    tiles = _Tiles.of(wanted, low, high, step, search.radius)
    results = [np.array(each) for each in found]
    device = stack.device
    images, scores = warping(device), scoring(device)
    for part, rungs in tiles.batches(images.STRIP_SAMPLES // len(others)):
        pixels = tiles.pixels(part)
        legs = images.legs_at(stack, view, pixels.ravel())
        start = floats(device, np.repeat(tiles.start[part], side * side))
        grey = floats(device, stack.images[view].ravel()[pixels])
        values = images.warp(stack, legs, start, others, step, rungs)
        mean = scores.best_half(device, scores.ncc(device, grey, values, side, search.radius))
        climbed = [host(device, each) for each in scores.climb(device, mean, start, step, rungs)]
        # The first window begins `radius` pixels into the first row.
        climbed = [np.pad(each, search.radius * (side + 1)).reshape(pixels.shape) for each in climbed]
        keep = tiles.own(part, pixels) & (climbed[1] > MATCHED_NCC)
        for result, each in zip(results, climbed, strict=True):
            result.flat[pixels[keep]] = each[keep]
    return results[0], results[1], results[2]


def _around(height: np.ndarray, radius: int) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest height within a radius [px] of each pixel, without single wrong ones."""
    kernel = np.ones((2 * radius + 1,) * 2, dtype=np.uint8)
    height = cv2.medianBlur(height, 3)
    return cv2.erode(height, kernel), cv2.dilate(height, kernel)


@dataclass(frozen=True)
class _Tiles:
    """Tiles of an image that hold the wanted pixels, by rising number of rungs; N of them.

    Attributes
    ----------
    wanted : (height, width) bool
    radius : of the halo [px]
    place : (N, 2) int
        Row and column among all tiles of the image.
    start : (N,) float32 [m]
        First rung.
    rungs : (N,) int
    """

    wanted: np.ndarray
    radius: int
    place: np.ndarray
    start: np.ndarray
    rungs: np.ndarray

    @staticmethod
    def of(wanted: np.ndarray, low: np.ndarray, high: np.ndarray, step: float, radius: int) -> _Tiles:
        """With ladders from below the lowest to above the highest height [m] of their wanted pixels."""
        least = _in_tiles(np.where(wanted, low, np.inf), np.inf).min(axis=(1, 3))
        most = _in_tiles(np.where(wanted, high, -np.inf), -np.inf).max(axis=(1, 3))
        place = np.argwhere(np.isfinite(least))
        least, most = least[tuple(place.T)], most[tuple(place.T)]
        rungs = np.ceil((most - least) / step).astype(int) + 3
        rungs = RUNGS_OF * -(-(rungs - 1) // RUNGS_OF) + 1
        order = np.argsort(rungs, kind="stable")
        return _Tiles(wanted, radius, place[order], (least[order] - step).astype(np.float32), rungs[order])

    def batches(self, most: int) -> Iterator[tuple[slice, int]]:
        """Runs of tiles with the number of rungs that all of them climb, of at most so many pixels times rungs."""
        size, first = (TILE_PX + 2 * self.radius) ** 2, 0
        while first < len(self.rungs):
            samples = size * np.arange(1, len(self.rungs) - first + 1) * self.rungs[first:]
            count = max(int(np.searchsorted(samples, most, side="right")), 1)
            yield slice(first, first + count), int(self.rungs[first + count - 1])
            first += count

    def pixels(self, part: slice) -> np.ndarray:
        """Flat indices (n, side, side) of the pixels of tiles with their halo, moved into the image at its edges."""
        side = TILE_PX + 2 * self.radius
        corner = np.clip(TILE_PX * self.place[part] - self.radius, 0, np.array(self.wanted.shape) - side)
        rows, columns = (corner[:, axis, None] + np.arange(side) for axis in (0, 1))
        return rows[:, :, None] * self.wanted.shape[1] + columns[:, None, :]

    def own(self, part: slice, pixels: np.ndarray) -> np.ndarray:
        """Which pixels (n, side, side) are wanted, in their own tile, and have a whole window in it."""
        rows, columns = np.divmod(pixels, self.wanted.shape[1])
        row, column = self.place[part, 0, None, None], self.place[part, 1, None, None]
        own = self.wanted.ravel()[pixels] & (rows // TILE_PX == row) & (columns // TILE_PX == column)
        inner = np.zeros(pixels.shape[1:], dtype=bool)
        inner[self.radius : -self.radius, self.radius : -self.radius] = True
        return own & inner


def _in_tiles(image: np.ndarray, beyond: float) -> np.ndarray:
    """An image cut into tiles (rows, TILE_PX, columns, TILE_PX), continued by a value."""
    down, right = (-size % TILE_PX for size in image.shape)
    image = np.pad(image, ((0, down), (0, right)), constant_values=beyond)
    return image.reshape(image.shape[0] // TILE_PX, TILE_PX, -1, TILE_PX)
