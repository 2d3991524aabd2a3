"""View selection: a set of views that covers the bed, and the best neighbours of each.

Views of one place are compared in a coarse ground grid on a level plane at the bed's height: cheap, and exact enough
to choose by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from refract import BentPaths, FlatWater, PinholeCamera, crossing_point, trace

# NCC over small windows holds to about 30 degrees between views and gains depth precision with the angle;
# the best trade-off is flat around 15 to 20 degrees.
BEST_ANGLE_DEG = 18.0
ANGLE_WIDTH_DEG = 10.0
# Least share of a view that a neighbour sees; and weight of a cell for the next neighbour, by each that sees it.
_LEAST_OVERLAP, _SEEN_AGAIN = 0.05, 0.7
_LEAST_ANGLE_DEG = 1.5  # Views of one place, as in a burst, have a smaller angle
STEEP_DEG = 25.0  # A view is steep where its ray is nearer to the vertical than this
# Cells of the ground grid along each axis at least, and so many that a grid is whole; and across the narrow side of a
# view.
GRID_CELLS, MOST_CELLS = 48, 400
CELLS_PER_VIEW = 8
_LEAST_FALL = 0.05  # Rays nearer to the horizon than this sine meet no ground
_AT_ONCE = 64  # Cameras whose rays are searched for together
# Places along each side of an image, and the share of its extent by which a rectangle is wider than they say.
_PLACES, _MARGIN = 17, 0.02


def ground_points(cameras: list[PinholeCamera], height: float) -> np.ndarray:
    """Intersections of the optical axes with the plane z = height, (views, 3) [m] local; NaN for those that look up."""
    axes = np.array([c.cam_from_local[2] for c in cameras])
    centres = np.array([c.centre for c in cameras])
    descent = np.where(axes[:, 2] < -_LEAST_FALL, axes[:, 2], np.nan)
    return centres + axes * ((height - centres[:, 2]) / descent)[:, None]


def require_ground(cameras: list[PinholeCamera], height: float) -> np.ndarray:
    """`ground_points`; ValueError where no photograph looks down at the ground."""
    centres = ground_points(cameras, height)
    if np.isnan(centres).all():
        raise ValueError(
            f"no photograph looks down at the ground at height {height:.1f} m, local; expected some taken downward: "
            "check the rotations of the poses"
        )
    return centres


def coverage(
    cameras: list[PinholeCamera],
    water: FlatWater | None,
    height: float,
    ground: tuple[float, float, float, float] | None = None,
) -> tuple[csr_array, np.ndarray]:
    """Visibility (views, cells) bool, sparse, of cells of a ground grid at z = height, and the cells (cells, 3).

    The grid spans ``ground`` (x0, y0, x1, y1) [m], local; by default all that the views may see. Of a large one only
    cells that the views may see are there. Raises ValueError if no photograph looks down at the ground.
    """
    centres = require_ground(cameras, height)
    pixel_size = np.array([(c.centre[2] - height) / c.fx for c in cameras])
    reach = np.max(pixel_size * [c.widening * np.hypot(c.width, c.height) / 2 for c in cameras])
    side = np.median(pixel_size * [min(c.width, c.height) for c in cameras])
    low, high = np.nanmin(centres, axis=0)[:2] - reach, np.nanmax(centres, axis=0)[:2] + reach
    if ground is not None:
        low, high = np.array(ground[:2]), np.array(ground[2:])
    columns, rows = np.maximum(np.ceil((high - low) * CELLS_PER_VIEW / side), GRID_CELLS).astype(int)
    x, y = np.linspace(low[0], high[0], columns), np.linspace(low[1], high[1], rows)
    plan = (
        np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        if max(columns, rows) <= MOST_CELLS
        else _visible_nodes(cameras, height, x, y)
    )
    cells = np.column_stack([plan, np.full(len(plan), height)])
    y_of_plan = np.ascontiguousarray(plan[:, 1])
    rows = []
    for first in range(0, len(cameras), _AT_ONCE):
        some = cameras[first : first + _AT_ONCE]
        near = [_near(camera, height, plan, y_of_plan) for camera in some]
        pixels = pixels_in(some, [cells[number] for number in near], water)
        rows += [number[camera.sees(seen)] for number, camera, seen in zip(near, some, pixels, strict=True)]
    ends = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
    columns = np.concatenate(rows)
    return csr_array((np.ones(len(columns), dtype=bool), columns, ends), shape=(len(cameras), len(cells))), cells


def _near(camera: PinholeCamera, height: float, plan: np.ndarray, y_of_plan: np.ndarray) -> np.ndarray:
    """Numbers of the places (N, 2) in the rectangle about a camera and what it sees at z = height by straight rays.

    Bent rays end between. All places where one of its rays is near to the horizon. Places are in ascending order of
    ``y_of_plan`` (N,).
    """
    over, rays = camera.centre[2] - height, camera.directions(camera.outline())
    if over <= 0.0 or not (rays[:, 2] < -_LEAST_FALL).all():
        return np.arange(len(plan))
    ends = np.concatenate([camera.centre[:2] - rays[:, :2] * (over / rays[:, 2:]), camera.centre[None, :2]])
    low, high = ends.min(axis=0), ends.max(axis=0)
    margin = _MARGIN * (high - low).max()
    low, high = low - margin, high + margin
    first, last = np.searchsorted(y_of_plan, low[1]), np.searchsorted(y_of_plan, high[1], side="right")
    x = plan[first:last, 0]
    return first + np.flatnonzero((x >= low[0]) & (x <= high[0]))


def _visible_nodes(cameras: list[PinholeCamera], height: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Nodes (N, 2) of a grid that any of some cameras may see at z = height, row by row.

    Of the rectangle about a camera and what it sees by straight rays, between which bent ones end; every second node of
    it, or third, where it has more than `MOST_CELLS` along an axis.
    """
    found = [np.zeros(0, dtype=np.int64)]
    for camera in cameras:
        over, rays = camera.centre[2] - height, camera.directions(camera.outline())
        rays = rays[np.isfinite(rays).all(axis=1)]
        if over <= 0.0 or not (rays[:, 2] < -_LEAST_FALL).any():
            continue
        ends = camera.centre[:2] + rays[:, :2] * (over / np.maximum(-rays[:, 2], _LEAST_FALL))[:, None]
        ends = np.concatenate([ends, camera.centre[None, :2]])
        spans = []
        for axis, low, high in zip((x, y), ends.min(axis=0), ends.max(axis=0), strict=True):
            first, end = np.searchsorted(axis, (low, high))
            first, end = max(first - 1, 0), min(end + 1, len(axis))
            every = max(-(-(end - first) // MOST_CELLS), 1)
            # The same nodes for all cameras that leave out as many.
            spans.append(np.arange(-(-first // every) * every, end, every))
        found.append((spans[1][:, None] * len(x) + spans[0]).ravel())
    row, column = np.divmod(np.unique(np.concatenate(found)), len(x))
    return np.column_stack([x[column], y[row]])


def cover(
    seen: csr_array, cells: np.ndarray, cameras: list[PinholeCamera], times: int, times_oblique: int
) -> list[int]:
    """A small set of views that sees every cell from every side.

    A cell is to be seen ``times`` times by steep views, whose ground sampling distance is the finest and which agree
    best, and ``times_oblique`` times by oblique ones from each of four quarters, which look under what the steep ones
    see from above; where there are too few, ``times`` times by any. Greedy in each class.
    """
    view, cell = seen.nonzero()
    centres = np.array([camera.centre for camera in cameras])
    ray = centres[view] - cells[cell]
    steep = ray[:, 2] > np.cos(np.radians(STEEP_DEG)) * np.linalg.norm(ray, axis=1)
    quarter = np.floor(np.arctan2(ray[:, 1], ray[:, 0]) / (0.5 * np.pi)).astype(int) % 4

    def subset(use: np.ndarray) -> csr_array:
        return csr_array((np.ones(int(use.sum()), dtype=bool), (view[use], cell[use])), shape=seen.shape)

    chosen = _greedy(subset(steep), [], times)
    for side in range(4):
        chosen = _greedy(subset(~steep & (quarter == side)), chosen, times_oblique)
    return sorted(_greedy(seen, chosen, times))


def _greedy(seen: csr_array, chosen: list[int], times: int) -> list[int]:
    """``chosen`` and the views still needed so that each cell is seen ``times`` times, or by all that see it."""
    chosen, views_of_cell = list(chosen), seen.tocsc()
    need = np.minimum(seen.sum(axis=0), times)
    have = seen[chosen].sum(axis=0)
    gain = seen @ (have < need).astype(np.int64)
    while True:
        gain[chosen] = 0
        if gain.max() == 0:
            return chosen
        best = int(gain.argmax())
        chosen.append(best)
        own_cells = cells_of(seen, best)
        have[own_cells] += 1
        # Only the cells that have enough now count less: thousands of views would take minutes otherwise.
        gain -= views_of_cell[:, own_cells[have[own_cells] == need[own_cells]]].sum(axis=1)


def cells_of(seen: csr_array, view: int) -> np.ndarray:
    """Numbers of the cells that a view sees, ascending."""
    return np.sort(seen.indices[seen.indptr[view] : seen.indptr[view + 1]])


def overlaps(seen: csr_array, view: int) -> np.ndarray:
    """Share (V,) of the cells that a view sees which each view sees; it sees one at least."""
    own_cells = cells_of(seen, view)
    is_own = np.zeros(seen.shape[1], dtype=np.int64)
    is_own[own_cells] = 1
    return (seen @ is_own) / len(own_cells)


def neighbours(
    cameras: list[PinholeCamera], seen: csr_array, cells: np.ndarray, view: int, candidates: list[int], count: int
) -> list[int]:
    """The ``count`` best neighbours of a view among others by overlap, intersection angle and spread of directions.

    Greedy: each is the best beside those before it, in directions and in the parts of the view that it sees. Those of a
    burst, taken from the same place, match at every height: they are neighbours only where no others overlap.
    """
    own_cells = cells_of(seen, view)
    if not len(own_cells):
        return []
    overlap = overlaps(seen, view)
    centres = np.array([c.centre for c in cameras])
    rays = centres - cells[own_cells].mean(axis=0)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(rays @ rays[view], -1.0, 1.0)))
    overlapping = [o for o in candidates if o != view and overlap[o] >= _LEAST_OVERLAP]
    others = [o for o in overlapping if angles[o] >= _LEAST_ANGLE_DEG] or overlapping
    shared = seen[others][:, own_cells].astype(np.float64)
    # Cells that chosen neighbours see count less for the next ones: else corners of a view may have none.
    weight = np.full(len(own_cells), 1.0 / len(own_cells))
    suitable = np.exp(-0.5 * ((angles[others] - BEST_ANGLE_DEG) / ANGLE_WIDTH_DEG) ** 2)
    direction = rays[others] - rays[view]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True) + 1e-12
    spread, chosen = np.ones(len(others)), list[int]()
    while len(chosen) < min(count, len(others)):
        value = (shared @ weight) * suitable * spread
        value[chosen] = -1.0
        best = int(value.argmax())
        chosen.append(best)
        spread *= 1.0 - 0.5 * np.clip(direction @ direction[best], 0.0, 1.0) ** 2
        weight[shared.indices[shared.indptr[best] : shared.indptr[best + 1]]] *= _SEEN_AGAIN
    return [others[c] for c in chosen]


def middle_path(camera: PinholeCamera, water: FlatWater | None) -> BentPaths:
    """Path of the middle of a view, twice: for two heights on it."""
    return camera.paths(np.full((2, 2), (camera.width / 2, camera.height / 2)), water)


def parallax(
    cameras: list[PinholeCamera], water: FlatWater | None, path: BentPaths, others: list[int], height: float
) -> float:
    """Parallax [px/m] in other views per metre of height of a bed point on a `middle_path`.

    ``height`` [m] is over the water plane along its normal (over local z = 0 in a dry survey). The upper quartile over
    the others; the sweep's steps and tolerances follow from it. At least 1e-3.
    """
    ends = path.at_height(height + np.array([-0.05, 0.05]), water)
    pixels = pixels_in([cameras[other] for other in others], [ends] * len(others), water)
    moves = [np.linalg.norm(np.diff(each, axis=0)) / 0.1 for each in pixels]
    return max(float(np.nanquantile(moves, 0.75)), 1e-3)


def pixels_in(
    cameras: Sequence[PinholeCamera], points: Sequence[np.ndarray], water: FlatWater | None
) -> list[np.ndarray]:
    """Pixels (N, 2) [px] of the points (N, 3) [m], local, that belong to each camera.

    One search of crossings for all, where cameras neither move nor have tides: with few points calls take the time.
    """
    if not cameras or any(camera.motion is not None or camera.tide != 0.0 for camera in cameras):
        return [camera.project(own, water) for camera, own in zip(cameras, points, strict=True)]
    counts = [len(own) for own in points]
    centres = np.repeat([camera.centre for camera in cameras], counts, axis=0)
    directions = np.split(crossing_point(np.concatenate(points), centres, water) - centres, np.cumsum(counts)[:-1])
    return [camera.pixels_of(direction) for camera, direction in zip(cameras, directions, strict=True)]


@dataclass(frozen=True)
class Footprint:
    """Bounding rectangle of the ground that a view may show: corners (2,) [m], local, infinite to the horizon."""

    low: np.ndarray
    high: np.ndarray

    @staticmethod
    def of(camera: PinholeCamera, water: FlatWater | None, heights: tuple[float, float]) -> Footprint:
        """Footprint of the ground between two heights [m] over the water plane."""
        return Footprint.of_each([camera], water, heights)[0]

    @staticmethod
    def of_each(
        cameras: Sequence[PinholeCamera], water: FlatWater | None, heights: tuple[float, float]
    ) -> list[Footprint]:
        """Footprints of cameras; in one search without tides: with few rays of each, calls take the time."""
        if not cameras:
            return []
        share = np.linspace(0.0, 1.0, _PLACES)
        sides = [[(x, y) for x in share for y in (0.0, 1.0)], [(x, y) for x in (0.0, 1.0) for y in share]]
        border = np.concatenate(sides)
        pixels = [border * (camera.width, camera.height) for camera in cameras]
        if any(camera.tide != 0.0 for camera in cameras):
            paths = [camera.paths(own, water) for camera, own in zip(cameras, pixels, strict=True)]
        else:
            shape = (len(border), 3)
            centres = [np.broadcast_to(c.centres(own), shape) for c, own in zip(cameras, pixels, strict=True)]
            directions = [camera.directions(own) for camera, own in zip(cameras, pixels, strict=True)]
            paths = [trace(np.concatenate(centres), np.concatenate(directions), water)]
        # Paths are straight between these heights: they bend at the water.
        levels = {*heights, float(np.clip(0.0, *heights))}
        count = len(cameras) * len(border) // len(paths)
        places = [[path.at_height(np.full(count, level), water)[:, :2] for level in levels] for path in paths]
        each = np.split(np.concatenate(places, axis=1), len(cameras), axis=1)
        footprints = []
        for points in (own.reshape(-1, 2) for own in each):
            low, high = points.min(axis=0), points.max(axis=0)
            margin = _MARGIN * (high - low).max()
            # Without end where one of them is not finite.
            ends = (
                (low - margin, high + margin) if np.isfinite(points).all() else np.array([[-np.inf] * 2, [np.inf] * 2])
            )
            footprints.append(Footprint(*ends))
        return footprints

    def meets(self, other: Footprint) -> bool:
        return bool((self.low <= other.high).all() and (other.low <= self.high).all())
