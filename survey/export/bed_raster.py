"""Gridding of the points of a run: the raster of the bed, from which all raster products are made.

Cells are worked on in bands of rows of about two million points; the rasters lie in files, so that they may be larger
than the memory.

Gaps are filled up to a stated width: where a square of that width does not fit into them. Filled cells are marked in a
mask. Their height is the mean of the known cells around, weighted by the inverse square of the distance; its standard
deviation is that distance times the root mean square slope of the known cells near by.

A terrain model has one height per place, the highest. Points are binned into squares of about a pixel. A point well
below the highest ones of its own and the neighbouring squares is under a roof (a hull, a deck) or on a wall, which
covers no area in plan; it is left out. The position of a wall is uncertain by a pixel or two, so that a point beside it
may be wrong by the whole drop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pyproj import CRS
from scipy import ndimage
from scipy.spatial import cKDTree

from geo.crs import height_unit_m
from geo.files import scratch_array
from geo.grid import Grid, Window
from geo.projection import ground_units_m
from survey.display.quantities import length, round_up
from survey.errors import SurveyError
from survey.export.cell_fit import CellPoints, correlated_px2, fit_cells
from survey.export.loaded import LoadedRun
from survey.export.registry import ExportOptions, require_not_too_fine
from survey.files.toml_table import require_options
from survey.progress import current

# Side of a cell where none is asked for [px]: some ten points in each.
_DEFAULT_PX = 4.0
_POINTS_OF_BAND, _SQUARES_OF_BAND = 2_000_000, 8_000_000
_COLUMNS = ("points_crs", "std", "depth", "incidence", "std_common", "std_placed")
# Side of a square [px]: about one point in each.
_SQUARE_PX = 1.25
# Steeper than this is a wall [-].
_STEEPEST = 3.0
# Uncertainty of the position of a wall, in squares to either side.
_WALL_SQUARES = 2
# A point counts as a roof lowered by so many of its standard deviations: uncertain ones are none.
_STD_OF_ROOF = 2.0
# Squares around a band whose points decide which of its own are seen from above.
MARGIN_SQUARES = _WALL_SQUARES + 1
# Largest raster: more cells result from a mistaken resolution, or from stray points far away.
_MOST_CELLS = 4_000_000_000
# Steps of resolutions that are chosen, times a power of ten.
_ROUND = (1.0, 2.0, 2.5, 5.0, 10.0)
# Points for the fit of the level: a plane of the local frame is curved in crs by Earth and map projection.
_POINTS_OF_LEVEL = 20_000
_WINDOW = 512
# Known cells from which a gap cell is interpolated.
_NEIGHBOURS = 12
# Slope to assume where none is known [-].
_ANY_SLOPE = 1.0
# Origins of a height: the points of the cell, or interpolation between cells.
POINTS, FILLED = 1, 2


def cells_over(points_crs: np.ndarray, crs: CRS, side_m: float) -> Grid:
    """Aligned cells of a side [m] that cover points (N, 2 or more)."""
    grid = Grid.southward_aligned(points_crs, crs, side_m)
    rows, columns = grid.shape
    if rows * columns > _MOST_CELLS:
        raise SurveyError(
            f"a raster of {columns} x {rows} cells of {side_m:g} m is too large; give a larger --resolution, or "
            "[area] bounds without the strays that lie far off"
        )
    return grid


def round_side(side_m: float) -> float:
    """The next larger round length: 0.083 becomes 0.1."""
    return round_up(side_m, _ROUND)


@dataclass(frozen=True)
class BedRaster:
    """The bed as a raster; arrays (rows, columns), in files."""

    cells: Grid
    # float32 [m]: mean height of the bed over the cell, seen from above; undefined where `origin` is 0
    height: np.ndarray
    std: np.ndarray  # float32 [m]: standard deviation of that height by the errors of the cell
    # float32 [m]: standard deviation common to all heights, by water, lens and poses, where the run knows it
    common: np.ndarray
    count: np.ndarray  # uint32: points that the height is from; 0 where it was filled
    origin: np.ndarray  # uint8, of the height: `POINTS`, `FILLED`, or 0 where there is none
    incidence: np.ndarray  # float32 [rad]: mean angle in air at which its points were seen
    level: LevelFit | None  # Height of the water; None for a dry survey
    pixel_m: float  # [m]: what a pixel of the photographs covers

    def heights(self, window: Window) -> np.ndarray:
        """Heights (rows, columns) float64 [m] of a window, NaN where there is none."""
        at = window.slices
        return np.where(self.origin[at] > 0, self.height[at].astype(np.float64), np.nan)

    def stds(self, window: Window) -> np.ndarray:
        """Standard deviations (rows, columns) float64 [m] by all errors, NaN where there is no height."""
        at = window.slices
        return np.where(self.origin[at] > 0, np.hypot(self.std[at].astype(np.float64), self.common[at]), np.nan)

    def depths(self, window: Window) -> np.ndarray:
        """Depth under the water (rows, columns) float64 [m], negative above it; NaN without height or water."""
        if self.level is None:
            return np.full(window.shape, np.nan)
        return self.level(self.cells.middles(window)) - self.heights(window)

    @property
    def height_unit_m(self) -> float:
        return height_unit_m(self.cells.crs)


@dataclass(frozen=True)
class LevelFit:
    """Quadratic function of plan, fitted to the water level over the points of a cloud."""

    # middle, extent: (2,) in crs: mean of the points, and their extent along each axis
    middle: np.ndarray
    extent: np.ndarray
    coefficients: np.ndarray  # (6,) [m]: of 1, x, y, x x, x y, y y, with x and y from the middle in extents

    @staticmethod
    def of(points: np.ndarray, depth: np.ndarray) -> LevelFit | None:
        """Fit to the level over points (N, 3), heights in metres, of depths (N,) [m]; None without depths."""
        known = np.flatnonzero(np.isfinite(depth))
        if not len(known):
            return None
        some = known[:: len(known) // _POINTS_OF_LEVEL + 1]
        plan, level = points[some, :2], points[some, 2] + depth[some]
        middle, extent = plan.mean(axis=0), np.maximum(np.ptp(plan, axis=0), 1e-9)
        base = float(level.mean())
        coefficients, *_ = np.linalg.lstsq(_terms((plan - middle) / extent), level - base, rcond=1e-9)
        coefficients[0] += base
        return LevelFit(middle, extent, coefficients)

    def __call__(self, plan: np.ndarray) -> np.ndarray:
        """Height of the water [m] (...) at places (..., 2) in crs."""
        return _terms((plan - self.middle) / self.extent) @ self.coefficients


def _terms(plan: np.ndarray) -> np.ndarray:
    """Monomials (..., 6) up to the second degree of places (..., 2)."""
    x, y = plan[..., 0], plan[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def bed_raster(run: LoadedRun, options: ExportOptions) -> BedRaster:
    """The raster of the bed of a run, made once for the products of a command."""
    require_options(options)
    key = ("bed raster", options.crs, options.resolution_m, options.fill_m)
    return run.once(key, lambda: _bed_raster(run, options))


def _bed_raster(run: LoadedRun, options: ExportOptions) -> BedRaster:
    pixel = run.bed_header.gsd_m
    if options.resolution_m is not None:
        require_not_too_fine(options.resolution_m, pixel)
    columns = _with_std(run.columns(*_COLUMNS))
    points, crs = run.in_crs(columns["points_crs"], options.crs), run.crs_for(options.crs)
    cells = cells_over(points, crs, options.resolution_m or round_side(_DEFAULT_PX * pixel))
    points[:, 2] *= height_unit_m(crs)
    kinds = {"height": "f4", "std": "f4", "common": "f4", "count": "u4", "origin": "u1", "incidence": "f4"}
    place = run.scratch / f"cells-{len(list(run.scratch.iterdir()))}"
    place.mkdir()
    arrays = {name: scratch_array(place / name, kind, cells.shape) for name, kind in kinds.items()}
    grid = BedRaster(cells=cells, level=LevelFit.of(points, columns["depth"]), pixel_m=pixel, **arrays)
    common = columns.get("std_common", np.full(len(points), np.nan, dtype=np.float32))
    common = np.where(np.isfinite(common), common, np.float32(run.common_std_m))
    placed = columns.get("std_placed", np.zeros(len(points), dtype=np.float32))
    std = np.sqrt(np.maximum(columns["std"] ** 2 - placed**2, 0.0))
    # Points on the outer edge lie in the last cell.
    at = cells.columns_rows(points).clip(0.0, np.nextafter(np.array(cells.shape[::-1], dtype=np.float64), 0.0))
    incidence, height = columns["incidence"], points[:, 2]
    _fill_in(grid, {"at": at, "height": height, "std": std, "placed": placed, "common": common, "incidence": incidence})
    if not grid.origin.any():
        east_m, north_m = np.ptp(points[:, :2], axis=0) / ground_units_m(crs, points[:, :2].mean(axis=0))
        raise SurveyError(
            f"--resolution {cells.side_m:g} (metres): points cover no cell of that side well enough for a height; the "
            f"cloud extends over {east_m:.1f} x {north_m:.1f} m, a pixel covers {length(pixel)}; give e.g. "
            f"--resolution {round_side(_DEFAULT_PX * pixel):g}"
        )
    if options.fill_m > 0.0:
        fill_gaps(grid, options.fill_m)
    return grid


def _with_std(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns of the points whose standard deviation is known; a warning counts the others."""
    known = np.isfinite(columns["std"])
    if known.all():
        return columns
    if not known.any():
        raise SurveyError(f"none of the {len(known)} points has a standard deviation, which cells of a raster need")
    current().warn(
        f"{int((~known).sum())} of {len(known)} points have no standard deviation and are left out of rasters"
    )
    return {name: column[known] for name, column in columns.items()}


def _fill_in(grid: BedRaster, points: dict[str, np.ndarray]) -> None:
    """Fit the cells, in bands of rows, to columns of points: places in cells (N, 2), the others (N,).

    ``std`` is without ``placed`` (`survey.run.stored.StoredBed.std_placed`), which neighbours share.
    """
    at, side_m, (rows, columns) = points["at"], grid.cells.side_m, grid.cells.shape
    correlated = correlated_px2(at * side_m, points["height"], points["std"], grid.pixel_m)
    square = _SQUARE_PX * grid.pixel_m / side_m
    margin = MARGIN_SQUARES * square
    most = min(_POINTS_OF_BAND * rows / len(at), _SQUARES_OF_BAND * square**2 / columns)
    band = max(int(most), math.ceil(margin))
    order = np.argsort(at[:, 1], kind="stable")
    along = at[order, 1]
    for low in range(0, rows, band):
        first, last = np.searchsorted(along, (low - margin, low + band + margin))
        near = np.sort(order[first:last])
        if len(near):
            _fit_band(grid, (low, low + band), correlated, {name: column[near] for name, column in points.items()})


def _fit_band(grid: BedRaster, ends: tuple[int, int], correlated: float, points: dict[str, np.ndarray]) -> None:
    """Fit the cells of some rows to the points in them; those beside them only decide which ones are covered."""
    cells, at, height, std = grid.cells, points["at"], points["height"], points["std"]
    is_seen, wall_std = seen_from_above(at * cells.side_m, height, std, grid.pixel_m)
    own = is_seen & (at[:, 1] >= ends[0]) & (at[:, 1] < ends[1])
    if not own.any():
        return
    cell = np.floor(at[own]).astype(np.int64)
    offset = (at[own] - cell - 0.5) * np.array([1.0, -1.0])
    number = cell[:, 1] * cells.shape[1] + cell[:, 0]
    in_cells = CellPoints(number, offset, height[own], std[own])
    fits = fit_cells(in_cells, side=cells.side_m, pixel=grid.pixel_m, correlated=correlated)
    is_fitted = np.isin(number, fits.cell)
    own[own] = is_fitted
    inverse = np.searchsorted(fits.cell, number[is_fitted])

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(inverse, values[own].astype(np.float64), len(fits.cell)) / fits.count

    # The position of a wall is one error of all points beside it, the bending of the block one of all points here.
    variance = fits.std**2 + mean(np.square(wall_std)) + mean(np.square(points["placed"]))
    place = np.divmod(fits.cell, cells.shape[1])
    grid.height[place], grid.std[place], grid.count[place] = fits.height, np.sqrt(variance), fits.count
    grid.common[place] = np.sqrt(mean(np.square(points["common"].astype(np.float64))))
    grid.incidence[place], grid.origin[place] = mean(points["incidence"]), POINTS


def seen_from_above(
    plan: np.ndarray, height: np.ndarray, std: np.ndarray, pixel: float
) -> tuple[np.ndarray, np.ndarray]:
    """Topmost points, and their uncertainty beside walls.

    Of points in plan (N, 2) [m] with heights and std (N,) [m], for a pixel on the ground [m]: whether each is seen
    (N,), and the standard deviation (N,) [m] of its height by the position of walls, 0 away from them.
    """
    square = _SQUARE_PX * pixel
    # Counted from the origin of the plan, so that bands have the same squares.
    at = np.floor(plan / square).astype(np.int64)
    at += MARGIN_SQUARES - at.min(axis=0)
    shape = at.max(axis=0) + 1 + MARGIN_SQUARES
    number = at[:, 0] * shape[1] + at[:, 1]
    top = np.full(shape.prod(), -np.inf)
    np.maximum.at(top, number, height - _STD_OF_ROOF * std)
    top = top.reshape(shape)
    roof = ndimage.grey_erosion(ndimage.grey_dilation(top, size=(3, 3)), size=(3, 3))
    allowed = _STEEPEST * square + _STD_OF_ROOF * std
    is_seen = height >= roof.ravel()[number] - allowed
    across = 2 * _WALL_SQUARES + 1
    lowest = ndimage.grey_erosion(np.where(np.isfinite(top), top, np.inf), size=(across, across))
    with np.errstate(invalid="ignore"):
        drop = np.nan_to_num(roof - lowest, nan=0.0, posinf=0.0, neginf=0.0) - _STEEPEST * _WALL_SQUARES * square
    # Anywhere between the top and the bottom of the wall.
    return is_seen, np.maximum(drop, 0.0).ravel()[number] / math.sqrt(3.0)


def fill_gaps(grid: BedRaster, width_m: float) -> None:
    """Fill the gaps of a raster up to a width [m], in place."""
    cells = grid.cells
    width = int(width_m / cells.side_m + 1e-6)
    if width < 1:
        return
    found = []
    for window in cells.windows(_WINDOW):
        around = window.grown(2 * width + 2, cells.shape)
        known = grid.origin[around.slices] == POINTS
        closed = _closed(known, width)
        inner = np.zeros_like(known)
        inner[window.within(around)] = True
        gaps = np.argwhere(closed & ~known & inner)
        if len(gaps):
            corner = np.array([around.top, around.left])
            found.append((tuple((gaps + corner).T), _interpolated(grid, known, around, gaps)))
    # All are interpolated from measured cells before any is set.
    for place, values in found:
        grid.height[place], grid.std[place], grid.common[place], grid.incidence[place] = values
        grid.origin[place] = FILLED


def _closed(known: np.ndarray, width: int) -> np.ndarray:
    """Morphological closing: known cells, and those in whose gap no square of more than ``width`` cells fits."""
    # Beyond the raster nothing is known, so that gaps continue there.
    gap = np.pad(~known, width + 1, constant_values=True)
    # Separable, so that wide gaps cost no more than narrow ones.
    opened = ndimage.grey_opening(gap.astype(np.uint8), size=width + 1, mode="constant", cval=0)
    return (opened == 0)[width + 1 : -width - 1, width + 1 : -width - 1]


def _interpolated(grid: BedRaster, known: np.ndarray, around: Window, gaps: np.ndarray) -> np.ndarray:
    """Height, both standard deviations [m] and incidence [rad] (4, K) of cells (K, 2), by inverse-distance weights."""
    layers = (grid.height, grid.std, grid.common, grid.incidence)
    height, std, common, incidence = (layer[around.slices].astype(np.float64) for layer in layers)
    places = np.argwhere(known)
    count = min(_NEIGHBOURS, len(places))
    distance, near = cKDTree(places).query(gaps, k=count)
    distance, near = distance.reshape(len(gaps), count), near.reshape(len(gaps), count)
    weight = 1.0 / distance**2
    weight /= weight.sum(axis=1, keepdims=True)
    of = tuple(places[near].transpose(2, 0, 1))
    # By the root mean square slope between neighbouring known cells.
    shown = np.where(known, height, np.nan)
    steps = np.concatenate([np.diff(shown, axis=axis).ravel() for axis in (0, 1)]) / grid.cells.side_m
    steps = steps[np.isfinite(steps)]
    slope = float(np.sqrt(2.0 * np.square(steps).mean())) if len(steps) else _ANY_SLOPE
    step = distance[:, 0] * grid.cells.side_m * slope

    def mean(values: np.ndarray) -> np.ndarray:
        return (weight * values[of]).sum(axis=1)

    return np.stack([mean(height), np.sqrt(mean(std**2) + step**2), np.sqrt(mean(common**2)), mean(incidence)])
