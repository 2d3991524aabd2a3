"""The bed from above, through the water, from the photographs themselves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from geo.crs import horizontal_crs
from geo.grid import Grid, Window
from geo.raster import RasterBand, RasterForm, write_cog
from survey.errors import SurveyError
from survey.export.bed_cells import BedRaster, cells_over, round_side
from survey.export.bed_raster import bed_raster
from survey.export.loaded import LoadedRun, at_scale, colours_without_water, flight_of
from survey.export.occlusion import (
    WINDOW,
    BedWindows,
    CellProjection,
    HeightBuffer,
    Mosaic,
    common_exposure,
    log_weight,
)
from survey.export.product import ExportOptions, require_not_too_fine
from survey.export.terrain import noted_if_empty
from survey.progress import current

ColourOf = Callable[[np.ndarray, Window, np.ndarray, CellProjection], np.ndarray]

# Along the shorter side of a photograph at the resolution that is asked for.
_FEWEST_PX = 8


def write_orthophoto(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """The mosaic of the photographs."""
    side_m = options.resolution_m or round_side(run.bed_header.gsd_m)
    mosaic = _mosaic(run, options, side_m)
    cells = mosaic.cells
    tags = {
        "COLOURS": "of the bed without its water" if run.is_true_colour else "as photographed, to a common exposure",
        "CELL_M": f"{side_m:g}",
    }
    bands = (RasterBand("red"), RasterBand("green"), RasterBand("blue"), RasterBand("seen"))
    crs = horizontal_crs(cells.crs)
    form = RasterForm(crs, cells.transform, cells.shape, bands, dtype="uint8", tags=tags, is_colour=True)
    parts = ((window.top, window.left, mosaic.rgba(window)) for window in cells.windows(WINDOW))
    write_cog(path, form, noted_if_empty(path, parts, 0, band=3))


def check_orthophoto(_path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Raise SurveyError where a photograph is not there any more."""
    flight_of(run, options.survey)


def _mosaic(run: LoadedRun, options: ExportOptions, side_m: float) -> Mosaic:
    """The photographs on the bed, in cells of a side [m]."""
    require_not_too_fine(side_m, run.bed_header.gsd_m)
    grid = bed_raster(run, replace(options, resolution_m=None))
    if side_m > grid.cells.side_m:
        # Heights need larger cells than colours do, but not larger ones than are asked for.
        grid = bed_raster(run, options)
    flight = flight_of(run, options.survey)
    scale = min(1.0, grid.pixel_m / side_m)
    shortest = scale * min(min(view.camera.width, view.camera.height) for view in flight.views)
    if shortest < _FEWEST_PX:
        raise SurveyError(
            f"--resolution {side_m:g} (metres) is too coarse: at that size a photograph has {shortest:.1f} pixels "
            f"along its shorter side, expected at least {_FEWEST_PX}; give e.g. --resolution "
            f"{round_side(run.bed_header.gsd_m):g}"
        )
    photographs = at_scale(flight, scale)
    cells = cells_over(grid.cells.box, grid.cells.crs, side_m)
    mosaic, colour_of = Mosaic.empty(cells, run.scratch), _colour_of(run, grid, cells)
    coarse = BedWindows(flight, grid.cells, grid.heights)
    fine = BedWindows(flight, cells, lambda window: _heights(grid, cells, window))
    with current().stage("Orthophoto", 2.0 * len(photographs)) as stage:
        cell_px = grid.cells.side_m / grid.pixel_m * scale
        buffers = [HeightBuffer.of(p.camera, coarse, cell_m=grid.cells.side_m, cell_px=cell_px) for p in photographs]
        factors = common_exposure(photographs, buffers, coarse, stage.advance)
        for photograph, buffer, factor in zip(photographs, buffers, factors, strict=True):
            pixels = photograph.pixels()
            for window, height, projection in fine.projected_into(photograph.camera):
                seen = buffer.visible(projection, height)
                colour = pixels.at(seen.u, seen.v) * factor
                weight = np.where(np.isfinite(colour[..., 0]), log_weight(seen, photograph.camera), np.nan)
                mosaic.add(window, weight, colour_of(colour, window, height, seen))
            stage.advance()
    return mosaic


def _heights(grid: BedRaster, cells: Grid, window: Window) -> np.ndarray:
    """Heights (rows, columns) [m] of finer cells, linear between those of the bed's raster; NaN where it has none."""
    at = grid.cells.columns_rows(cells.middles(window).reshape(-1, 2))
    shape = grid.cells.shape
    own = np.clip(np.floor(at).astype(np.int64), 0, np.array(shape[::-1]) - 1)
    first = np.floor(at - 0.5).astype(np.int64)
    share = at - 0.5 - first
    total, weight = np.zeros(len(at)), np.zeros(len(at))
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = np.clip(first + step, 0, np.array(shape[::-1]) - 1).T
        part = np.where(step, share, 1.0 - share).prod(axis=1) * (grid.origin[row, column] > 0)
        total, weight = total + part * grid.height[row, column], weight + part
    known = (grid.origin[own[:, 1], own[:, 0]] > 0) & (weight > 0.0)
    return np.where(known, total / np.where(weight > 0.0, weight, 1.0), np.nan).reshape(window.shape)


def _colour_of(run: LoadedRun, grid: BedRaster, cells: Grid) -> ColourOf:
    """Function of the colours of a photograph that gives those of the mosaic: the same, or without the water."""
    without_water, level = colours_without_water(run), grid.level
    if without_water is None or level is None:
        return lambda colour, _window, _height, _seen: colour

    def dry(colour: np.ndarray, window: Window, height: np.ndarray, seen: CellProjection) -> np.ndarray:
        depth = level(cells.middles(window)) - height
        wet = np.isfinite(colour[..., 0]) & (depth > 0.0)
        incidence = np.arccos(np.clip(seen.cos_incidence[wet], -1.0, 1.0))
        colour[wet] = without_water(colour[wet], depth[wet], incidence)
        return colour

    return dry
