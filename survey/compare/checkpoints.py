"""Check points: a table of surveyed places, and the height of a cloud over each (ASPRS, Edition 2)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyproj import CRS

from evaluation import asprs_vertical, height_at
from evaluation.standards import MIN_CHECKPOINTS
from geo.compatibility import require_same_crs, require_same_place
from geo.crs import height_unit_m
from geo.files import existing_file
from survey.compare.area import CompareError, to_local
from survey.compare.figures import Checkpoints
from survey.compare.measure import Scene
from survey.compare.tables import GIVE_LEVEL
from survey.display.words import named
from survey.files.column_units import Units
from survey.files.point_table import PLACE, read_points, require_exact, several_heights
from survey.files.text_crs import crs_of_comment


def read_checkpoints(
    path: Path, water_level: float | None = None, crs: CRS | None = None, units: Units | None = None
) -> np.ndarray:
    """Check points (K, 4) of a CSV: easting, northing, height in the CRS of the cloud, standard deviation [m].

    The last column may be missing (0 then). A first line names the columns, in any order; numbers alone have this
    order. Depths count from the level of the water, in the CRS of the cloud. See `survey.files.point_table`.

    Raises
    ------
    GeoError
        If the file does not exist, or names another CRS than that of the cloud.
    CompareError
        If a line has other columns, or no line is left.
    """
    existing_file(path)
    require_same_crs(crs, crs_of_comment(path, CompareError), "the cloud", str(path))
    rows = read_points(
        path,
        optional=("std",),
        by_place=True,
        level=water_level,
        give_level=GIVE_LEVEL,
        units=units,
        error=CompareError,
    )
    require_exact(rows, path, CompareError)
    table = np.array([[*(row.number(name) for name in PLACE), row.number("std", default=0.0)] for row in rows])
    if not rows:
        raise CompareError(f"{path} has no check points; expected lines of easting, northing, height, std")
    for row, sigma in zip(rows, table[:, 3], strict=True):
        if sigma < 0.0:
            raise CompareError(f"{row.where}: std is {sigma:g}, expected metres, not negative")
    return table


def checkpoint_accuracy(scene: Scene, table: np.ndarray, path: Path) -> tuple[Checkpoints, list[str]]:
    """Vertical accuracy of the compared cloud at check points (K, 4), and its shortcomings as a test."""
    places = to_local(scene.inputs.frame, table[:, :3], path)
    residuals = height_at(scene.points, places[:, :2]) - places[:, 2]
    if not np.isfinite(residuals).any():
        require_same_place(scene.points, places, "the cloud", path.name)
        raise CompareError(f"none of the {len(places)} check points of {path.name} has points of the cloud around it")
    accuracy = asprs_vertical(residuals, table[:, 3])
    lines = [f"point {i}" for i in range(1, len(table) + 1)]
    crs = scene.inputs.crs
    several = several_heights(lines, table, 1.0 if crs is None else height_unit_m(crs))
    notes = named(several, "place", f"of {path.name} with several heights, of which one is true at most")
    if not accuracy.is_enough:
        notes.append(
            f"{accuracy.n_checkpoints} check points of {path.name} lie on the cloud: ASPRS (Edition 2) requires "
            f"at least {MIN_CHECKPOINTS}, so that this is no test of the product"
        )
    if not table[:, 3].any():
        notes.append(f"{path.name} gives no standard deviations: its check points are taken as free of error")
    return Checkpoints(accuracy, table[:, :3], residuals), notes
