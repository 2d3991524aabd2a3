"""Hydrographic products: the bed as BAG, the IHO S-44 order of each cell, and soundings as a table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from survey.errors import SurveyError
from survey.export.product import ExportOptions, Product, begins_with
from survey.export.styles import of_heights, of_orders
from survey.export.terrain import CELLS, is_our_raster, noted_if_empty, parts_of, raster_form

if TYPE_CHECKING:
    import numpy as np
    from pyproj import CRS

    from survey.export.bed_cells import BedRaster, CellWindow
    from survey.export.loaded import LoadedRun

# Fixed by the format.
_BAG_NODATA = 1_000_000.0
_BAG_MARK = b"made by bathynerf"
_NOT_TESTED = (
    "An order of IHO S-44 (Ed. 6.1.0) also asks for feature detection, bathymetric coverage and search, which are not "
    "tested here"
)
THIN = ("none", "shoal", "mean")
_MARK = b"# bathynerf soundings"
# Of a table in CSV; XYZ has the first three, separated by blanks.
_COLUMNS = ("easting", "northing", "height", "depth_m", "std_m", "std_common_m", "points")
_DECIMALS, _DECIMALS_OF_DEGREES = 3, 9
_ROWS = 100_000


def _write_bag(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Write the BAG."""
    import numpy as np

    from geo.raster import SOFTWARE, RasterBand, RasterForm, write_bag
    from survey.export.bed_raster import bed_raster

    grid = bed_raster(run, options)
    crs = grid.cells.crs
    if not crs.is_projected or any(axis.unit_name != "metre" for axis in crs.axis_info):
        raise SurveyError(f"--bag holds square cells and heights in metres, but the CRS is {crs.name}; give --crs")

    if grid.cells.side[0] != grid.cells.side[1]:
        raise SurveyError(
            f"--bag holds square cells, and {crs.name} stretches the ground unequally to the east and to the north; "
            "give --crs, e.g. the UTM zone"
        )

    def values(window: CellWindow) -> np.ndarray:
        height = grid.heights(window)
        return np.nan_to_num(np.stack([height, grid.stds(window)]), nan=_BAG_NODATA).astype(np.float32)

    cells = grid.cells
    bands = (RasterBand("elevation", "metre"), RasterBand("uncertainty", "metre"))
    form = RasterForm(crs, cells.transform, cells.shape, bands, nodata=_BAG_NODATA)
    filled = f"; gaps up to {options.fill_m:g} m are interpolated" if options.fill_m else ""
    tags = {
        "ABSTRACT": f"{run.bed_header.name}: bed of shallow water from photographs, {_BAG_MARK.decode()}. Elevation "
        f"[m]: mean of the bed over a cell around the node{filled}. Uncertainty [m]: one standard deviation; at "
        "95 % 1.96 times that.",
        "PROCESS_STEP_DESCRIPTION": f"{SOFTWARE}: a least-squares plane through the topmost points of each cell",
    }
    write_bag(path, form, noted_if_empty(path, parts_of(grid, values), _BAG_NODATA), tags)


def _write_s44(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Write the orders."""
    import numpy as np

    from evaluation.standards import TVU, order_by_thu, order_by_tvu
    from geo.raster import RasterBand, write_cog
    from survey.export.bed_raster import bed_raster

    grid = bed_raster(run, options)
    n_water = None if run.config.water is None else run.config.water.refractive_index
    if grid.level is None or n_water is None:
        raise SurveyError("--s44 judges what lies under water, but the survey is dry; leave it out")

    def values(window: CellWindow) -> np.ndarray:
        std, depth = grid.stds(window), grid.depths(window)
        vertical = order_by_tvu(std, depth)
        horizontal = order_by_thu(plan_std(grid, window, std, n_water, run.plan_std_m), depth)
        # The stricter order has the smaller number.
        return np.stack([np.maximum(vertical, horizontal), vertical, horizontal])

    codes = ", ".join(f"{number} {name}" for number, (name, _, _) in enumerate(TVU, start=1))
    exact = "positions of the cameras taken as exact" if run.plan_std_m == 0.0 else "positions of the cameras included"
    tags = {
        "ORDERS": f"IHO S-44 Ed. 6.1.0, table 1: {codes}, {len(TVU) + 1} none, 0 no data or not under water",
        "UNCERTAINTIES": f"stated ones at 95 %: 1.96 std of the height, 2.45 std of the place; {exact}",
        "NOT_TESTED": _NOT_TESTED,
    }
    bands = (
        RasterBand("order by vertical and horizontal uncertainty", "code"),
        RasterBand("order by vertical uncertainty (TVU)", "code"),
        RasterBand("order by horizontal uncertainty (THU)", "code"),
    )
    form = raster_form(grid, *bands, tags=tags, dtype="uint8", nodata=0, resampling="NEAREST")
    write_cog(path, form, noted_if_empty(path, parts_of(grid, values), 0))


def plan_std(grid: BedRaster, window: CellWindow, std: np.ndarray, n_water: float, cameras_std: float) -> np.ndarray:
    """Standard deviation (rows, columns) [m] along each axis in plan of the positions of the points of cells.

    By the error in height along the ray in water, half a pixel on the bed, and the positions of the cameras.
    """
    import numpy as np

    sine = np.sin(grid.incidence[window.slices].astype(np.float64)) / n_water
    tangent = sine / np.sqrt(1.0 - sine**2)
    return np.sqrt((tangent * std) ** 2 + (0.5 * grid.pixel_m) ** 2 + cameras_std**2)


HYDROGRAPHY = (
    Product(
        option="bag",
        suffixes=(".bag",),
        kind="a BAG that bathynerf wrote",
        help="Heights and uncertainty as BAG (HDF5).",
        example="--bag bed.bag --resolution 0.5",
        takes=CELLS,
        is_ours=begins_with(b"\x89HDF\r\n\x1a\n", _BAG_MARK),
        write=_write_bag,
        style=of_heights,
    ),
    Product(
        option="s44",
        suffixes=(".tif", ".tiff"),
        kind="a raster that bathynerf wrote",
        help="Order of IHO S-44 by uncertainty, as GeoTIFF.",
        example="--s44 orders.tif --resolution 1",
        takes=CELLS,
        is_ours=is_our_raster,
        write=_write_s44,
        style=of_orders,
    ),
)


def _write_soundings(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Write the soundings."""
    if options.thin not in THIN:
        raise SurveyError(f"--thin is {options.thin}, expected one of {', '.join(THIN)}")
    if options.thin == "none" and options.resolution_m is not None:
        raise SurveyError("--resolution is the cell of which a sounding is kept; give --thin shoal or --thin mean too")
    stored = run.bed_in(options.crs)
    rows = _of_points(run, options)
    if options.thin != "none":
        from survey.export.bed_raster import bed_raster

        grid = bed_raster(run, options)
        rows = _means(grid) if options.thin == "mean" else _shoalest(rows, grid)
    _write_table(path, rows, stored.crs)


def _of_points(run: LoadedRun, options: ExportOptions) -> np.ndarray:
    """All points (N, 7), see `_COLUMNS`."""
    import numpy as np

    stored = run.bed_in(options.crs)
    n = len(stored.points_crs)
    common = np.full(n, np.nan) if stored.std_common is None else stored.std_common
    return np.column_stack([stored.points_crs, stored.bed.depth, stored.bed.std, common, np.ones(n)])


def _shoalest(rows: np.ndarray, grid: BedRaster) -> np.ndarray:
    """The highest point of each cell, with the number of points there."""
    import numpy as np

    cell = grid.cells.numbers(rows)
    order = np.lexsort([-rows[:, 2], cell])
    _, first, counts = np.unique(cell[order], return_index=True, return_counts=True)
    kept = rows[order[first]].copy()
    kept[:, -1] = counts
    return kept


def _means(grid: BedRaster) -> np.ndarray:
    """The mean height of each cell, at its middle."""
    import numpy as np

    parts = []
    for window in grid.cells.windows(512):
        known = grid.origin[window.slices] > 0
        layers = (
            grid.heights(window) / grid.height_unit_m,
            grid.depths(window),
            grid.std[window.slices],
            grid.common[window.slices],
            grid.count[window.slices],
        )
        values = [layer[known].astype(np.float64) for layer in layers]
        parts.append(np.column_stack([grid.cells.middles(window)[known], *values]))
    return np.concatenate(parts)


def _write_table(path: Path, rows: np.ndarray, crs: CRS) -> None:
    from geo.crs import crs_code, is_geographic
    from geo.files import write_whole

    places = _DECIMALS_OF_DEGREES if is_geographic(crs) else _DECIMALS
    digits = (places, places, *(_DECIMALS,) * 4, 0)
    is_xyz = path.suffix.lower() == ".xyz"
    columns, separator = (_COLUMNS[:3], " ") if is_xyz else (_COLUMNS, ",")
    with write_whole(path) as stream:
        stream.write(_MARK + f"\n# CoordinateSystem: {crs_code(crs) or crs.to_wkt()}\n".encode())
        if not is_xyz:
            stream.write(f"{separator.join(columns)}\n".encode())
        form = separator.join(f"%.{number}f" for number in digits[: len(columns)])
        for first in range(0, len(rows), _ROWS):
            some = rows[first : first + _ROWS, : len(columns)]
            # What is not known is empty.
            text = "\n".join(form % tuple(row) for row in some.tolist()).replace("nan", "")
            stream.write(f"{text}\n".encode())


SOUNDINGS = (
    Product(
        option="soundings",
        suffixes=(".xyz", ".csv"),
        kind="soundings that bathynerf wrote",
        help="Points as XYZ or, with depth and standard deviations, CSV.",
        example="--soundings bed.xyz --thin shoal",
        takes=("crs", "resolution_m", "thin"),
        is_ours=begins_with(_MARK),
        write=_write_soundings,
    ),
)
