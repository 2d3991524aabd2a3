"""Matching of a reference view, the best of the height hypotheses of each pixel, in strips of rows or in tiles; passes.

The coarse-to-fine passes of the sweep have a scale, windows, hypotheses and neighbours each.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np

from fields.device import Device
from fields.sweep.images import fill_nearest, median_above, put_strip, strip_indices
from fields.sweep.kernels.arrays import Job, Launch, floats
from fields.sweep.kernels.rays import rays_of_pixels, rays_of_rows
from fields.sweep.kernels.stack import Hypotheses, ViewStack
from fields.sweep.tiles import ImageTiles

# A score below this is meaningless: no window was complete (-1), or the windows have no texture (0, but for rounding).
MATCHED_NCC = 0.05
REFINING = 3  # Hypotheses of a pass that searches nothing


@dataclass(frozen=True)
class DiscontinuitySearch:
    """Search at height discontinuities after a pass."""

    radius: int  # of the NCC window [px]
    spacing_px: float  # parallax between two hypotheses [px at the scale of the pass]
    # side of the tiles that share their hypotheses [px]: small ones share little, large ones hold heights that few of
    # their pixels need
    tile_px: int
    # searched are pixels around which heights differ by more than this parallax [px at the scale of the pass]
    reach_px: float
    around_px: int  # heights this far around a pixel bound its hypotheses [px at the scale of the pass]
    # median score of a view in the pass from which it is searched: windows of this size resolve heights
    least_score: float
    walls: bool = False  # whether vertical walls are tried, beside level ground
    neighbours: int = 6  # how many of the views of the pass heights are compared with, of those that match best


# Approximate share of the samples of a full pass in one that takes points alone, with the halos of their tiles: a
# seventh of data/river, a fifth of data/wreck_water, half of data/quick, whose 21 photographs see little ground.
POINTS_SHARE = 0.25


@dataclass(frozen=True)
class Pass:
    """Settings of a pass over all views, with hypotheses about the heights of the pass before."""

    scale: float  # of the image, 1 is full size
    radius: int  # of the NCC window [px]
    # number of heights tried, odd; None for the first pass, which tries as many as the bound holds
    hypotheses: int | None
    spacing_px: float  # parallax between two hypotheses [px at this scale]
    neighbours: int  # number of views compared with
    fuse: bool  # after the pass, average each height with those of the views that agree
    # after the pass, how heights beyond its hypotheses are searched; None: not at all
    discontinuities: DiscontinuitySearch | None = None
    # whether only pixels predicted to become points take part: others confirm with the heights that they have
    points_only: bool = False
    # whether only pixels take part whose heights of the pass before lie in the area, not all that see it at some height
    # of the bound
    in_area: bool = False

    @property
    def refines(self) -> bool:
        """Whether the pass only refines: it tries the known height and its two neighbours."""
        return self.hypotheses is not None and self.hypotheses <= REFINING


# Windows shrink as the relief becomes known: 5x5 finds the height, 3x3 about the relief resolves it. docs/sweep.md has
# what other passes give. Windows of the pass before hold heights from 5 px around; images without anything in common
# reach the least scores by chance in one of forty pixels: the better half of the neighbours among forty hypotheses.
PASSES = (
    Pass(0.25, 2, None, 0.5, 8, False),
    Pass(0.5, 2, 11, 0.4, 8, False, DiscontinuitySearch(2, 0.5, 16, 2.0, 5, MATCHED_NCC)),
    Pass(1.0, 2, 7, 0.4, 8, True, DiscontinuitySearch(1, 0.75, 8, 1.6, 3, 0.68, walls=True)),
    Pass(1.0, 2, 5, 0.25, 8, True),
    Pass(1.0, 1, 3, 0.25, 12, True),
)


def before_solver(passes: tuple[Pass, ...]) -> tuple[Pass, ...]:
    """The same passes for heights that the solver solves again: after the first at full size only points take part.

    Without the solver the heights of points are means over views, which all have to be refined.
    """
    first = next(number for number, pass_ in enumerate(passes) if pass_.scale == 1.0)
    return (*passes[: first + 1], *(replace(pass_, points_only=True) for pass_ in passes[first + 1 :]))


def in_area(passes: tuple[Pass, ...]) -> tuple[Pass, ...]:
    """The same passes for a tile: the first looks for its heights, the others follow what the one before found."""
    return (passes[0], *(replace(pass_, in_area=True) for pass_ in passes[1:]))


# Height [m], score and curvature [1/m^2] of each pixel, (height, width) float32.
Found = tuple[np.ndarray, np.ndarray, np.ndarray]
_VECTOR = 16  # Lanes of the widest vectors
SAMPLES_PER_LAUNCH = 8_000_000  # Samples (neighbours x hypotheses x pixels) of one launch: 32 MB an array
_LAUNCH_SAMPLES = 600_000  # A launch of kernels costs as much as so many samples
# Windows are widened until the score of the right height is so many standard deviations above the best that chance
# gives among all hypotheses, in half of the pixels of a view.
_ABOVE_CHANCE = 2.0
# Of photographs with masked or saturated pixels, windows of which such a share is seen by both are compared.
LEAST_KNOWN = 0.5
# Radii [px]: others would need other kernels, and wider windows flatten more relief than they find.
RADII = (1, 2, 3, 4, 6, 8)
# Of the shorter side of an image: beyond it the border without whole windows is a large part of the image.
_MOST_OF_SIDE = 0.25
_WHOLE = 0.9  # Images of which less is known keep their windows: between sun glints wider ones hold less of the bed


def kernels(device: Device) -> ModuleType:
    """The kernels of a device, of which only those needed are imported: `torch_kernels`, or `drjit_kernels`."""
    if device.module is None:
        from fields.sweep.kernels import torch_kernels

        return torch_kernels
    from fields.sweep.kernels import drjit_kernels

    return drjit_kernels


@dataclass(frozen=True)
class Reference:
    """A reference view and how it is matched."""

    stack: ViewStack
    view: int
    neighbours: list[int]  # Views that it is compared with
    radius: int  # [px]: of the NCC window
    least_known: float = 1.0  # Windows of which such a share is not masked count as complete


def match_view(reference: Reference, hypotheses: Hypotheses, columns: np.ndarray | None = None) -> Job[Found]:
    """Best height of each pixel of a view among its hypotheses.

    ``hypotheses``: with a ``start`` of the shape of the image. ``columns`` (height, 2) int, optional: first column, and
    the one after the last, in which each row is wanted; equal ones where none is. The others are as if no window were
    complete. Returns height [m], score [-], curvature [1/m^2] each (height, width) float32: where no window is complete
    (at the image's edge, by masked pixels, out of sight of the neighbours) the score is -1 and the curvature 0. There,
    and where there is no texture, the height is that of the nearest matched pixel.
    """
    stack, view, radius, start = reference.stack, reference.view, reference.radius, hypotheses.start
    width, height = stack.cameras[view].width, stack.cameras[view].height
    per_row = len(reference.neighbours) * hypotheses.count * width
    rows = max(4 * radius + 4, min(height, SAMPLES_PER_LAUNCH // per_row))
    found = [start.flatten(), *(np.full(height * width, value, dtype=np.float32) for value in (-1.0, 0.0))]
    columns = np.tile([0, width], (height, 1)) if columns is None else columns
    wanted = (columns[:, 1] > columns[:, 0]) & (width > 2 * radius)
    wanted[:radius] = wanted[max(height - radius, 0) :] = False
    rows_to_match = np.flatnonzero(wanted)
    for first in range(rows_to_match[0], rows_to_match[-1] + 1, rows) if len(rows_to_match) else ():
        last = min(first + rows, rows_to_match[-1] + 1)
        spans = columns[rows_to_match[(rows_to_match >= first) & (rows_to_match < last)]]
        if not len(spans):
            continue
        begin, end = int(spans[:, 0].min()), int(spans[:, 1].max())
        # With a halo, at least one window wide, and whole vectors where there is room: which rows of a window begin a
        # vector in memory is a part of the kernel, and other widths would need other kernels.
        left = max(begin - radius, 0)
        right = max(min(end + radius, width), left + 2 * radius + 1)
        right = left + _VECTOR * -(-(right - left) // _VECTOR)
        left, right = max(left - max(right - width, 0), 0), min(right, width)
        inner = slice(max(begin, radius), min(end, width - radius))
        strip = np.s_[first - radius : last + radius, left:right]
        grey, heights = stack.images[view][strip], start[strip]
        rays = partial(rays_of_rows, stack, view, first - radius, last - first + 2 * radius)
        if right - left < width:
            rays = partial(rays_of_pixels, stack, view, strip_indices(strip, width))
        results = yield partial(_launch, reference, rays, grey, replace(hypotheses, start=heights), right - left)
        for target, result in zip(found, results, strict=True):
            put_strip(target, width, result, (slice(first, last), inner), strip[1], radius)
    best, score, curvature = (each.reshape(height, width) for each in found)
    return fill_nearest(best, score > MATCHED_NCC), score, curvature


def match_tiles(
    reference: Reference,
    tiles: ImageTiles,
    starts: Callable[[slice, np.ndarray], np.ndarray],
    step: float,
    take: Callable[[np.ndarray, np.ndarray, list[np.ndarray]], None],
) -> Job[None]:
    """Matching of tiles with their halos, a batch of them at a time; otherwise as `match_view`.

    ``starts`` gives the lowest hypotheses [m] of a batch, with the flat indices of its pixels; ``step`` [m] is between
    hypotheses. ``take`` is called with what each batch finds, flat, for those of its pixels around which a whole window
    may lie: which are wanted, in their own tile, and have a whole window (bool), their flat indices, and a list of
    height [m], score and curvature [1/m^2].
    """
    stack, view, side = reference.stack, reference.view, tiles.side
    num = len(reference.neighbours)
    most, launch = SAMPLES_PER_LAUNCH // num, _LAUNCH_SAMPLES // num
    # The first window begins so many pixels into the first tile.
    lost = tiles.radius * (side + 1)
    for part, count in tiles.batches(most, launch):
        pixels = tiles.pixels(part)
        own, flat = tiles.own(part, pixels).ravel(), pixels.ravel()
        rays = partial(rays_of_pixels, stack, view, flat)
        grey, hypotheses = stack.images[view].ravel()[flat], Hypotheses(starts(part, flat), step, count)
        results = yield partial(_launch, reference, rays, grey, hypotheses, side)
        take(own[lost : len(own) - lost], flat[lost : len(flat) - lost], results)


def _launch(reference: Reference, rays: Callable[[], Any], grey: Any, hypotheses: Hypotheses, width: int) -> Launch:
    """Launch the kernels for a strip, or tiles, of a width: grey levels and lowest hypotheses [m] of one shape."""
    stack, radius, neighbours = reference.stack, reference.radius, reference.neighbours
    device, backend = stack.device, kernels(stack.device)
    # Before anything is launched.
    size = math.prod(hypotheses.start.shape) * hypotheses.count
    values, greys = backend.buffers(device, len(neighbours), size), backend.reference_buffer(device, size)
    paths, levels, start = rays(), floats(device, grey), floats(device, hypotheses.start)
    backend.warp(values, stack, paths, hypotheses, neighbours)
    windows = backend.prepare_windows(device, levels, greys, values, width, radius)
    mean = backend.best_half(device, backend.ncc(windows, radius, reference.least_known))
    found = backend.best_height(device, mean, start, hypotheses.step, hypotheses.count)
    return Launch(list(found), (paths, levels, windows, start))


def match_with_adaptive_windows(
    reference: Reference, hypotheses: Hypotheses, columns: Callable[[int], np.ndarray | None] = lambda radius: None
) -> Job[tuple[Found, int]]:
    """`match_view` with windows of the radius of the reference [px] or as wide as needed, and the radius.

    Windows that have nothing in common score with a standard deviation of one over their side; windows that show the
    same place score the share that its texture has of the variance, whatever their size. So noise, and light that
    moves from photograph to photograph, need wider windows, and quiet images do not. ``columns`` gives the wanted
    columns for a radius.
    """
    radius, stack = reference.radius, reference.stack
    found = yield from match_view(reference, hypotheses, columns(radius))
    if np.isfinite(stack.images[reference.view]).mean() < _WHOLE:
        return found, radius
    while (matched := median_above(found[1], -1.0)) is not None:
        if (asked := radius_for(matched, found[1].shape, radius, hypotheses.count)) == radius:
            break
        radius = asked
        found = yield from match_view(replace(reference, radius=radius), hypotheses, columns(radius))
    return found, radius


def radius_for(score: float, shape: tuple[int, int], radius: int, count: int) -> int:
    """Radius [px] of the windows that a median score of windows of a radius asks for; the same if that is enough.

    Among wrong heights the best scores high too, the more the narrower the window: the radius that this gives may not
    be enough yet. ``shape`` (height, width) is that of the image, ``count`` the number of hypotheses.
    """
    side = (_ABOVE_CHANCE + np.sqrt(2.0 * np.log(count))) / max(score, 1e-3)
    fitting = [each for each in RADII if 2 * each + 1 <= _MOST_OF_SIDE * min(shape)] or [radius]
    return max(radius, next((each for each in fitting if each >= round(0.5 * (side - 1.0))), fitting[-1]))
