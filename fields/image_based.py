"""Image-based rendering: photographs warped along refracted rays by their height maps, and blended.

The surface that a camera sees comes from a z-buffer into which points of the height maps of nearby photographs are
splatted; the height of a pixel is then averaged over the maps that agree with it. Its colour is the mean of what the
photographs that see it show there, weighted as in the unstructured lumigraph (Buehler et al. 2001): the smaller the
angle between the two rays, the more, and less towards the border of a photograph. From a photograph without a height
map what the target sees hides what lies behind.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from refract import FlatWater, PinholeCamera
from refract.paths import BentPaths

# Photographs that a place of the target is blended of, and height maps that its height is the mean of: what a tile
# needs at once.
SOURCES, MAPS = 12, 8
_CELLS = 8  # Places of the target with their own choice of photographs, along each side
_COARSE = 2  # What the target sees hides from a photograph without a map what lies behind, in pixels of this size [px]
# At this angle [rad] between the rays a photograph has a quarter of its weight; it fades at its border [px].
_ANGLE, _BORDER_PX = 0.3, 24.0

# Colours (N, 3), 0 to 255, without the water, of those that a photograph shows, the depths (N,) [m] and the incidence
# (N,) [rad] of its rays in air.
WithoutWater = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
_STRIDE = 2  # Of the pixels of a map along each side one in so many is splatted: several maps overlap
_GAP_PX = 8  # Gaps of the surface up to this wide take the height of the nearest pixel [px]


@dataclass(frozen=True)
class NovelView:
    """A rendered view; NaN where the camera sees no bed, and black where it sees nothing."""

    rgb: np.ndarray  # (height, width, 3) uint8: as a photograph stores it
    # (height, width) float32 [m]: over the water plane (over local z = 0 without water), negative below it
    bed_height: np.ndarray
    # (height, width) float32 [m]: from the camera to the bed along the path, air and water legs together
    distance: np.ndarray
    normal: np.ndarray  # (height, width, 3) float32 unit, local: of the bed, up
    has_background: bool = False  # Whether pixels that show no bed have the colour of what lies behind it

    @property
    def seen(self) -> np.ndarray:
        """(height, width) bool: pixels that show the bed."""
        return np.isfinite(self.bed_height)

    @property
    def coloured(self) -> np.ndarray:
        """(height, width) bool: pixels that have a colour."""
        return self.seen | self.has_background


@dataclass(frozen=True)
class Source:
    """A photograph, with its height map if it has one."""

    camera: PinholeCamera
    rgb: np.ndarray  # (height, width, 3) uint8
    mask: np.ndarray | None  # (height, width) bool or None: pixels that may be used; None for all
    scale: float  # [-]: pixels of the height map per pixel of the photograph
    # (rows, columns) float32 [m] or None: over the water plane, of the path of each pixel; NaN where not confirmed
    heights: np.ndarray | None

    @property
    def num_bytes(self) -> int:
        return sum(each.nbytes for each in (self.rgb, self.mask, self.heights) if each is not None)

    def observe(self, points: np.ndarray, water: FlatWater | None) -> Observation:
        """Observation of points (N, 3) [m], local, by the photograph."""
        uv = self.camera.project(points, water).astype(np.float32)
        inside = self.camera.sees(uv)
        uv[~inside] = -2.0
        height = np.full(len(points), np.nan, dtype=np.float32)
        if self.heights is not None:
            height[inside] = _sampled(self.heights, uv[inside] * np.float32(self.scale), cv2.INTER_LINEAR)
        if self.mask is not None:
            inside &= _sampled(self.mask.astype(np.uint8), uv, cv2.INTER_NEAREST) > 0
        return Observation(uv, inside, height)

    def colours(self, uv: np.ndarray) -> np.ndarray:
        """Colours (N, 3) float32, 0 to 255, at places (N, 2) [px]."""
        return _sampled(self.rgb, uv, cv2.INTER_CUBIC).astype(np.float32)


class Observation(NamedTuple):
    """Observation of N points by a photograph."""

    uv: np.ndarray  # (N, 2) float32 [px]
    inside: np.ndarray  # (N,) bool: whether it may be used there
    height: np.ndarray  # (N,) float32 [m]: of its own map there; NaN where that has none

    def agrees(self, height: np.ndarray, tolerance: float) -> np.ndarray:
        """Whether (N,) its map has the heights (N,) [m] of the points."""
        return np.abs(self.height - height) < tolerance


@dataclass(frozen=True)
class ImageBasedField:
    """Image-based field: photographs, of which some have height maps, rendered for other cameras."""

    cameras: Sequence[PinholeCamera]  # Of the photographs
    water: FlatWater | None
    load: Callable[[int], Source]  # callable: the photograph of a number, as a `Source`
    mapped: frozenset[int]  # numbers of the photographs that have a height map
    height: float  # [m]: of the bed over the water plane, about
    tolerance: float  # [m]: heights that differ by less are of the same surface
    gains: np.ndarray  # (V, 3): factors that bring the colours of the photographs to a common exposure

    def sources_of(self, camera: PinholeCamera, *, dry: bool = False) -> list[int]:
        """Numbers of the photographs that show what a camera sees of a level bed: the nearest of each place of it."""
        return self._around(camera, self._optics(dry), range(len(self.cameras)), SOURCES)

    def _around(
        self, camera: PinholeCamera, optics: FlatWater | None, candidates: Iterable[int], most: int
    ) -> list[int]:
        u, v = (np.linspace(0.5, size - 0.5, _CELLS) for size in (camera.width, camera.height))
        pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        points = camera.paths(pixels, optics).at_height(np.full(len(pixels), self.height), optics)
        points = points[np.isfinite(points).all(axis=1)]
        chosen = self._nearest(points, camera.centre, candidates, most)
        return sorted({number for numbers in chosen for number in numbers})

    def render(
        self, camera: PinholeCamera, *, dry: bool = False, without_water: WithoutWater | None = None
    ) -> NovelView:
        """View of a camera: `dry`, by straight rays; `without_water` takes the water out of the colours."""
        optics, numbers = self._optics(dry), self.sources_of(camera, dry=dry)
        maps = self._around(camera, optics, sorted(self.mapped), MAPS)
        shape = (camera.height, camera.width)
        loaded = (self.load(number) for number in maps)
        splats = (Splats.of(e.camera.scaled(e.scale), e.heights, self.water) for e in loaded if e.heights is not None)
        surface = front_surface(camera, optics, splats, self.tolerance)
        rgb = np.zeros((*shape, 3), dtype=np.uint8)
        bed, distance = (np.full(shape, np.nan, dtype=np.float32) for _ in range(2))
        place = np.full((*shape, 3), np.nan)
        tiles = _tiles(surface)
        middle = np.array([(row[len(row) // 2], column[len(row) // 2]) for row, column in tiles], dtype=np.int64)
        row, column = middle.reshape(-1, 2).T
        points = camera.paths(_centres(row, column), optics).at_height(surface[row, column].astype(np.float64), optics)
        nearest = self._nearest(points, camera.centre, numbers, SOURCES)
        nearest_maps = self._nearest(points, camera.centre, maps, MAPS)
        # Of the photographs without a map, heights [m] of the surface of the target in coarse pixels stand for one.
        target, without_map = (
            Splats.of(camera, surface, optics),
            {n for chosen in nearest for n in chosen} - self.mapped,
        )
        coarse = {
            number: front_surface(self.cameras[number].scaled(1.0 / _COARSE), self.water, [target], self.tolerance)
            for number in without_map
        }
        for at, chosen, around in zip(tiles, nearest, nearest_maps, strict=True):
            path = camera.paths(_centres(*at), optics)
            height = self._averaged(path, optics, surface[at].astype(np.float64), around)
            points = path.at_height(height, optics)
            # No longer than a tile needs them: all of a target may not fit into memory.
            sources = {number: self.load(number) for number in chosen}
            for number in without_map.intersection(chosen):
                sources[number] = replace(sources[number], scale=1.0 / _COARSE, heights=coarse[number])
            colour, known = self._blended(path, points, height, sources, without_water)
            del sources  # Not beside those of the next tile
            at = at[0][known], at[1][known]
            rgb[at] = np.clip(np.round(colour[known]), 0, 255)
            bed[at], place[at] = height[known], points[known]
            straight = np.linalg.norm(points - path.origin, axis=1)
            bent = path.air_length + np.linalg.norm(points - path.crossing, axis=1)
            distance[at] = np.where(path.wet & (straight > path.air_length), bent, straight)[known]
        return NovelView(rgb, bed, distance, normals_of(place))

    def _optics(self, dry: bool) -> FlatWater | None:
        """The water that a camera looks through: an index of one keeps the plane that heights count from."""
        return replace(self.water, n_water=1.0) if dry and self.water is not None else self.water

    def _nearest(self, points: np.ndarray, centre: np.ndarray, candidates: Iterable[int], most: int) -> list[list[int]]:
        """The photographs, so many, that see each of N points (N, 3) under the smallest angle to a place."""
        own, candidates = _directions(points, centre), np.array(list(candidates), dtype=np.int64)
        angles = np.full((len(candidates), len(points)), np.inf)
        for row, number in enumerate(candidates):
            camera = self.cameras[number]
            seen = camera.sees(camera.project(points, self.water))
            angles[row, seen] = _angle(own, _directions(points, camera.centre))[seen]
        order = np.argsort(angles, axis=0, kind="stable")[:most]
        known = np.isfinite(np.take_along_axis(angles, order, axis=0))
        return [candidates[order[known[:, n], n]].tolist() for n in range(len(points))]

    def _averaged(
        self, path: BentPaths, optics: FlatWater | None, height: np.ndarray, numbers: Iterable[int]
    ) -> np.ndarray:
        """Heights (N,) [m] averaged over the maps that agree with them; as they are where none does."""
        points, total, count = path.at_height(height, optics), np.zeros(len(height)), np.zeros(len(height))
        for number in numbers:
            seen = self.load(number).observe(points, self.water)
            agrees = seen.agrees(height, self.tolerance)
            total[agrees] += seen.height[agrees]
            count += agrees
        return np.where(count > 0, total / np.maximum(count, 1), height)

    def _blended(
        self,
        path: BentPaths,
        points: np.ndarray,
        height: np.ndarray,
        sources: dict[int, Source],
        without_water: WithoutWater | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colours (N, 3) of points (N, 3), and whether a photograph shows them (N,) bool."""
        if not sources:
            return np.zeros((len(points), 3)), np.zeros(len(points), dtype=bool)
        seen = [source.observe(points, self.water) for source in sources.values()]
        inside = np.stack([each.inside for each in seen])
        agree = inside & np.stack([each.agrees(height, self.tolerance) for each in seen])
        # Where no map agrees (in gaps), photographs count in which nothing is in front (along a ray that comes down, a
        # higher surface); else all that look there.
        open_to = inside & ~np.stack([each.height > height + self.tolerance for each in seen])
        usable = np.where(agree.any(axis=0), agree, np.where(open_to.any(axis=0), open_to, inside))
        own = _directions(points, path.origin)
        total, weight = np.zeros((len(points), 3)), np.zeros(len(points))
        for (number, source), each, use in zip(sources.items(), seen, usable, strict=True):
            uv = each.uv[use]
            colour = source.colours(uv) * self.gains[number]
            wet = height[use] < 0.0
            if without_water is not None and self.water is not None and wet.any():
                rays = source.camera.paths(uv[wet].astype(np.float64), self.water).air_direction
                incidence = np.arccos(np.clip(-(rays @ np.asarray(self.water.up)), -1.0, 1.0))
                colour[wet] = without_water(colour[wet], -height[use][wet], incidence)
            angle = _angle(own[use], _directions(points[use], source.camera.centre))
            border = np.minimum(uv, (source.camera.width, source.camera.height) - uv).min(axis=1)
            w = np.clip(border / _BORDER_PX, 1e-3, 1.0) / (1.0 + (angle / _ANGLE) ** 2) ** 2
            total[use] += w[:, None] * colour
            weight[use] += w
        return total / np.maximum(weight, 1e-12)[:, None], weight > 0.0


def _tiles(surface: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rows and columns of the pixels of each part of a picture that show a surface."""
    rows, columns = (np.linspace(0, size, _CELLS + 1).astype(int) for size in surface.shape)
    tiles = []
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            row, column = np.nonzero(np.isfinite(surface[top:bottom, left:right]))
            if len(row):
                tiles.append((row + top, column + left))
    return tiles


def _centres(row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Middles (N, 2) [px] of pixels."""
    return np.column_stack([column + 0.5, row + 0.5])


def normals_of(place: np.ndarray) -> np.ndarray:
    """Unit normals (height, width, 3), up, of points of pixels; NaN without a neighbour in its row and its column."""
    normal = np.cross(_differences(place, 1), _differences(place, 0))
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return (normal * np.where(normal[..., 2:] < 0.0, -1.0, 1.0)).astype(np.float32)


def _differences(place: np.ndarray, axis: int) -> np.ndarray:
    """Differences (height, width, 3) of points along an axis, to both sides, or to one where the other is unknown."""
    step = np.diff(place, axis=axis, append=np.nan), np.diff(place, axis=axis, prepend=np.nan)
    known = [np.isfinite(each).all(axis=-1, keepdims=True) for each in step]
    sums = sum(np.where(each, part, 0.0) for each, part in zip(known, step, strict=True))
    return np.where(known[0] | known[1], sums, np.nan)


def heights_over(points: np.ndarray, water: FlatWater | None) -> np.ndarray:
    """Heights (N,) [m] over the water plane along its normal; over local z = 0 in a dry survey."""
    if water is None:
        return points[:, 2]
    return (points - np.asarray(water.point)) @ np.asarray(water.up)


def _directions(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    towards = points - centre
    return towards / np.linalg.norm(towards, axis=-1, keepdims=True)


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles [rad] between unit vectors (N, 3), exact for small ones."""
    return 2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(a - b, axis=-1), 0.0, 1.0))


def _sampled(image: np.ndarray, uv: np.ndarray, interpolation: int) -> np.ndarray:
    """Values of an image at places (N, 2) [px] inside it, the middle of the first pixel at 0.5."""
    parts = [np.zeros((0, *image.shape[2:]), dtype=image.dtype)]
    # OpenCV takes at most 32,767 places in a row or column.
    for first in range(0, len(uv), step := 32_000):
        x, y = (uv[first : first + step] - np.float32(0.5)).T
        parts.append(
            cv2.remap(image, x[None].copy(), y[None].copy(), interpolation, borderMode=cv2.BORDER_REPLICATE)[0]
        )
    return np.concatenate(parts)


@dataclass(frozen=True)
class Splats:
    """Points of every `_STRIDE`-th pixel of a height map along each side that has a height."""

    camera: PinholeCamera  # whose pixels those of the map are
    points: np.ndarray  # (N, 3) [m]: local
    heights: np.ndarray  # (N,) [m]: over the water plane

    @classmethod
    def of(cls, camera: PinholeCamera, heights: np.ndarray, optics: FlatWater | None) -> Splats:
        """Splats of heights (rows, columns) [m] of the paths of a camera's pixels; NaN where there is none."""
        rows, columns = _STRIDE * np.stack(np.nonzero(np.isfinite(heights[::_STRIDE, ::_STRIDE])))
        height = heights[rows, columns].astype(np.float64)
        path = camera.paths(np.column_stack([columns + 0.5, rows + 0.5]), optics)
        return cls(camera, path.at_height(height, optics), height)

    def spacing_px(self, camera: PinholeCamera) -> float:
        """Distance [px] at which neighbouring points appear in another camera, by distances and focal lengths."""
        some = self.points[:: max(len(self.points) // 1000, 1)]
        own, other = (np.linalg.norm(some - c.centre, axis=1) for c in (camera, self.camera))
        return float(np.median(other / own)) * _STRIDE * camera.fx / self.camera.fx


def front_surface(
    camera: PinholeCamera, optics: FlatWater | None, maps: Iterable[Splats], tolerance: float
) -> np.ndarray:
    """Heights (height, width) float32 [m] of the nearest surface of maps, from a z-buffer; NaN without one.

    Along a ray that comes down heights fall, so the highest point of a pixel is the nearest. Where the maps are
    coarser than the target, the buffer is as coarse, so that what lies behind does not show through. Heights that lie
    by less than a tolerance [m] below the highest are of the same surface, and averaged.
    """
    spacing, seen = [], []
    for splats in maps:
        if len(splats.points):
            spacing.append(splats.spacing_px(camera))
            seen.append((camera.project(splats.points, optics), splats.heights))
    if not seen:
        return np.full((camera.height, camera.width), np.nan, dtype=np.float32)
    scale = min(1.0, 1.0 / float(np.median(spacing)))
    width, height = (max(round(size * scale), 1) for size in (camera.width, camera.height))
    top = np.full(width * height, -np.inf)
    for number, (uv, z) in enumerate(seen):
        inside = camera.sees(uv)
        uv = uv[inside] * (width / camera.width, height / camera.height)
        cell, z = uv.astype(np.int64) @ [1, width], z[inside]
        np.maximum.at(top, cell, z)
        seen[number] = cell, z
    total, count = np.zeros(width * height), np.zeros(width * height)
    for cell, z in seen:
        front = z > top[cell] - tolerance
        total += np.bincount(cell[front], z[front], minlength=len(top))
        count += np.bincount(cell[front], minlength=len(top))
    with np.errstate(invalid="ignore"):
        mean = (total / count).reshape(height, width).astype(np.float32)
    if np.isnan(mean).all():
        return np.full((camera.height, camera.width), np.nan, dtype=np.float32)
    far, nearest = distance_transform_edt(np.isnan(mean), return_indices=True)
    mean = np.where(far <= _GAP_PX * scale, mean[tuple(nearest)], np.nan)
    return cv2.resize(mean, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
