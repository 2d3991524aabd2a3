"""Points of the bed from height maps: one point per piece of the bed, with its attributes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from fields.image_store import Masks
from fields.sweep.block import Block
from fields.sweep.images import half_range, median, steep_and_wall_pixels
from fields.sweep.kernels.arrays import free_unused
from fields.sweep.kernels.rays import find_duplicates, rays_and_heights
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.map_points import SteepPixels, add_points_beneath, filter_steep_pixels, pixels_beside_steps
from fields.sweep.maps import HeightMap, height_std, is_confirmed, trusted, views_of
from fields.sweep.views import Footprint
from refract import FlatWater, PinholeCamera


@dataclass(frozen=True)
class BedPoints:
    """Points of the bed, in the local frame; N of them."""

    xyz: np.ndarray  # (N, 3) float64 [m]
    rgb: np.ndarray  # (N, 3) uint8
    std: np.ndarray  # (N,) float32 [m]: standard deviation of the height
    num_views: np.ndarray  # (N,) uint8: views that see the point at this height, the one it was taken from included
    depth: np.ndarray  # (N,) float32 [m]: below the water surface, vertical, positive in water; NaN in a dry survey
    # (N,) float32 [rad]: angle between the ray in air and the normal of the water (of local z in a dry survey)
    incidence: np.ndarray
    wet: np.ndarray  # (N,) bool
    # (N,) uint8: 1 for points that no height map has (`fields.occluded`), else 0; by default 0 for all
    origin: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.uint8))

    def __post_init__(self):
        if not len(self.origin):
            object.__setattr__(self, "origin", np.zeros(len(self.xyz), dtype=np.uint8))

    def __len__(self) -> int:
        return len(self.xyz)

    def __getitem__(self, keep) -> BedPoints:
        return BedPoints(*(getattr(self, f.name)[keep] for f in fields(self)))

    @staticmethod
    def consume_where(parts: list[BedPoints], keep: Callable[[np.ndarray], np.ndarray]) -> tuple[BedPoints, np.ndarray]:
        """Points of several views that ``keep`` selects by coordinates (N, 3), and its mask (N,) bool.

        The list of parts is emptied column by column, so that at most one part is in memory twice.
        """
        columns = {f.name: [getattr(p, f.name) for p in parts] for f in fields(BedPoints)}
        parts.clear()
        xyz = np.concatenate(columns.pop("xyz"))
        kept = keep(xyz)
        xyz = xyz[kept]
        return BedPoints(xyz, *(np.concatenate(columns.pop(name))[kept] for name in list(columns))), kept

    @staticmethod
    def empty() -> BedPoints:
        none = np.empty(0, dtype=np.float32)
        return BedPoints(
            np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8), none, none.astype(np.uint8), none, none, none > 0.0
        )

    @staticmethod
    def concatenate(parts: list[BedPoints]) -> BedPoints:
        """Points of several views in one."""
        return BedPoints(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(BedPoints)))


# Least NCC of a height on a wall that a single other view confirms: photographs correlate less there than
# `fields.sweep.maps.TRUSTED_NCC` asks for.
WALL_NCC = 0.6
# A point with fewer neighbours than this within so many ground sampling distances is an outlier.
LEAST_NEIGHBOURS, NEIGHBOURHOOD_GSD = 4, 4.0
# A height that no third view checks is compared with the confirmed pixels in a square of this side [px]: least share of
# pixels that are confirmed, and of these that agree with it. Chance matches are sparse and scatter.
_SUPPORT_PX, _LEAST_CONFIRMED, _LEAST_AGREEING = 17, 0.4, 0.7
_POINTS_AT_ONCE = 500_000  # Pixels of a batch, of 300 bytes each
POINTS_PER_SLAB = 500_000  # Points of a batch, in a slab of the ground: their search takes 80 bytes each
# A slab is searched with its surroundings as far as this times the distance of neighbours, which is an upper bound.
_UPPER_BOUND_FACTOR = 1.001
_WHOLE_RANGE = 2.0  # The range of heights, as a multiple of the half of it that `half_range` gives
_LEAST_COSINE = 0.01  # Least cosine of the incidence of a ray that shows the bed


def unique_pixels(block: Block, maps: Sequence[HeightMap], gsd: float) -> Masks:
    """Pixels of each map that become points: every piece of the bed once, from its steepest view.

    Views take turns, the steepest first: their ground sampling distance is the finest. A pixel that is kept claims, in
    every later view, the four pixels around its projection whose heights agree with it; claimed pixels are duplicates.
    On walls, where neighbouring pixels lie far apart, it claims only those within the ground sampling distance ``gsd``
    [m] of it. Only trusted pixels are kept. Steep pixels are tested once more in space, which adds pixels on walls and
    drops wrong ones (`fields.sweep.images`). So are pixels beneath overhangs (`fields.sweep.map_points`), where one
    confirming view is enough. Returns Masks (height, width), in the order of `maps`.
    """
    chosen = views_of(maps)
    cameras = [block.cameras[view] for view in chosen]
    shapes: list[tuple[int, ...]] = [(camera.height, camera.width) for camera in cameras]
    kept, claimed, walls, steep, all_trusted, addable, near_steps = (Masks(list(shapes)) for _ in range(7))
    ground, tolerances = [], []
    for index, m in enumerate(maps):
        others = block.neighbours(m.view, 8, candidates=chosen)
        tolerance = block.agreement_tolerance(m.view, others, median(m.height)) if others else 0.0
        extent = float(m.height.min()), float(m.height.max())
        ground.append(Footprint.of(cameras[index], block.water, extent))
        tolerances.append(tolerance)
        steep[index], walls[index] = steep_and_wall_pixels(m.height, tolerance)
        all_trusted[index] = trusted(m)
    order = sorted(range(len(maps)), key=lambda i: cameras[i].cam_from_local[2][2])
    heights = ViewStack.lazy(block.device, cameras, lambda index: maps[index].height, block.water)
    for place, index in enumerate(order):
        # A masked pixel of the photograph has a height of its surroundings, but neither colour nor match.
        shown, m = np.isfinite(block.images[chosen[index]]), maps[index]
        kept[index] = keep = all_trusted[index] & shown & ~claimed[index]
        addable[index] = walls[index] & shown & is_confirmed(m, WALL_NCC)
        near_steps[index] = shown & (m.agreeing > 0) & pixels_beside_steps(m.height, gsd)
        if not keep.any():
            continue
        rays, own = rays_and_heights(heights, index, np.flatnonzero(keep))
        for later in order[place + 1 :]:
            if ground[index].meets(ground[later]):
                same, close = find_duplicates(heights, rays, own, later, tolerances[index], gsd)
                claimed.add(later, same & (close | ~walls[later].ravel()))
        free_unused(block.device)
    filter_steep_pixels(heights, SteepPixels(steep, addable, all_trusted), kept, gsd)
    add_points_beneath(heights, near_steps, all_trusted, kept, gsd)
    return kept


def is_supported(height: np.ndarray, confirmed: np.ndarray, tolerance: float) -> np.ndarray:
    """Confirmed pixels (height, width) bool of a map that agree with the surface around them.

    A check for heights that only one other view can confirm: two photographs, of which a moving surface or a repeating
    texture may give the same wrong height to single windows, but not to a whole neighbourhood. ``height`` (height,
    width) [m]. ``confirmed`` (height, width) bool. ``tolerance`` [m]: within which heights agree.
    """
    radius = _SUPPORT_PX // 2
    known = np.pad(np.where(confirmed, height, np.nan).astype(np.float32), radius, constant_values=np.nan)
    rows, columns = height.shape
    near, agreeing = (np.zeros(height.shape, dtype=np.uint16) for _ in range(2))
    # Every second pixel of the square suffices.
    for dy in range(0, _SUPPORT_PX, 2):
        for dx in range(0, _SUPPORT_PX, 2):
            other = known[dy : dy + rows, dx : dx + columns]
            near += np.isfinite(other)
            agreeing += np.abs(other - height) < tolerance
    enough = near >= _LEAST_CONFIRMED * len(range(0, _SUPPORT_PX, 2)) ** 2
    return confirmed & enough & (agreeing >= _LEAST_AGREEING * near)


def has_neighbours(xyz: np.ndarray, gsd: float) -> np.ndarray:
    """Outlier filter of points (N, 3) [m]: (N,) bool, True with enough neighbours within `NEIGHBOURHOOD_GSD`.

    A surface sampled once per GSD (ground sampling distance [m]) has 50 there, one that only very oblique views show
    about 6; a chance agreement of views has no neighbours.
    """
    found, x, reach = np.zeros(len(xyz), dtype=bool), xyz[:, 0], NEIGHBOURHOOD_GSD * gsd
    if len(xyz) <= LEAST_NEIGHBOURS:
        return found
    # Quantiles of every hundredth point: slabs of about as many points each.
    edges = np.quantile(x[::100], np.linspace(0.0, 1.0, -(-len(xyz) // POINTS_PER_SLAB) + 1))
    for low, high in pairwise([-np.inf, *edges[1:-1], np.inf]):
        in_strip = np.flatnonzero((x >= low) & (x < high))
        if not len(in_strip):
            continue
        near = xyz[(x >= low - _UPPER_BOUND_FACTOR * reach) & (x < high + _UPPER_BOUND_FACTOR * reach)]
        distance, _ = cKDTree(near).query(
            xyz[in_strip], k=[LEAST_NEIGHBOURS + 1], distance_upper_bound=reach, workers=-1
        )
        found[in_strip] = np.isfinite(distance[:, 0])
    return found


def std_of_kept(
    height_map: HeightMap,
    keep: np.ndarray,
    tolerance: float,
    solved_std: np.ndarray | None = None,
    num_comparable: np.ndarray | None = None,
) -> np.ndarray:
    """Standard deviation (height, width) [m] of the heights of the kept pixels: that of the solver, else of the map.

    ``tolerance`` [m] is that of views that agree, ``solved_std`` (height, width) [m] is NaN where it is not known;
    ``num_comparable`` is as `height_std` has it. The map may be larger than ``keep``, the size of the image.
    """
    part = np.s_[: keep.shape[0], : keep.shape[1]]
    comparable = None if num_comparable is None else num_comparable[part]
    if solved_std is not None and not np.isnan(solved_std[part][keep]).any():
        return solved_std[part]
    std = height_std(height_map.height[part], height_map.agreeing[part], height_map.spread[part], tolerance, comparable)
    return std if solved_std is None else np.where(np.isnan(solved_std[part]), std, solved_std[part])


def points_of(
    camera: PinholeCamera,
    water: FlatWater | None,
    height_map: HeightMap,
    keep: np.ndarray,
    rgb: np.ndarray,
    std: np.ndarray,
) -> BedPoints:
    """Points of the kept pixels (height, width) bool of one view, in float64 from the ray to the point.

    ``std`` (height, width) [m] is that of the heights. The map may be larger than the camera's image (padded at its
    right and bottom).
    """
    height, agreeing = (array[: camera.height, : camera.width] for array in (height_map.height, height_map.agreeing))
    parts = []
    for first in range(0, camera.height, rows := max(_POINTS_AT_ONCE // camera.width, 1)):
        part = np.s_[first : first + rows]
        row, column = np.nonzero(keep[part])
        path = camera.paths(np.column_stack([column + 0.5, row + (first + 0.5)]), water)
        heights = height[part][row, column].astype(np.float64)
        xyz = path.at_height(heights, water)
        normal = np.array(water.up if water else (0.0, 0.0, 1.0))
        depth = water.height(xyz[:, 0], xyz[:, 1]) - xyz[:, 2] if water else np.full(len(xyz), np.nan)
        parts.append(
            BedPoints(
                xyz,
                rgb[part][row, column],
                std[part][row, column].astype(np.float32),
                (agreeing[part][row, column] + 1).astype(np.uint8),
                depth.astype(np.float32),
                np.arccos(np.clip(-(path.air_direction @ normal), -1.0, 1.0)).astype(np.float32),
                np.zeros(len(xyz), dtype=bool) if water is None else heights < 0.0,
            )
        )
    return BedPoints.concatenate(parts)


def with_slope_std(
    points: BedPoints, height: np.ndarray, keep: np.ndarray, gsd: float, water: FlatWater | None
) -> BedPoints:
    """Points of the kept pixels of a map (height, width) [m], with the std that slopes and edges add.

    An error of the height moves the point along its ray, and so in plan by the error times the slope of the ray. On
    level ground the height there is the same; on a slope or at an edge it differs, at most by the range of the heights
    around. Differences within the std of the heights count as neither. ``gsd`` [m] is the side of a pixel.
    """
    n = 1.0 if water is None else water.n_water
    sine = np.sin(points.incidence) / np.where(points.wet, n, 1.0)
    ray_slope = sine / np.sqrt(np.maximum(1.0 - sine * sine, _LEAST_COSINE**2))
    height_range = half_range(height)[: keep.shape[0], : keep.shape[1]][keep]
    plan_shift_px = np.minimum(ray_slope * points.std / gsd, _WHOLE_RANGE)
    variance = points.std**2 + plan_shift_px**2 * np.maximum(height_range**2 - points.std**2, 0.0)
    return replace(points, std=np.sqrt(variance).astype(np.float32))
