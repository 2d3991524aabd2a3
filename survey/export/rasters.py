"""Rasters of the bed: heights with their uncertainty (DEM, BAG), orders of IHO S-44, surfaces of the water."""

import math
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from evaluation.standards import TVU, order_by_thu, order_by_tvu
from geo.files import reporting_disk_errors
from geo.grid import Window
from geo.projection import ground_units_m
from geo.raster import SOFTWARE, Part, RasterBand, RasterForm, write_cog
from geo.raster import write_bag as write_bag_file
from survey.errors import SurveyError
from survey.export.bed_raster import BedRaster, bed_raster
from survey.export.loaded import LoadedRun
from survey.export.registry import ExportOptions
from survey.export.styles import of_heights, of_orders
from survey.files.json_values import read_json_object
from survey.progress import current
from survey.run.stage_solver import WAVES, load_surfaces
from survey.water.wave_surfaces import WaveSurfaces

NODATA = -9999.0
_BLOCK = 512
# Fixed by the format.
_BAG_NODATA = 1_000_000.0
_UNCERTAINTY = (
    "band 2: of the mean height of the cell, by matching, relief between the points, and position of walls; band 3: "
    "common to all heights, by water, lens and poses, where the run knows it; total: root of the sum of both squares"
)
_NOT_TESTED = (
    "An order of IHO S-44 (Ed. 6.1.0) also asks for feature detection, bathymetric coverage and search, which are not "
    "tested here"
)
_TAGS_OF_WAVES = {
    "HEIGHT": "of the surface of the water over its level at the moment of the photograph, which is a plane",
    "EXTENT": "where rays from the photograph to points of the bed cross the water",
}


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
    write_cog(path, made, noted_if_empty(path, _parts(grid, values), made.nodata))


def _parts(grid: BedRaster, values: Callable[[Window], np.ndarray]) -> Iterator[Part]:
    """Windows of a raster with their values (bands, rows, columns), in float32 with NaN as `NODATA`."""
    for window in grid.cells.windows(_BLOCK):
        layers = values(window)
        if layers.dtype.kind == "f":
            layers = np.where(np.isfinite(layers), layers, NODATA).astype(np.float32)
        yield window.top, window.left, layers


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

    def values(window: Window) -> np.ndarray:
        at = window.slices
        known = grid.origin[at] > 0
        std, common = (np.where(known, layer[at], np.nan) for layer in (grid.std, grid.common))
        height = grid.heights(window) / grid.height_unit_m
        return np.stack([height, std, common, grid.count[at], grid.depths(window), grid.origin[at]])

    bands = (
        RasterBand("height", grid.cells.crs.axis_info[2].unit_name),
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


def check_bag(_path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Raise SurveyError where the CRS has no square cells in metres."""
    crs = run.crs_for(options.crs)
    if not crs.is_projected or any(axis.unit_name != "metre" for axis in crs.axis_info):
        raise SurveyError(f"--bag holds square cells and heights in metres, but the CRS is {crs.name}; give --crs")
    east, north = ground_units_m(crs, run.some_place_in(options.crs)[0, :2])
    if east != north:
        raise SurveyError(
            f"--bag holds square cells, and {crs.name} stretches the ground unequally to the east and to the north; "
            "give --crs, e.g. the UTM zone"
        )


def write_bag(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """The BAG."""
    grid = bed_raster(run, options)

    def values(window: Window) -> np.ndarray:
        layers = np.stack([grid.heights(window), grid.stds(window)])
        return np.nan_to_num(layers, nan=_BAG_NODATA).astype(np.float32)

    cells, name = grid.cells, run.bed_header.name
    bands = (RasterBand("elevation", "metre"), RasterBand("uncertainty", "metre"))
    form = RasterForm(cells.crs, cells.transform, cells.shape, bands, nodata=_BAG_NODATA)
    filled = f"; gaps up to {options.fill_m:g} m are interpolated" if options.fill_m else ""
    tags = {
        "ABSTRACT": f"{name}: bed of shallow water from photographs, made by bathynerf. Elevation [m]: mean of the bed "
        f"over a cell around the node{filled}. Uncertainty [m]: one standard deviation; at 95 % 1.96 times that.",
        "PROCESS_STEP_DESCRIPTION": f"{SOFTWARE}: a least-squares plane through the topmost points of each cell",
        # The standard deviation of the product, all errors included, not that of the soundings in a cell.
        "VERTICAL_UNCERT_CODE": "productUncert",
        # Of ISO 19139: a title, and the date of its creation.
        "XML_IDENTIFICATION_CITATION": "<gmd:CI_Citation><gmd:title><gco:CharacterString>"
        f"{escape(name)}</gco:CharacterString></gmd:title><gmd:date><gmd:CI_Date><gmd:date><gco:Date>"
        f"{datetime.now(UTC).date().isoformat()}</gco:Date></gmd:date><gmd:dateType><gmd:CI_DateTypeCode "
        'codeList="http://www.isotc211.org/2005/resources/Codelist/gmxCodelists.xml#CI_DateTypeCode" '
        'codeListValue="creation">creation</gmd:CI_DateTypeCode></gmd:dateType></gmd:CI_Date></gmd:date>'
        "</gmd:CI_Citation>",
    }
    write_bag_file(path, form, noted_if_empty(path, _parts(grid, values), _BAG_NODATA), tags)


def check_s44(_path: Path, run: LoadedRun, _options: ExportOptions) -> float:
    """The index of the water; raises SurveyError for a dry survey."""
    n_water = None if run.config.water is None else run.config.water.refractive_index
    if n_water is None or run.is_dry:
        raise SurveyError("--s44 judges what lies under water, but the survey is dry; leave it out")
    return n_water


def write_s44(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """The orders."""
    grid, n_water = bed_raster(run, options), check_s44(path, run, options)

    def values(window: Window) -> np.ndarray:
        std, depth = grid.stds(window), grid.depths(window)
        vertical = order_by_tvu(std, depth)
        sine = np.sin(grid.incidence[window.slices].astype(np.float64)) / n_water
        horizontal = order_by_thu(plan_std(std, sine, grid.pixel_m, run.plan_std_m), depth)
        # The stricter order has the smaller number.
        return np.stack([np.maximum(vertical, horizontal), vertical, horizontal])

    codes = ", ".join(f"{number} {name}" for number, (name, _, _) in enumerate(TVU, start=1))
    exact = "positions of the cameras taken as exact" if run.plan_std_m == 0.0 else "positions of the cameras included"
    tags = {
        "ORDERS": f"IHO S-44 Ed. 6.1.0, table 1: {codes}, {len(TVU) + 1} none, 0 no data or not under water",
        "UNCERTAINTIES": f"stated ones at 95 %: 1.96 std of the height, 2.45 std of the place; {exact}",
        "NOT_TESTED": _NOT_TESTED,
    }
    kinds = ("vertical and horizontal uncertainty", "vertical uncertainty (TVU)", "horizontal uncertainty (THU)")
    bands = [RasterBand(f"order by {kind}", "code") for kind in kinds]
    write_raster(path, grid, values, *bands, tags=tags, dtype="uint8", nodata=0, resampling="NEAREST")


def plan_std(std: np.ndarray, sine: np.ndarray, pixel_m: float, shared_std: float | np.ndarray) -> np.ndarray:
    """Standard deviation (...) [m] along each axis in plan of points of standard deviations (...) [m] in height.

    By the error in height along the ray at the point, the ``sine`` (...) of whose angle to the vertical is given, half
    a pixel on the bed, and what poses, lens and water have shared in it.
    """
    tangent = sine / np.sqrt(1.0 - sine**2)
    return np.sqrt((tangent * std) ** 2 + (0.5 * pixel_m) ** 2 + shared_std**2)


def check_waves(_path: Path, run: LoadedRun, _options: ExportOptions) -> WaveSurfaces:
    """The surfaces of the water; raises SurveyError where the run has none."""
    why, what = f"the run {run.folder.path} has no surfaces of the water", "leave out --waves"
    if "solver" not in run.stages:
        raise SurveyError(f"{why}: it was made without the solver, which finds them; process with --quality standard")
    solver = run.folder.load_stage("solver")
    surfaces = load_surfaces(solver, run.flight)
    if surfaces is None:
        waves = read_json_object(solver / WAVES)
        if waves["sea"] is not None:
            raise SurveyError(f"{why} of whole photographs: it was solved in tiles, each with its own; {what}")
        moved = f"waves shift its photographs by {waves['moved_px']:.2f} px"
        raise SurveyError(f"{why}: it was taken as still ({moved}); {what}")
    return surfaces


def write_waves(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """The surface of the water in each photograph that shows some, a raster for each."""
    band = RasterBand("height of the water over its level", "metre")
    for surface in check_waves(path, run, options).over(run.bed.bed.xyz):
        file, grid = path / f"{surface.name}.tif", surface.grid
        with reporting_disk_errors(file):
            file.parent.mkdir(parents=True, exist_ok=True)
        form = RasterForm(grid.crs, grid.transform, grid.shape, (band,), nodata=math.nan, tags=_TAGS_OF_WAVES)
        write_cog(file, form, [(0, 0, surface.height[None])])


style_dem = style_bag = of_heights
style_s44 = of_orders
