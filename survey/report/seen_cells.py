"""Cells of the ground in plan: which have a point of the bed, how many views see each, the water over them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt

from geo.frames import LocalFrame
from geo.grid import Grid, plan_box
from geo.projection import ground_units_m
from refract import FlatWater, PinholeCamera
from survey.display.plan_grid import PlanGrid, median
from survey.folder.survey import Survey
from survey.plan.area import Area, local_area
from survey.water.surface import Departure, plane_under

# Side of a cell, in ground sampling distances: large against the spacing of points, about one, and smaller than a gap
# that matters.
CELL_GSD = 10.0
# At most this many cells along an axis; larger areas take larger cells.
_MOST_CELLS = 2000
# Codes of cells without a point: by the number of views alone, and by reasons (`survey.report.gap_reasons`).
TWO_VIEWS, ONE_VIEW = 1, 2
MASKED, GLINT, NO_PAIR, PLAIN, DEEP, CONTRADICTED, HIDDEN, DELETED, UNLIKE = range(3, 12)
REASONS = {
    ONE_VIEW: "one view only: no second ray to intersect",
    MASKED: "masked: masks leave fewer than two views",
    GLINT: "glint: white in the views",
    NO_PAIR: "no pair of views to match: too little overlap, or one place of the camera",
    PLAIN: "no texture: plain in the views",
    UNLIKE: "unlike: the views show texture, but not the same: it moves, or they see it from too far apart",
    DEEP: "too deep or turbid: nothing matches, and deeper than where half of the bed is found",
    CONTRADICTED: "contradicted: the views match, but at no height on which two agree",
    HIDDEN: "hidden: the views show the bed, but another place of it, in front of this one",
    DELETED: "points deleted by hand",
    TWO_VIEWS: "two or more views, reason not recorded: of a field, or by an earlier version",
}


@dataclass(frozen=True)
class SeenCells:
    """Square cells of the ground [m], local; arrays (rows, columns), rows from south to north."""

    grid: Grid
    has_point: np.ndarray  # bool
    num_views: np.ndarray  # int: views that see the middle of the cell; occlusion is ignored
    # float64 [m], local: mean of the points; where there are none, that of the nearest cell that has some
    height: np.ndarray
    reasons: np.ndarray | None = None  # uint8: codes of `REASONS`, 0 for all other cells; None where nobody has looked

    @property
    def middles(self) -> np.ndarray:
        """Middles of the cells at their heights (rows, columns, 3) [m], local."""
        return np.dstack([self.grid.middles(), self.height])

    @property
    def gaps(self) -> np.ndarray:
        """Codes (rows, columns) uint8 of cells without a point, by their reasons or views; 0 for all others."""
        if self.reasons is not None:
            return self.reasons
        views = np.where(self.num_views >= 2, TWO_VIEWS, np.where(self.num_views == 1, ONE_VIEW, 0))
        return np.where(self.has_point, 0, views).astype(np.uint8)

    def in_crs(self, codes: np.ndarray, frame: LocalFrame, most: int = 1 << 15) -> tuple[Grid, np.ndarray]:
        """Codes (rows, columns) uint8 of the cells in cells of crs, at most so many along a side; 0 beyond."""
        rows, columns = self.height.shape
        corners = self.middles[:: max(rows - 1, 1), :: max(columns - 1, 1)].reshape(-1, 3)
        low, high = plan_box(frame.crs_from_local(corners))
        size_m = float(((high - low) * ground_units_m(frame.crs, low)).max())
        grid = Grid.southward_from(low, high, max(self.grid.side_m, size_m / (most - 1)), frame.crs)
        return grid, code_at(self.grid, codes, grid.middles(), frame)


def code_at(grid: Grid, codes: np.ndarray, places: np.ndarray, frame: LocalFrame) -> np.ndarray:
    """Codes (...) uint8 of the cells of a local grid under places (..., 2) in crs; 0 beyond.

    Heights matter little: a metre moves a place by micrometres.
    """
    height = np.full((*places.shape[:-1], 1), float(frame.origin[2]))
    local = frame.local_from_crs(np.concatenate([places, height], axis=-1))
    at = grid.columns_rows(local)
    inside = np.all((at >= 0.0) & (at < grid.shape[::-1]), axis=-1)
    return np.where(inside, codes[grid.index(np.where(inside[..., None], local, 0.0))], 0).astype(np.uint8)


def cells_seen(
    cameras: Sequence[PinholeCamera],
    water: FlatWater | None,
    departure: Departure | None,
    area: Area | None,
    xyz: np.ndarray,
    gsd_m: float,
) -> SeenCells:
    """Cells of the ground at the heights of points (N, 3) [m], local, N at least 1, and how many views see each.

    Rays bend at the plane that fits the water under each camera, where that departs from its plane. The area of
    interest is (x0, y0, x1, y1) [m], local; None: the ground around the points at which cameras look, by half a
    footprint. Cells are `CELL_GSD` ground sampling distances [m] wide.
    """
    low, high = _extent(cameras, area, median(xyz[:, 2]))
    cell = max(CELL_GSD * gsd_m, float((high - low).max()) / _MOST_CELLS)
    southward = PlanGrid.within(xyz, low, high, cell)
    height = southward.mean(xyz[:, 2])[::-1]
    grid, has_point = Grid.northward_from(southward.box[0], cell, southward.shape), np.isfinite(height)
    num_views = np.zeros(grid.shape, dtype=int)
    if not has_point.any():
        return SeenCells(grid, has_point, num_views, height)
    nearest = distance_transform_edt(~has_point, return_distances=False, return_indices=True)
    cells = SeenCells(grid, has_point, num_views, height[tuple(nearest)])
    places = cells.middles
    x, y = places[0, :, 0], places[:, 0, 1]
    for camera in cameras:
        part = around(camera, x, y, cells.height)
        pixel = camera.project(places[part].reshape(-1, 3), plane_under(water, departure, camera.centre))
        sees = camera.sees(pixel)
        num_views[part] += sees.reshape(num_views[part].shape)
    return cells


def _extent(cameras: Sequence[PinholeCamera], area: Area | None, height: float) -> tuple[np.ndarray, np.ndarray]:
    """South-western and north-eastern corner (2,) [m], local, of the area of interest."""
    if area is not None:
        return np.array(area[:2]), np.array(area[2:])
    centres = np.array([camera.centre for camera in cameras])
    axes = np.array([camera.cam_from_local[2] for camera in cameras])
    # Views to the horizon are taken to look at most 45 degrees up from the vertical.
    axis_z = np.minimum(axes[:, 2], -np.sqrt(0.5))
    foot = centres[:, :2] + axes[:, :2] * ((height - centres[:, 2]) / axis_z)[:, None]
    half = np.array([0.5 * c.widening * np.hypot(c.width / c.fx, c.height / c.fy) for c in cameras])
    reach = (half * np.maximum(centres[:, 2] - height, 0.0))[:, None]
    return (foot - reach).min(axis=0), (foot + reach).max(axis=0)


def around(camera: PinholeCamera, x: np.ndarray, y: np.ndarray, height: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of the cells that a camera can see at all: those in the box around its straight footprint.

    Refraction only moves footprints towards the nadir.
    """
    directions = camera.directions(camera.outline())
    height_over = camera.centre[2] - float(height.min())
    # False for NaN, where the lens brings no light to the border.
    if not (directions[:, 2] < -1e-3).all() or height_over <= 0.0:
        return slice(None), slice(None)
    ends = camera.centre[:2] + directions[:, :2] * (height_over / -directions[:, 2])[:, None]
    ends = np.concatenate([ends, camera.centre[None, :2]])
    (x0, y0), (x1, y1) = ends.min(axis=0), ends.max(axis=0)
    return slice(*np.searchsorted(y, (y0, y1))), slice(*np.searchsorted(x, (x0, x1)))


def cells_of(survey: Survey, xyz: np.ndarray, gsd_m: float) -> SeenCells:
    """Cells of the ground of a survey: which have points (N, 3) [m], local, and the number of views that see each."""
    cameras, departure = [view.camera for view in survey.views], survey.observations.departure
    return cells_seen(cameras, survey.water, departure, local_area(survey), xyz, gsd_m)


def coverage_of(cells: SeenCells, depth: np.ndarray | None, shared_std_m: float | None) -> dict[str, Any]:
    """Areas [m^2] of the ground that a view looks at, of that with points, and of the rest by reason; of its water.

    Depths (rows, columns) [m] below the water are negative or NaN on dry ground, and None in a dry survey. `water_m3`
    is the volume between bed and surface where a bed was found, its standard deviation that by `shared_std_m` [m],
    which all heights share (None: unknown).
    """
    cell_m2, count = cells.grid.side_m**2, np.bincount(cells.gaps.ravel(), minlength=len(REASONS) + 1)
    reasons = {REASONS[code]: cell_m2 * float(count[code]) for code in REASONS if count[code]}
    found = {
        "ground_m2": cell_m2 * float(np.count_nonzero(cells.num_views)),
        "found_m2": cell_m2 * float(np.count_nonzero(cells.has_point & (cells.num_views > 0))),
        "reasons_m2": dict(sorted(reasons.items(), key=lambda entry: -entry[1])),
    }
    if depth is None:
        return found
    wet = (depth > 0.0) & cells.has_point
    wet_m2 = cell_m2 * float(wet.sum())
    std_m3 = None if shared_std_m is None else wet_m2 * shared_std_m
    return found | {"wet_m2": wet_m2, "water_m3": cell_m2 * float(depth[wet].sum()), "water_std_m3": std_m3}
