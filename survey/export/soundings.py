"""Soundings as a table for hydrographic programs: all points, or one for each cell, the shoalest or the mean."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from survey.errors import SurveyError
from survey.export.product import ExportOptions, Product, begins_with

if TYPE_CHECKING:
    import numpy as np
    from pyproj import CRS

    from survey.export.bed_cells import Gridded
    from survey.export.loaded import LoadedRun

THIN = ("none", "shoal", "mean")
_MARK = b"# bathynerf soundings"
# Of a table in CSV; XYZ has the first three, separated by blanks.
_COLUMNS = ("easting", "northing", "height", "depth_m", "std_m", "std_common_m", "points")
_DECIMALS, _DECIMALS_OF_DEGREES = 3, 9
_ROWS = 100_000


def _write(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Write the soundings.

    Raises
    ------
    SurveyError
        If the rule of thinning is not known, or nothing is to be thinned.
    """
    if options.thin not in THIN:
        raise SurveyError(f"--thin is {options.thin}, expected one of {', '.join(THIN)}")
    if options.thin == "none" and options.resolution_m is not None:
        raise SurveyError("--resolution is the cell of which a sounding is kept; give --thin shoal or --thin mean too")
    stored = run.bed_in(options.crs)
    rows = _of_points(run, options)
    if options.thin != "none":
        from survey.export.gridded import gridded

        grid = gridded(run, options)
        rows = _means(grid) if options.thin == "mean" else _shoalest(rows, grid)
    _write_table(path, rows, stored.crs)


def _of_points(run: LoadedRun, options: ExportOptions) -> np.ndarray:
    """All points (N, 7), see `_COLUMNS`."""
    import numpy as np

    stored = run.bed_in(options.crs)
    n = len(stored.points_crs)
    common = np.full(n, np.nan) if stored.std_common is None else stored.std_common
    return np.column_stack([stored.points_crs, stored.bed.depth, stored.bed.std, common, np.ones(n)])


def _shoalest(rows: np.ndarray, grid: Gridded) -> np.ndarray:
    """The highest point of each cell, with the number of points there."""
    import numpy as np

    at = np.floor(grid.cells.place(rows)).astype(np.int64)
    cell = at[:, 1] * grid.cells.shape[1] + at[:, 0]
    order = np.lexsort([-rows[:, 2], cell])
    _, first, counts = np.unique(cell[order], return_index=True, return_counts=True)
    kept = rows[order[first]].copy()
    kept[:, -1] = counts
    return kept


def _means(grid: Gridded) -> np.ndarray:
    """The mean height of each cell, at its middle."""
    import numpy as np

    parts = []
    for window in grid.cells.windows(512):
        known = grid.known[window.slices] > 0
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
        write=_write,
    ),
)
