"""The bed as a raster of heights with their uncertainty (DEM), and how rasters of the bed are written."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from geo.grid import Window
from geo.raster import Part, RasterBand, RasterForm, write_cog
from survey.export.bed_cells import BedRaster
from survey.export.bed_raster import bed_raster
from survey.export.loaded import LoadedRun
from survey.export.product import ExportOptions
from survey.export.styles import of_heights
from survey.progress import current

NODATA = -9999.0
_BLOCK = 512
_UNCERTAINTY = (
    "band 2: of the mean height of the cell, by matching, relief between the points, and position of walls; band 3: "
    "common to all heights, by water, lens and poses, where the run knows it; total: root of the sum of both squares"
)


def write_raster(
    path: Path,
    grid: BedRaster,
    values: Callable[[Window], np.ndarray],
    *bands: RasterBand,
    tags: dict[str, str],
    **form,
) -> None:
    """Write a raster of the bed as GeoTIFF, window by window, and a note where no cell has a value in the first band.

    ``tags`` are those of the product, ``form`` further fields of `RasterForm`.
    """
    tags = {
        "CELL_M": f"{grid.cells.side_m:g}",
        "HEIGHT": "mean of the bed over each cell, seen from above: a plane by least squares through its points",
        **tags,
    }
    form = {"nodata": NODATA, **form}
    made = RasterForm(grid.cells.crs, grid.cells.transform, grid.cells.shape, bands, tags=tags, **form)
    write_cog(path, made, noted_if_empty(path, parts_of(grid, values), made.nodata))


def parts_of(grid: BedRaster, values: Callable[[Window], np.ndarray]) -> Iterator[tuple[int, int, np.ndarray]]:
    """Windows of a raster with their values (bands, rows, columns), in float32 with NaN as `NODATA`."""
    for window in grid.cells.windows(_BLOCK):
        found = values(window)
        if found.dtype.kind == "f":
            found = np.where(np.isfinite(found), found, NODATA).astype(np.float32)
        yield window.top, window.left, found


def noted_if_empty(path: Path, parts: Iterable[Part], no_value: float | None, band: int = 0) -> Iterator[Part]:
    """The parts of a raster, and a note behind the last one where no cell has another value in a band."""
    num_known = 0
    for part in parts:
        num_known += int((part[2][band] != no_value).sum())
        yield part
    if not num_known:
        current().note(f"{path}: nothing to show, no cell has a value; try another --resolution")


def write_dem(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """The terrain model: heights, their uncertainty, and what they are from."""
    grid = bed_raster(run, options)
    unit = grid.cells.crs.axis_info[2].unit_name

    def values(window: Window) -> np.ndarray:
        at = window.slices
        known = grid.origin[at] > 0
        std, common = (np.where(known, layer[at], np.nan) for layer in (grid.std, grid.common))
        height = grid.heights(window) / grid.height_unit_m
        return np.stack([height, std, common, grid.count[at], grid.depths(window), grid.origin[at]])

    bands = (
        RasterBand("height", unit),
        RasterBand("uncertainty, one standard deviation", "metre"),
        RasterBand("uncertainty that all heights share, one standard deviation", "metre"),
        RasterBand("points", "count"),
        RasterBand("depth below the water, negative above it", "metre"),
        RasterBand("origin of the height: 1 points, 2 filled, 0 none", "code"),
    )
    tags = {"FILLED_GAPS_M": f"{options.fill_m:g}", "UNCERTAINTY": _UNCERTAINTY}
    # A cell of an overview is one of the raster, whose height, uncertainty, points and origin belong together: a mean
    # of codes or of uncertainties would mean nothing.
    write_raster(path, grid, values, *bands, tags=tags, resampling="NEAREST")


style_dem = of_heights
