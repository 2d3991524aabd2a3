"""Gridding of the points of a run: the raster of the bed, from which all raster products are made.

Cells are worked on in tiles of about two million points; the rasters lie in files, so that they may be larger than the
memory.

A terrain model has one height per place, the highest. Points are binned into squares of about a pixel. A point well
below the highest ones of its own and the neighbouring squares is under a roof (a hull, a deck) or on a wall, which
covers no area in plan; it is left out. The position of a wall is uncertain by a pixel or two, so that a point beside it
may be wrong by the whole drop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from pyproj import CRS
from scipy import ndimage

from geo.crs import height_unit_m
from geo.files import scratch_array
from geo.projection import ground_units_m
from survey.display.quantities import length
from survey.errors import SurveyError
from survey.export.bed_cells import POINTS, BedRaster, LevelFit, cells_over, fill_gaps, round_side
from survey.export.cell_fit import CellPoints, correlated_px2, fit_cells
from survey.export.product import require_not_too_fine
from survey.files.toml_table import require_options
from survey.progress import current

if TYPE_CHECKING:
    from survey.export.loaded import LoadedRun
    from survey.export.product import ExportOptions

# Side of a cell where none is asked for [px]: some ten points in each.
_DEFAULT_PX = 4.0
_POINTS_PER_TILE = 2_000_000
_LARGEST_TILE = 2048
_COLUMNS = ("points_crs", "std", "depth", "incidence", "std_common", "std_placed")
# Side of a square [px]: about one point in each.
_SQUARE_PX = 1.25
# Steeper than this is a wall [-].
_STEEPEST = 3.0
# Uncertainty of the position of a wall, in squares to either side.
_WALL_SQUARES = 2
# A point counts as a roof lowered by so many of its standard deviations: uncertain ones are none.
_STD_OF_ROOF = 2.0
# Squares around a tile whose points decide which of its own are seen from above.
MARGIN_SQUARES = _WALL_SQUARES + 1


@dataclass(frozen=True)
class _Points:
    """Columns of the points of a run, N of each."""

    at: np.ndarray  # (N, 2): places in plan, in cells
    # height, std, placed, common, incidence (N,): the standard deviation is without ``placed``
    # (`survey.run.stored.StoredBed.std_placed`), which neighbours share
    height: np.ndarray
    std: np.ndarray
    placed: np.ndarray
    common: np.ndarray
    incidence: np.ndarray

    def __len__(self) -> int:
        return len(self.height)

    def __getitem__(self, rows: np.ndarray) -> _Points:
        return _Points(*(getattr(self, column.name)[rows] for column in fields(self)))


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
    points, crs = columns["points_crs"], run.bed_header.crs
    if options.crs is not None:
        reprojection = run.transformation_to(options.crs)
        points, crs = reprojection(points), reprojection.crs
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
    _fill_in(grid, _Points(at, points[:, 2], std, placed, common, columns["incidence"]))
    if not grid.origin.any():
        raise SurveyError(too_coarse(grid.cells.side_m, points, crs, pixel))
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


def too_coarse(side_m: float, points_crs: np.ndarray, crs: CRS, pixel_m: float) -> str:
    """The message for cells of a side [m] of which points cover none well enough for a height."""
    extent = np.ptp(points_crs[:, :2], axis=0) / ground_units_m(crs, points_crs[:, :2].mean(axis=0))
    return (
        f"--resolution {side_m:g} (metres): points cover no cell of that side well enough for a height; the cloud "
        f"extends over {extent[0]:.1f} x {extent[1]:.1f} m, a pixel covers {length(pixel_m)}; give e.g. --resolution "
        f"{round_side(_DEFAULT_PX * pixel_m):g}"
    )


def _fill_in(grid: BedRaster, points: _Points) -> None:
    """Fit the cells, tile by tile."""
    cells, at = grid.cells, points.at
    margin = MARGIN_SQUARES * _SQUARE_PX * grid.pixel_m / cells.side_m
    # Of about `_POINTS_PER_TILE` points, and at least the cells of the margin.
    per_cell = len(points) / (cells.shape[0] * cells.shape[1])
    side = max(min(int(math.sqrt(_POINTS_PER_TILE / per_cell)), _LARGEST_TILE), math.ceil(margin))
    tiles = np.floor(at / side).astype(np.int32)
    across = -(-cells.shape[1] // side)
    number = tiles[:, 1] * across + tiles[:, 0]
    correlated = correlated_px2(at * cells.side_m, points.height, points.std, grid.pixel_m)
    order = np.argsort(number, kind="stable")
    first = np.searchsorted(number[order], np.arange(across * -(-cells.shape[0] // side) + 1))
    for tile in np.unique(number):
        row, column = divmod(int(tile), across)
        near = [
            order[first[r * across + c] : first[r * across + c + 1]]
            for r in range(max(row - 1, 0), min(row + 2, -(-cells.shape[0] // side)))
            for c in range(max(column - 1, 0), min(column + 2, across))
        ]
        rows = np.concatenate(near)
        low = np.array([column, row]) * side
        rows = rows[((at[rows] >= low - margin) & (at[rows] < low + side + margin)).all(axis=1)]
        _fit_tile(grid, low, side, correlated, points[rows])


def _fit_tile(grid: BedRaster, low: np.ndarray, side: int, correlated: float, points: _Points) -> None:
    """Fit the cells of one tile to the points in it; those of the margin only decide which ones are covered."""
    cells, at, height, std = grid.cells, points.at, points.height, points.std
    is_seen, wall_std = seen_from_above(at * cells.side_m, height, std, grid.pixel_m)
    own = is_seen & ((at >= low) & (at < low + side)).all(axis=1)
    if not own.any():
        return
    cell = np.floor(at[own]).astype(np.int64)
    offset = (at[own] - cell - 0.5) * np.array([1.0, -1.0])
    number = cell[:, 1] * cells.shape[1] + cell[:, 0]
    in_cells = CellPoints(number, offset, height[own], std[own])
    fits = fit_cells(in_cells, side=cells.side_m, pixel=grid.pixel_m, correlated=correlated)
    own[own] = np.isin(number, fits.cell)
    inverse = np.searchsorted(fits.cell, number[np.isin(number, fits.cell)])

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(inverse, values[own].astype(np.float64), len(fits.cell)) / fits.count

    # The position of a wall is one error of all points beside it, the bending of the block one of all points here.
    variance = fits.std**2 + mean(np.square(wall_std)) + mean(np.square(points.placed))
    place = np.divmod(fits.cell, cells.shape[1])
    grid.height[place], grid.std[place], grid.count[place] = fits.height, np.sqrt(variance), fits.count
    grid.common[place] = np.sqrt(mean(np.square(points.common.astype(np.float64))))
    grid.incidence[place], grid.origin[place] = mean(points.incidence), POINTS


def seen_from_above(
    plan: np.ndarray, height: np.ndarray, std: np.ndarray, pixel: float
) -> tuple[np.ndarray, np.ndarray]:
    """Topmost points, and their uncertainty beside walls.

    Of points in plan (N, 2) [m] with heights and std (N,) [m], for a pixel on the ground [m]: whether each is seen
    (N,), and the standard deviation (N,) [m] of its height by the position of walls, 0 away from them.
    """
    square = _SQUARE_PX * pixel
    # Counted from the origin of the plan, so that tiles have the same squares.
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
