"""Hydrographic rasters: the bed as BAG, and the IHO S-44 order of each cell."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from evaluation.standards import TVU, order_by_thu, order_by_tvu
from geo.grid import Window
from geo.projection import ground_units_m
from geo.raster import SOFTWARE, RasterBand, RasterForm
from geo.raster import write_bag as write_bag_file
from survey.errors import SurveyError
from survey.export.bed_raster import bed_raster
from survey.export.loaded import LoadedRun
from survey.export.product import ExportOptions
from survey.export.styles import of_heights, of_orders
from survey.export.terrain import noted_if_empty, parts_of, write_raster

# Fixed by the format.
_BAG_NODATA = 1_000_000.0
_BAG_MARK = b"made by bathynerf"
_NOT_TESTED = (
    "An order of IHO S-44 (Ed. 6.1.0) also asks for feature detection, bathymetric coverage and search, which are not "
    "tested here"
)


def check_bag(_path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Raise SurveyError where the CRS has no square cells in metres."""
    crs = run.crs_for(options.crs)
    if not crs.is_projected or any(axis.unit_name != "metre" for axis in crs.axis_info):
        raise SurveyError(f"--bag holds square cells and heights in metres, but the CRS is {crs.name}; give --crs")
    place = run.some_place if options.crs is None else run.transformation_to(options.crs)(run.some_place)
    east, north = ground_units_m(crs, place[0, :2])
    if east != north:
        raise SurveyError(
            f"--bag holds square cells, and {crs.name} stretches the ground unequally to the east and to the north; "
            "give --crs, e.g. the UTM zone"
        )


def write_bag(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Write the BAG."""
    grid = bed_raster(run, options)
    crs = grid.cells.crs

    def values(window: Window) -> np.ndarray:
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
        # The standard deviation of the product, all errors included, not that of the soundings in a cell.
        "VERTICAL_UNCERT_CODE": "productUncert",
        # Of ISO 19139: a title, and the date of its creation.
        "XML_IDENTIFICATION_CITATION": "<gmd:CI_Citation><gmd:title><gco:CharacterString>"
        f"{escape(run.bed_header.name)}</gco:CharacterString></gmd:title><gmd:date><gmd:CI_Date><gmd:date><gco:Date>"
        f"{datetime.now(UTC).date().isoformat()}</gco:Date></gmd:date><gmd:dateType><gmd:CI_DateTypeCode "
        'codeList="http://www.isotc211.org/2005/resources/Codelist/gmxCodelists.xml#CI_DateTypeCode" '
        'codeListValue="creation">creation</gmd:CI_DateTypeCode></gmd:dateType></gmd:CI_Date></gmd:date>'
        "</gmd:CI_Citation>",
    }
    write_bag_file(path, form, noted_if_empty(path, parts_of(grid, values), _BAG_NODATA), tags)


def _index_of_water(run: LoadedRun) -> float:
    """The refractive index; raises SurveyError for a dry survey."""
    n_water = None if run.config.water is None else run.config.water.refractive_index
    if n_water is None or not np.isfinite(run.columns("depth")["depth"]).any():
        raise SurveyError("--s44 judges what lies under water, but the survey is dry; leave it out")
    return n_water


def check_s44(_path: Path, run: LoadedRun, _options: ExportOptions) -> None:
    """Raise SurveyError for a dry survey."""
    _index_of_water(run)


def write_s44(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Write the orders."""
    grid = bed_raster(run, options)
    n_water = _index_of_water(run)

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
    bands = (
        RasterBand("order by vertical and horizontal uncertainty", "code"),
        RasterBand("order by vertical uncertainty (TVU)", "code"),
        RasterBand("order by horizontal uncertainty (THU)", "code"),
    )
    write_raster(path, grid, values, *bands, tags=tags, dtype="uint8", nodata=0, resampling="NEAREST")


def plan_std(std: np.ndarray, sine: np.ndarray, pixel_m: float, shared_std: float | np.ndarray) -> np.ndarray:
    """Standard deviation (...) [m] along each axis in plan of points of standard deviations (...) [m] in height.

    By the error in height along the ray at the point, the ``sine`` (...) of whose angle to the vertical is given, half
    a pixel on the bed, and what poses, lens and water have shared in it.
    """
    tangent = sine / np.sqrt(1.0 - sine**2)
    return np.sqrt((tangent * std) ** 2 + (0.5 * pixel_m) ** 2 + shared_std**2)


style_bag, style_s44 = of_heights, of_orders
