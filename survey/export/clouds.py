"""The cloud as files of points: LAS, LAZ, COPC, PLY, and soundings.

Soundings are all points, the shoalest of each cell, or the mean, as XYZ or CSV. XYZ is easting, northing and height
alone, as GDAL's driver reads it. The first line of CSV names its columns, the last of which has the CRS in the first
row: programs take comments for rows.
"""

from pathlib import Path

import numpy as np
from pyproj import CRS

from evaluation.standards import TO_95, TO_95_IN_PLAN
from geo.crs import crs_code, is_geographic
from geo.files import write_whole
from geo.las import is_withheld
from survey.errors import SurveyError
from survey.export.bed_raster import BedRaster, bed_raster
from survey.export.loaded import LoadedRun
from survey.export.rasters import plan_std
from survey.export.registry import ExportOptions
from survey.export.styles import of_clouds
from survey.progress import current
from survey.run.products import write_bed_las, write_bed_ply
from survey.run.stored import StoredBed

# XYZ has the first three.
COLUMNS = ("easting", "northing", "height", "depth_m", "std_m", "std_common_m", "points")
_HEAD = ",".join((*COLUMNS, "crs"))
_DECIMALS, _DECIMALS_OF_DEGREES = 3, 9
_ROWS = 100_000


def write_las(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """LAS, or LAZ or COPC by the suffix."""
    stored, classes = run.classified_in(options.crs)
    if options.no_bed:
        # It takes the libraries of rasters and shapes.
        from survey.export.vectors import with_unseen

        stored, classes = with_unseen(run, stored, classes, options.crs)
    write_bed_las(path, stored, classes, total_uncertainty(run, stored) if options.tpu else None)


def total_uncertainty(run: LoadedRun, stored: StoredBed) -> tuple[np.ndarray, np.ndarray]:
    """Vertical and horizontal uncertainty of the points at 95 %, two of (N,) float32 [m], all parts included."""
    if stored.std_common is None or stored.std_plan is None:
        remedy = "export its run for --tpu" if run.is_field else "process the survey again for --tpu"
        raise SurveyError(f"the points of {run.points_path} have no standard deviation in plan; {remedy}")
    bed, water = stored.bed, run.config.water
    sine = np.sin(bed.incidence)
    if water is not None and water.refractive_index is not None:
        sine = np.where(bed.wet, sine / water.refractive_index, sine)
    vertical = TO_95 * np.hypot(bed.std, stored.std_common)
    horizontal = TO_95_IN_PLAN * plan_std(bed.std, sine, stored.gsd_m, stored.std_plan)
    return vertical.astype(np.float32), horizontal.astype(np.float32)


write_laz = write_copc = write_las
style_copc = of_clouds


def write_ply(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """PLY."""
    write_bed_ply(path, run.bed_in(options.crs))


def check_soundings(_path: Path, _run: LoadedRun, options: ExportOptions) -> None:
    """Raise SurveyError where there is no thinning for a resolution."""
    if options.thin == "none" and options.resolution_m is not None:
        raise SurveyError("--resolution is the cell of which a sounding is kept; give --thin shoal or --thin mean too")


def write_soundings(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """XYZ or CSV, by the suffix."""
    if options.thin == "none":
        rows = _of_points(run, options)
    else:
        grid = bed_raster(run, options)
        rows = _means(grid) if options.thin == "mean" else _shoalest(run, options, grid)
    _write_table(path, rows, run.crs_for(options.crs))


def _of_points(run: LoadedRun, options: ExportOptions) -> np.ndarray:
    """All points (N, 7) that LAS does not flag as withheld, see `COLUMNS`."""
    stored = run.bed_in(options.crs, certain=True)
    n = len(stored.points_crs)
    common = np.full(n, np.nan) if stored.std_common is None else stored.std_common
    return np.column_stack([stored.points_crs, stored.bed.depth, stored.bed.std, common, np.ones(n)])


def _shoalest(run: LoadedRun, options: ExportOptions, grid: BedRaster) -> np.ndarray:
    """The highest point of each cell, with the number of points there; a warning where a withheld one is higher."""
    rows = _of_points(run, options)
    cell = np.ravel_multi_index(grid.cells.index(rows), grid.cells.shape)
    order = np.lexsort([-rows[:, 2], cell])
    cells, first, counts = np.unique(cell[order], return_index=True, return_counts=True)
    kept = rows[order[first]].copy()
    kept[:, -1] = counts
    withheld = run.bed_in(options.crs).points_crs[is_withheld(run.bed.bed.std)]
    if len(withheld):
        top = np.full(grid.cells.shape, -np.inf).ravel()
        top[cells] = kept[:, 2]
        of_withheld = np.ravel_multi_index(grid.cells.index(withheld), grid.cells.shape)
        over = of_withheld[withheld[:, 2] > top[of_withheld]]
        current().warn(f"{len(np.unique(over))} cells have a withheld point higher than their sounding, or no other")
    return kept


def _means(grid: BedRaster) -> np.ndarray:
    """The mean height of each cell, at its middle."""
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
    places = _DECIMALS_OF_DEGREES if is_geographic(crs) else _DECIMALS
    digits = (places, places, *(_DECIMALS,) * 4, 0)
    if path.suffix.lower() == ".xyz":
        form, head, first_end = " ".join(f"%.{number}f" for number in digits[:3]), "", ""
    else:
        form, head = ",".join(f"%.{number}f" for number in digits) + ",", f"{_HEAD}\n"
        first_end = crs_code(crs) or '"' + crs.to_wkt().replace('"', '""') + '"'
    with write_whole(path) as stream:
        stream.write(head.encode())
        for first in range(0, len(rows), _ROWS):
            some = rows[first : first + _ROWS, : form.count("%")]
            # What is not known is empty.
            lines = (form % tuple(row) for row in some.tolist())
            text = "\n".join(line.replace("nan", "") + ("" if first + n else first_end) for n, line in enumerate(lines))
            stream.write(f"{text}\n".encode())
