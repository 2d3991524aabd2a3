"""Visibility and projection of the points of a tile in the photographs, and the derivatives by their heights."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np

from fields.device import Device
from fields.image_store import GreyImages
from fields.solver.tile import Brightness, SolverTile
from fields.sweep.kernels.arrays import constant, evaluate, floats, host
from fields.sweep.kernels.rays import point_at, project, refracted_rays
from fields.sweep.kernels.stack import CameraTerms, camera_table, kernel_water
from fields.waves.waves import Waves, interpolated
from refract import FlatWater, PinholeCamera

_STEP_PX = 1.0  # The step of the differences across the image [px]: positions in float32 are good to 3e-4 px
_RIM_PX = 2.5  # Pixels about a position that a cubic lookup needs
# How far from the border a position has to be so that no pixel beyond it counts.
_RIMS = {cv2.INTER_LINEAR: 0.5, cv2.INTER_CUBIC: 1.5}
_STEPS = 2  # Of the search for the crossing; docs/optics.md


class Occluder(NamedTuple):
    height: np.ndarray  # (height, width) float32 [m] over the water plane
    agreeing_once: np.ndarray  # (height, width) bool: at least one other view agrees


@dataclass(frozen=True)
class Ground:
    """Points of N pixels at their start heights, in the frame of the water."""

    points: np.ndarray  # (3, N) [m]
    per_pixel: np.ndarray  # (2, 2, N) [m/px]: change of x and y (first axis) along columns and rows of the image

    def __getitem__(self, index) -> Ground:
        return Ground(self.points[:, index], self.per_pixel[:, :, index])

    @staticmethod
    def of(points: np.ndarray) -> Ground:
        """Of the points (3, 4, N) of pixels, of these raised, and of those one step to the right and down."""
        steps = points[:2, 2:] - points[:2, :1]
        return Ground(points[:, 0], steps / np.float32(_STEP_PX))

    @property
    def pixel(self) -> np.ndarray:
        """Side of a pixel (N,) [m]."""
        (a, b), (c, d) = self.per_pixel
        return np.sqrt(np.abs(a * d - b * c))

    def in_pixels(self, displacement: np.ndarray) -> np.ndarray:
        """Displacements (2, N) [m] along the plane in pixels of the image."""
        return _solve_2x2(self.per_pixel[:, 0], self.per_pixel[:, 1], displacement)


# Nodes of the displacements by waves over an image [px], whose shortest are eight times as long, and those beyond it.
_NODE_PX, _NODE_RIM = 4, 2
_STRIP = 1_000_000  # Numbers at nodes that are found at a time


@dataclass(frozen=True)
class TileProjection:
    """Projection of a tile into K photographs, that of the tile first; N pixels, float32."""

    views: list[int]
    position: np.ndarray  # (K, 2, N) [px]: where each photograph shows the point at the start height
    rise: np.ndarray  # (K, 2, N) [px/m]: change of the position with the height over the water plane
    # (K, 2, N) [px/m]: the same in pixels of the tile's own image: how far its texture seems to shift
    motion: np.ndarray
    seen: np.ndarray  # (K, N) bool: inside the photograph, and not behind what its own height map shows
    ground: Ground

    @cached_property
    def _places(self) -> list[np.ndarray]:
        """Indices of the visible pixels of each photograph: ten times as fast as a mask."""
        return [np.flatnonzero(row) for row in self.seen]

    def sample(self, images: GreyImages | Mapping[int, np.ndarray], change: np.ndarray) -> np.ndarray:
        """Grey values (K, N) at start height plus change (N,) [m]; NaN where not seen."""
        values = np.full(self.seen.shape, np.nan, dtype=np.float32)
        window = images.window if isinstance(images, GreyImages) else lambda view, *part: images[view][part]
        for value, view, at, rise, index in zip(
            values, self.views, self.position, self.rise, self._places, strict=True
        ):
            if len(index):
                x, y = at.take(index, axis=1) + rise.take(index, axis=1) * change.take(index)
                rows, columns = lookup_window(x, y)
                value[index] = lookup(window(view, rows, columns), x - columns.start, y - rows.start, cv2.INTER_CUBIC)
        return values


def lookup_window(x: np.ndarray, y: np.ndarray) -> tuple[slice, slice]:
    """Window of an image (rows, columns) that lookups at positions (N,) [px] need: photographs are read in parts.

    It begins at whole pixels, so that a lookup gives the same number to the last bit.
    """
    rows, columns = (
        slice(max(int(np.floor(low - _RIM_PX)), 0), max(int(np.ceil(high + _RIM_PX)), 0) + 1)
        for low, high in ((np.fmin.reduce(each), np.fmax.reduce(each)) for each in (y, x))
    )
    return rows, columns


def lookup(image: np.ndarray, x: np.ndarray, y: np.ndarray, interpolation: int) -> np.ndarray:
    """Values (N,) of an image at positions (N,) [px], by a flag of OpenCV; NaN outside."""
    # Not NaN as the value of the border: OpenCV 5 gives it to eight positions in a row if one of them is outside.
    values = interpolated(image, np.stack([x, y]) - 0.5, interpolation)
    rim = _RIMS[interpolation]
    inside = (x >= rim) & (x <= image.shape[1] - rim) & (y >= rim) & (y <= image.shape[0] - rim)
    return np.where(inside, values, np.float32(np.nan))


def project_tiles(
    tiles: Sequence[SolverTile],
    views: Sequence[int],
    occluder: Callable[[int], Any],
    projector: Projector,
    tolerance: float,
    by_waves: Callable[[int], DisplacementImage] | None = None,
) -> list[TileProjection]:
    """Projections of tiles of the first of ``views`` into its photograph and those of others that show a tenth or more.

    Small tiles are carried into the other photographs together: a kernel takes as long to start as for 10,000 pixels.
    A point is hidden where the height map of the other photograph, confirmed by a third, is higher by more than
    ``tolerance`` [m]; ``occluder`` gives the `Occluder` of a view, or None, ``by_waves`` how far waves displace
    what it shows.
    """
    view, *others = views
    pixels = np.concatenate([tile.pixels for tile in tiles])
    start = np.concatenate([tile.of(occluder(view).height) for tile in tiles])
    counts, total = [len(tile) for tile in tiles], len(pixels)
    firsts = np.cumsum([0, *counts[:-1]])
    parts = [slice(first, first + count) for first, count in zip(firsts, counts, strict=True)]
    # Each point, raised, and those of positions beside it at its height.
    positions = [pixels, pixels, *(pixels + step for step in _STEP_PX * np.eye(2))]
    heights = np.concatenate([start, start + np.float32(tolerance), start, start])
    points = projector.points(view, np.concatenate(positions), heights)
    own = np.ascontiguousarray(pixels.T, dtype=np.float32)
    unmoved, everywhere = np.zeros_like(own), np.ones(total, dtype=bool)
    ground = Ground.of(np.stack([host(projector.device, each) for each in points]).reshape(3, 4, total))
    if by_waves is not None:
        own = own + ground.in_pixels(by_waves(view).at(own, start))
    found = [[(view, own[:, part], unmoved[:, part], unmoved[:, part], everywhere[part])] for part in parts]
    for other in others:
        all_at, all_inside = projector.seen(other, points)
        at, raised, right, down = all_at.reshape(2, 4, total).swapaxes(0, 1)
        width, height = projector.size(other)
        size = np.array([[width], [height]]) - np.float32(_RIM_PX)
        inside = all_inside[:total] & ((at > _RIM_PX) & (at < size)).all(axis=0)
        shows = np.add.reduceat(inside, firsts, dtype=np.int64) >= 0.1 * np.array(counts)
        if not shows.any():
            continue
        inside &= np.repeat(shows, counts)
        index = np.flatnonzero(inside)
        change = (raised - at) / np.float32(tolerance)
        shift = _solve_2x2(right - at, down - at, change) * np.float32(_STEP_PX)
        if (of_other := occluder(other)) is not None:
            inside[index] = ~_is_occluded(of_other, at.take(index, axis=1), start[index] + np.float32(tolerance))
        if by_waves is not None:
            aside, beside = np.zeros_like(at), by_waves(other).at(at.take(index, axis=1), start[index])
            aside[:, index] = ground[index].in_pixels(beside) / np.float32(_STEP_PX)
            at = at + (right - at) * aside[0] + (down - at) * aside[1]
        inside &= np.isfinite(shift).all(axis=0)
        for number in np.flatnonzero(shows):
            part = parts[number]
            found[number].append((other, at[:, part], change[:, part], shift[:, part], inside[part]))
    return [_stacked(each, ground[part]) for each, part in zip(found, parts, strict=True)]


def _stacked(
    photographs: list[tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]], ground: Ground
) -> TileProjection:
    views, *arrays = zip(*photographs, strict=True)
    position, rise, motion, seen = (np.stack(each) for each in arrays)
    return TileProjection(list(views), position, rise, motion, seen, ground)


def _solve_2x2(right: np.ndarray, down: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Solutions (2, N) of 2x2 systems with columns ``right`` and ``down``; NaN where they are singular."""
    size = right[0] * down[1] - right[1] * down[0]
    size[size == 0.0] = np.nan
    return np.stack([down[1] * change[0] - down[0] * change[1], right[0] * change[1] - right[1] * change[0]]) / size


def _is_occluded(occluder: Occluder, at: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Occlusion mask (N,): at positions (2, N) [px] an occluder is above heights (N,) [m], and another view agrees."""
    x, y = at
    rows, columns = lookup_window(x, y)
    x, y = x - columns.start, y - rows.start
    occluder_height = lookup(occluder.height[rows, columns], x, y, cv2.INTER_LINEAR)
    agreeing = lookup(occluder.agreeing_once[rows, columns].astype(np.float32), x, y, cv2.INTER_LINEAR)
    return (occluder_height > height) & (agreeing > 0.5)


@dataclass(frozen=True)
class DisplacementImage:
    """Displacements by waves over the image of a photograph: exact at nodes and two depths, smooth between them."""

    nodes: np.ndarray  # (rows, columns, 4) float32: displacement (2) [m] at `depth` and its change (2) with the depth
    depth: np.float32  # [m]
    level: np.float32  # [m]: of the water over its plane

    @staticmethod
    def of(view: int, projector: Projector, waves: Waves) -> DisplacementImage:
        """Of a photograph over the surface that was found for it."""
        columns, rows = (-(-size // _NODE_PX) + 2 * _NODE_RIM for size in projector.size(view))
        level, depths = waves.tides[view], waves.deep * np.array([0.5, 1.0])
        nodes = np.empty((rows, columns, 4), dtype=np.float32)
        # In strips: points take forty times the memory of their nodes.
        for strip in np.array_split(np.arange(rows), -(-nodes.size // _STRIP)):
            down, across = np.meshgrid(strip, np.arange(columns), indexing="ij")
            pixels = (np.stack([across.ravel(), down.ravel()], axis=-1) - _NODE_RIM) * float(_NODE_PX)
            heights = np.repeat((level - depths).astype(np.float32), len(pixels))
            found = projector.points(view, np.tile(pixels, (2, 1)), heights)
            points = np.stack([host(projector.device, each) for each in found])
            # Nodes beyond the image may have no ray that reaches the bed.
            moved = np.nan_to_num(waves.displacement(view, points), posinf=0.0, neginf=0.0)
            less, more = moved.reshape(2, 2, *down.shape).swapaxes(0, 1)
            nodes[strip] = np.dstack([*less, *(more - less) / (depths[1] - depths[0])])
        return DisplacementImage(nodes, np.float32(depths[0]), np.float32(level))

    def at(self, position: np.ndarray, height: np.ndarray) -> np.ndarray:
        """Displacements (2, N) [m] of points that still water shows at positions (2, N) [px], at heights (N,) [m]."""
        node = position / np.float32(_NODE_PX) + np.float32(_NODE_RIM)
        moved, by_depth = interpolated(self.nodes, node, cv2.INTER_CUBIC).T.reshape(2, 2, -1)
        depth = self.level - height
        return np.where(depth > 0.0, moved + by_depth * (depth - self.depth), np.float32(0.0))


class Projector:
    """Projection of points through the water into photographs, on the device of the sweep.

    Dr.Jit is not meant for several threads: only one may use it, the one that made it. ``cameras``: by number.
    """

    def __init__(self, device: Device, cameras: Mapping[int, PinholeCamera], water: FlatWater | None):
        self.device, self._cameras = device, cameras
        self._water = kernel_water(water)
        self._beyond = CameraTerms.of(list(cameras.values()))
        table = camera_table(list(cameras.values()), self._beyond, self._water)
        self._table, self._n_water = table, 1.0 if water is None else float(water.n_water)
        self._rows = {view: [constant(device, c) for c in row] for view, row in zip(cameras, table, strict=True)}

    @property
    def optics(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Camera centres (V, 3) [m] over their own water, its level (V,) [m] over the plane, and the index of water."""
        tides = [camera.tide * self._water.from_local[2, 2] for camera in self._cameras.values()]
        return self._table[:, 9:12], np.array(tides), self._n_water

    def size(self, view: int) -> tuple[int, int]:
        """Width and height of a photograph [px]."""
        camera = self._cameras[view]
        return camera.width, camera.height

    def points(self, view: int, pixels: np.ndarray, heights: np.ndarray) -> tuple[Any, ...]:
        """Points of pixels (P, 2) [px] of a photograph at heights (P,) [m], for `seen`."""
        beyond = CameraTerms.of([self._cameras[view]])
        camera = [constant(self.device, c) for c in camera_table([self._cameras[view]], beyond, self._water)[0]]
        u, v, z = (floats(self.device, each) for each in (pixels[:, 0], pixels[:, 1], heights))
        points = point_at(refracted_rays(camera, u, v, self._water, beyond), z)
        evaluate(*points)
        return points

    def seen(self, view: int, points: tuple[Any, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Positions of points in a photograph, (2, P) float32 [px], and whether inside it, (P,) bool."""
        u, v, inside = project(self._rows[view], points, self._water, self._beyond, _STEPS)
        evaluate(u, v, inside)
        return np.stack([host(self.device, u), host(self.device, v)]), host(self.device, inside)


def visibility_counts(views: Sequence[int], brightness: Brightness, photographs: int) -> np.ndarray:
    """Pixels of a tile that each photograph of a survey shows, and outliers among them, (2, photographs) int64.

    Outliers are residuals that lost most of their weight: glint, shadows, what moved.
    """
    counts, chosen = np.zeros((2, photographs), dtype=np.int64), list(views)
    counts[0, chosen] = np.count_nonzero(brightness.weight > 0.0, axis=1)
    counts[1, chosen] = np.count_nonzero(brightness.outlying, axis=1)
    return counts
