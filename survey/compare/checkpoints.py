"""Check points: a table of surveyed places, and the height of a cloud over each (ASPRS, Edition 2)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evaluation import asprs_vertical, height_at
from evaluation.standards import MIN_CHECKPOINTS
from geo.files import existing_file
from survey.compare.area import CompareError, to_local
from survey.compare.figures import Checkpoints
from survey.compare.scene import Scene
from survey.files.csv_table import read_table

_COLUMNS = ("easting", "northing", "height", "sigma")


def read_checkpoints(path: Path) -> np.ndarray:
    """Check points (K, 4) of a CSV: easting, northing, height in the CRS of the cloud, standard deviation [m].

    The last column may be missing (0 then). A first line may name the columns, in any order; without names this
    order holds. See `survey.files.csv_table` for separators.

    Raises
    ------
    GeoError
        If the file does not exist.
    CompareError
        If a line has other columns, or no line is left.
    """
    rows = read_table(existing_file(path), _COLUMNS[:3], optional=_COLUMNS[3:], header=False, error=CompareError)
    table = np.array([[*(row.number(name) for name in _COLUMNS[:3]), row.number("sigma", default=0.0)] for row in rows])
    if not rows:
        raise CompareError(f"{path} has no check points; expected lines of {', '.join(_COLUMNS)}")
    for row, sigma in zip(rows, table[:, 3], strict=True):
        if sigma < 0.0:
            raise CompareError(f"{row.where}: sigma is {sigma:g}, expected metres, not negative")
    return table


def checkpoint_accuracy(scene: Scene, table: np.ndarray, path: Path, notes: list[str]) -> Checkpoints:
    """Vertical accuracy of the compared cloud at check points (K, 4); notes list its shortcomings as a test."""
    places = to_local(scene.inputs.frame, table[:, :3], path)
    residuals = height_at(scene.points, places[:, :2]) - places[:, 2]
    accuracy = asprs_vertical(residuals, table[:, 3])
    if not accuracy.is_enough:
        notes.append(
            f"{accuracy.n_checkpoints} check points of {path.name} lie on the cloud: ASPRS (Edition 2) requires "
            f"at least {MIN_CHECKPOINTS}, so that this is no test of the product"
        )
    if not table[:, 3].any():
        notes.append(f"{path.name} gives no standard deviations: its check points are taken as free of error")
    return Checkpoints(accuracy, table[:, :3], residuals)
