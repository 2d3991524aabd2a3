"""Where the photographs see the points of a tile, and how that changes with their heights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from fields.solver.tile import Tile
from fields.sweep.sweep import DepthMap
from refract import FlatWater, PinholeCamera

# The step of the differences across the image [px].
_STEP_PX = 0.5
# Pixels about a position that a cubic lookup needs.
_RIM_PX = 2.5
# Of the search for the crossing; docs/optics.md.
_STEPS = 2
_LINE = 2048


@dataclass(frozen=True)
class Sight:
    """A tile in K photographs, the one of the tile first; N pixels, float32.

    Attributes
    ----------
    views : list of int
    position : (K, 2, N) [px]
        Where each photograph shows the point at the start height.
    rise : (K, 2, N) [px/m]
        Change of the position with the height over the water plane.
    motion : (K, 2, N) [px/m]
        The same in pixels of the tile's own image: how far its texture seems to shift.
    seen : (K, N) bool
        Inside the photograph, and not behind what its own height map shows.
    """

    views: list[int]
    position: np.ndarray
    rise: np.ndarray
    motion: np.ndarray
    seen: np.ndarray

    def sample(self, images: Mapping[int, np.ndarray], change: np.ndarray) -> np.ndarray:
        """Grey values (K, N) at start height plus change (N,) [m]; NaN where not seen."""
        values = np.empty(self.seen.shape, dtype=np.float32)
        for value, view, at, rise in zip(values, self.views, self.position, self.rise, strict=True):
            x, y = at + rise * change
            value[:] = lookup(images[view], x, y, cv2.INTER_CUBIC)
        values[~self.seen] = np.nan
        return values


def lookup(image: np.ndarray, x: np.ndarray, y: np.ndarray, way: int) -> np.ndarray:
    """Values (N,) of an image at positions (N,) [px], interpolated as OpenCV's flag ``way`` says; NaN outside."""
    lines = -(-len(x) // _LINE)
    at = np.full((2, lines * _LINE), -9.0, dtype=np.float32)
    at[0, : len(x)], at[1, : len(x)] = x - 0.5, y - 0.5
    across, down = at.reshape(2, lines, _LINE)
    values = cv2.remap(image, across, down, way, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    return values.ravel()[: len(x)]


def sight_of(
    tile: Tile,
    view: int,
    others: list[int],
    cameras: Mapping[int, PinholeCamera],
    maps: dict[int, DepthMap],
    water: FlatWater | None,
    tolerance: float,
) -> Sight:
    """A tile of `view` in its own photograph and in those of ``others`` that show at least a tenth of it.

    A point is hidden where the height map of the other photograph, confirmed by a third, is higher by more than
    ``tolerance`` [m].
    """
    camera, pixels = cameras[view], tile.pixels
    start = tile.of(maps[view].height).astype(np.float64)
    path = camera.paths(pixels, water)
    points, raised = path.at_height(start, water), path.at_height(start + tolerance, water)
    beside = [camera.paths(pixels + step, water).at_height(start, water) for step in _STEP_PX * np.eye(2)]
    kept = [view]
    own = np.ascontiguousarray(pixels.T, dtype=np.float32)
    position, rise, motion, seen = [own], [np.zeros_like(own)], [np.zeros_like(own)], [np.ones(len(tile), dtype=bool)]
    for other in others:
        seen_by = cameras[other]
        at = seen_by.project(points, water, steps=_STEPS)
        inside = (at > _RIM_PX).all(axis=1) & (at < (seen_by.width - _RIM_PX, seen_by.height - _RIM_PX)).all(axis=1)
        if inside.mean() < 0.1:
            continue
        if other in maps:
            inside &= ~_hidden(maps[other], at, start + tolerance)
        change = (seen_by.project(raised, water, steps=_STEPS) - at) / tolerance
        right, down = ((seen_by.project(p, water, steps=_STEPS) - at) / _STEP_PX for p in beside)
        size = right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0]
        back = np.stack([down[:, 1], -down[:, 0], -right[:, 1], right[:, 0]]) / np.where(size == 0.0, np.nan, size)
        shift = np.stack(
            [back[0] * change[:, 0] + back[1] * change[:, 1], back[2] * change[:, 0] + back[3] * change[:, 1]]
        )
        kept.append(other)
        position.append(at.T)
        rise.append(change.T)
        motion.append(shift)
        seen.append(inside & np.isfinite(shift).all(axis=0))
    at_start, rises, motions = (np.asarray(part, dtype=np.float32) for part in (position, rise, motion))
    return Sight(kept, at_start, rises, motions, np.asarray(seen))


def _hidden(depth_map: DepthMap, at: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Where a height map at positions (N, 2) [px] is above heights (N,) [m] and confirmed."""
    x, y = at.T
    there = lookup(depth_map.height, x, y, cv2.INTER_LINEAR)
    confirmed = lookup((depth_map.agreeing > 0).astype(np.float32), x, y, cv2.INTER_LINEAR)
    return (there > height) & (confirmed > 0.5)
