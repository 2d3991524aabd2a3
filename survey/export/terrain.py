"""The bed as rasters: heights with their uncertainty (DEM), slope, and hillshade."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from survey.export.product import ExportOptions, Product
from survey.export.styles import of_heights, of_slopes

if TYPE_CHECKING:
    import numpy as np

    from geo.raster import Part, RasterBand, RasterForm
    from survey.export.bed_cells import BedRaster, CellWindow
    from survey.export.loaded import LoadedRun

NODATA = -9999.0
CELLS = ("crs", "resolution_m", "fill_m")
_SUFFIXES = (".tif", ".tiff")
_BLOCK = 512
_UNCERTAINTY = (
    "band 2: of the mean height of the cell, by matching, relief between the points, and position of walls; band 3: "
    "common to all heights, by water, lens and poses, where the run knows it; total: root of the sum of both squares"
)


def raster_form(grid: BedRaster, *bands: RasterBand, tags: dict[str, str], **form) -> RasterForm:
    """Georeference, bands and tags of a raster of the bed; ``tags`` are those of the product."""
    from geo.raster import RasterForm

    tags = {
        "CELL_M": f"{grid.cells.side_m:g}",
        "HEIGHT": "mean of the bed over each cell, seen from above: a plane by least squares through its points",
        **tags,
    }
    form = {"nodata": NODATA, **form}
    return RasterForm(grid.cells.crs, grid.cells.transform, grid.cells.shape, bands, tags=tags, **form)


def parts_of(grid: BedRaster, values: Callable[[CellWindow], np.ndarray]) -> Iterator[tuple[int, int, np.ndarray]]:
    """Windows of a raster with their values (bands, rows, columns), in float32 with NaN as `NODATA`."""
    import numpy as np

    for window in grid.cells.windows(_BLOCK):
        found = values(window)
        if found.dtype.kind == "f":
            found = np.where(np.isfinite(found), found, NODATA).astype(np.float32)
        yield window.top, window.left, found


def noted_if_empty(path: Path, parts: Iterable[Part], no_value: float | None, band: int = 0) -> Iterator[Part]:
    """The parts of a raster, and a note behind the last one where no cell has another value in a band."""
    from survey.progress import current

    num_known = 0
    for part in parts:
        num_known += int((part[2][band] != no_value).sum())
        yield part
    if not num_known:
        current().note(f"{path}: nothing to show, no cell has a value; try another --resolution")


def _write_dem(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    import numpy as np

    from geo.raster import RasterBand, write_cog
    from survey.export.bed_raster import bed_raster

    grid = bed_raster(run, options)
    unit = grid.cells.crs.axis_info[2].unit_name

    def values(window: CellWindow) -> np.ndarray:
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
    parts = noted_if_empty(path, parts_of(grid, values), NODATA)
    write_cog(path, raster_form(grid, *bands, tags=tags, resampling="NEAREST"), parts)


def _write_slope(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    from geo.raster import RasterBand
    from survey.export.relief import slope_deg

    tags = {"SLOPE": "of central differences between neighbouring cells"}
    _write_relief(
        path, run, options, slope_deg, lambda grid: raster_form(grid, RasterBand("slope", "degree"), tags=tags)
    )


def _write_hillshade(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    from geo.raster import RasterBand
    from survey.export.relief import hillshade

    tags = {"HILLSHADE": "light from the north-west at 45 degrees, heights not exaggerated; 1 to 255"}

    def form(grid: BedRaster) -> RasterForm:
        return raster_form(grid, RasterBand("hillshade", "1 to 255"), tags=tags, dtype="uint8", nodata=0)

    _write_relief(path, run, options, hillshade, form)


def _write_relief(
    path: Path,
    run: LoadedRun,
    options: ExportOptions,
    of: Callable[[np.ndarray, float], np.ndarray],
    form: Callable[[BedRaster], RasterForm],
) -> None:
    """Write a raster of a function of the heights around each cell and the side of cells."""
    from geo.raster import write_cog
    from survey.export.bed_raster import bed_raster

    grid = bed_raster(run, options)

    def values(window: CellWindow) -> np.ndarray:
        around = window.grown(1, grid.cells.shape)
        return of(grid.heights(around), grid.cells.side_m)[window.within(around)][None]

    made = form(grid)
    write_cog(path, made, noted_if_empty(path, parts_of(grid, values), made.nodata))


TERRAIN = (
    Product(
        "dem",
        _SUFFIXES,
        help="Heights as GeoTIFF: height, uncertainty, points, depth, origin.",
        example="--dem bed.tif --resolution 0.1",
        takes=CELLS,
        write=_write_dem,
        style=of_heights,
    ),
    Product(
        "slope",
        _SUFFIXES,
        help="Slope of the bed as GeoTIFF [deg].",
        example="--slope slope.tif --resolution 0.5",
        takes=CELLS,
        write=_write_slope,
        style=of_slopes,
    ),
    Product(
        "hillshade",
        _SUFFIXES,
        help="Light on the relief as GeoTIFF.",
        example="--hillshade relief.tif --fill 0.5",
        takes=CELLS,
        write=_write_hillshade,
    ),
)
