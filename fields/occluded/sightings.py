"""Sightings of the layer about holes: its colours in photographs at several heights, and those that agree on them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np

from fields.occluded.holes import Holes
from fields.sweep.block import Block
from fields.sweep.maps import HeightMap, trusted
from refract import FlatWater

_RIM_PX = 1.5  # Pixels at the border of a photograph that are not used
_LEAST_SHARE = 0.05  # Least share of the cells that a photograph shows
_REACH_GSD = 4.0  # How far over and under the layer colours are asked for, in ground sampling distances
# Heights over the layer, in ground sampling distances: what stands on it, and what is the layer itself.
_ABOVE_GSD, _ON_GSD = 7.0, 3.0
# A height that so many other photographs and this correlation confirm is not an error of the windows beside an edge.
_CONFIRMED_BY, _CONFIRMED_NCC = 3, 0.8
# Other edges are located to so many cells: by the windows of the sweep. What stands over the layer hides it for sure
# so far inside its edge, and shows it for sure so far outside.
_HIDDEN_CELLS, _SHOWN_CELLS = 6, 3
_STRAY_CELLS = 2  # What is narrower than this on both sides of its middle are strays of the height map
WINDOW = 3  # Cells about one whose colours are compared together: a window of 3
# Largest misfit of two photographs that agree, the mean square of their difference in variances of the noise: beyond it
# their agreement is zero. One cell counts at most so much.
PAIR_MISFIT, MISFIT_CLIP = 1.2, 30.0


@dataclass(frozen=True)
class Sighting:
    """Sighting of holes in a photograph; arrays (rows, columns, ...) of their cells."""

    view: int
    rgb: np.ndarray  # (height, width, 3) uint8: the part of the photograph that shows them
    # start, change (rows, columns, 2) float32: pixel in that part where the layer is seen, and how it moves with the
    # height [1/m]
    start: np.ndarray
    change: np.ndarray
    is_inside: np.ndarray  # (rows, columns) bool
    # is_hidden, is_shown (rows, columns) bool: where the height map says for sure that the layer is hidden, or seen
    is_hidden: np.ndarray
    is_shown: np.ndarray
    near_obstacle: np.ndarray  # (rows, columns) bool: where something that stands over the layer is near
    incidence: float  # [rad]: of the ray in air, in the middle
    slope: np.ndarray  # (2,): how far the ray in the middle moves over the ground with the height [m/m]

    def part(self, cells: tuple[slice, slice]) -> Sighting:
        """The same photograph of some rows and columns of the cells."""
        names = ("start", "change", "is_inside", "is_hidden", "is_shown", "near_obstacle")
        return replace(self, **{name: getattr(self, name)[cells] for name in names})

    def colours(self, height: np.ndarray | float) -> np.ndarray:
        """Stored values (rows, columns, 3) float32 at heights (rows, columns) [m] over the layer; any outside."""
        at = self.start + np.asarray(height, dtype=np.float32)[..., None] * self.change
        return cv2.remap(self.rgb, at[..., 0], at[..., 1], cv2.INTER_LINEAR).astype(np.float32)


def sighting_of(
    block: Block, height_map: HeightMap, rgb: np.ndarray, known: np.ndarray, holes: Holes
) -> Sighting | None:
    """Sighting of holes and the layer about them in a photograph; None where too little of them is seen.

    ``height_map``: of the photograph. ``rgb``, ``known`` (height, width, 3) uint8, (height, width) bool: the
    photograph, and its pixels that are not masked.
    """
    camera, water, reach = block.cameras[height_map.view], block.water, _REACH_GSD * holes.gsd
    points = holes.points.reshape(-1, 3)
    up = np.array([0.0, 0.0, reach])
    low, high = (camera.project(each, water) for each in (points - up, points + up))
    middle = 0.5 * (low + high)
    size = np.array([camera.width, camera.height])
    # Comparisons with what is not known are false: the layer has no height far from the bed.
    inside = np.all([((each > _RIM_PX) & (each < size - _RIM_PX)).all(axis=-1) for each in (low, high)], axis=0)
    if inside.mean() < _LEAST_SHARE:
        return None
    shape = holes.shape
    pixel = np.where(inside[:, None], middle, 0.0)
    column, row = np.floor(pixel).astype(np.int64).T
    reached = np.stack([low[inside], high[inside]])
    x0, y0 = np.maximum(np.floor(reached.min(axis=(0, 1))).astype(int) - 2, 0)
    x1, y1 = np.ceil(reached.max(axis=(0, 1))).astype(int) + 3
    layer = _height(points, water)
    over = np.where(inside, height_map.height[row, column] - layer, 0.0)
    is_hidden, is_shown, near_obstacle = _visibility(height_map, holes, (row, column), inside, over)
    is_inside = (inside & known[row, column]).reshape(shape)
    path = camera.paths(np.mean(middle[inside], axis=0)[None], water)
    at = float(np.median(layer[inside]))
    below, above = (path.at_height(np.array([height]), water)[0] for height in (at - reach, at + reach))
    normal = np.array(water.up if water else (0.0, 0.0, 1.0))
    return Sighting(
        height_map.view,
        rgb[y0:y1, x0:x1],
        (pixel - (x0 + 0.5, y0 + 0.5)).reshape(*shape, 2).astype(np.float32),
        (np.where(inside[:, None], high - low, 0.0) / (2.0 * reach)).reshape(*shape, 2).astype(np.float32),
        is_inside,
        is_hidden & is_inside,
        is_shown,
        near_obstacle & is_inside,
        float(np.arccos(np.clip(-(path.air_direction[0] @ normal), -1.0, 1.0))),
        (above - below)[:2] / (above - below)[2],
    )


def _visibility(
    height_map: HeightMap, holes: Holes, at: tuple[np.ndarray, np.ndarray], inside: np.ndarray, over: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`Sighting.is_hidden`, `is_shown` and `near_obstacle`, by the height map of the photograph.

    ``at``: two of (N,) int, row and column of each cell in the height map. ``inside``, ``over`` (N,) bool, (N,) [m]:
    cells in the photograph, and the height of the map over the layer there.
    """
    shape, gsd = holes.shape, holes.gsd
    raised = (inside & (over > _ABOVE_GSD * gsd)).reshape(shape).astype(np.uint8)
    standing = cv2.morphologyEx(raised, cv2.MORPH_OPEN, _disc(_STRAY_CELLS))
    near_obstacle = cv2.dilate(standing, _disc(_SHOWN_CELLS)) > 0
    is_trusted = trusted(height_map)[at] & inside
    on_layer = (is_trusted & (np.abs(over) < _ON_GSD * gsd)).reshape(shape)
    confirmed = (height_map.agreeing[at] >= _CONFIRMED_BY) & (height_map.score[at] > _CONFIRMED_NCC)
    covered = (inside & confirmed & (over > _ON_GSD * gsd)).reshape(shape)
    is_hidden = covered | (cv2.erode(standing, _disc(_HIDDEN_CELLS)) > 0)
    return is_hidden, on_layer & ~near_obstacle, near_obstacle


def _height(points: np.ndarray, water: FlatWater | None) -> np.ndarray:
    """Heights (N,) [m] of points over the water plane, or over local z = 0."""
    return points[:, 2] if water is None else (points - np.array(water.point)) @ np.array(water.up)


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


@dataclass(frozen=True)
class Colours:
    """Colours of K photographs on the cells (rows, columns) of a surface."""

    # (K, rows, columns, 3) float32: stored values 0 to 255, corrected for gain and offset of each photograph
    values: np.ndarray
    use: np.ndarray  # (K, rows, columns) bool: where the photograph may show the surface
    noise: np.ndarray  # (3,): standard deviation of one photograph


def consensus(colours: Colours) -> np.ndarray:
    """The largest set of photographs that agree with one of them, for each cell: (K, rows, columns) bool."""
    num, shape = len(colours.values), colours.use.shape[1:]
    weight = np.zeros((num, *shape), dtype=np.float32)
    agree = np.zeros((num, num, *shape), dtype=bool)
    scaled = colours.values / (np.sqrt(6.0) * colours.noise).astype(np.float32)
    for a, b in combinations(range(num), 2):
        both = colours.use[a] & colours.use[b]
        if not both.any():
            continue
        difference = scaled[a] - scaled[b]
        square = cv2.transform(difference * difference, np.ones((1, 3), np.float32))
        misfit = windowed(np.minimum(square, MISFIT_CLIP), both)
        kernel = np.where(both, np.exp(-0.5 * (misfit / PAIR_MISFIT) ** 2), np.float32(0.0))
        weight[a] += kernel
        weight[b] += kernel
        agree[a, b] = agree[b, a] = both & (misfit < PAIR_MISFIT)
    best = weight.argmax(axis=0)
    members = np.take_along_axis(agree, best[None, None], axis=0)[0]
    np.put_along_axis(members, best[None], True, axis=0)
    return members & colours.use


def windowed(values: np.ndarray, mask: np.ndarray, side: int = WINDOW) -> np.ndarray:
    """Means of values (rows, columns) over the cells of a mask in the window about each."""
    share = mask.astype(np.float32)
    total, count = (cv2.blur(each, (side, side), borderType=cv2.BORDER_CONSTANT) for each in (values * share, share))
    return total / np.maximum(count, np.float32(1e-6))
