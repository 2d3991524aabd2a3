"""Tables of points as the reference of a comparison: an echo sounder's lines, points by rod, in CSV or XYZ."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.crs import has_height, height_unit_m
from geo.files import existing_file
from geo.reading import read_reference
from geo.shapes import Cloud, Mesh, as_classes
from geo.values import check_values
from survey.compare.area import CompareError
from survey.files.column_units import Units
from survey.files.csv_table import Row, shortened
from survey.files.point_table import PLACE, read_points
from survey.files.text_crs import crs_of_comment

# How a user tells the level that depths count from.
GIVE_LEVEL = "give --water-level"
# Names that programs give the depth of a point.
DEPTH_NAMES = ("depth", "depth_m")
# Levels over the points of a cloud that differ by less are one: rounding, no slope of a river.
_ONE_LEVEL_M = 0.02
# The class of LAS of points that have none.
_UNCLASSIFIED = 1.0
# Of files that are read as tables.
SUFFIXES = (".csv", ".xyz", ".txt", ".tsv", ".pts")


def is_table(path: Path) -> bool:
    """Whether a file is a table of points, by the suffix of its name."""
    return path.suffix.lower() in SUFFIXES


def read_shape(path: Path, water_level: float | None, crs: CRS | None = None) -> Mesh | Cloud:
    """A mesh or cloud as `geo.read_reference`, or the points of a table, depths below the level of the water.

    Parameters
    ----------
    path : Path
    water_level : float, optional
        In the CRS of the comparison.
    crs : pyproj.CRS, optional
        Of a table that names none, and of the heights of one that names one without.

    Raises
    ------
    GeoError, CompareError
        As `geo.read_reference` and `survey.files.point_table.read_points`.
    """
    if not is_table(path):
        return read_reference(path)
    own = crs_of_comment(existing_file(path), CompareError)
    rows = read_points(
        path,
        optional=("std", "classification"),
        by_place=True,
        level=water_level,
        give_level=GIVE_LEVEL,
        units=Units.of(own or crs, crs),
        error=CompareError,
    )
    points = places_of(rows, path)
    classes, notes = _classes_of(rows, path)
    return Cloud(points=points, crs=own, classification=classes, notes=(*check_values(points, own, path), *notes))


def _classes_of(rows: Sequence[Row], path: Path) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Classes (N,) of LAS, and a note where a column of that name has none; empty cells are not classified."""
    said = [row.cells.get("classification", "") for row in rows]
    if not any(said):
        return None, ()
    for row, cell in zip(rows, said, strict=True):
        try:
            is_class = not cell or as_classes(np.array([row.number("classification")])) is not None
        except CompareError:
            is_class = False
        if not is_class:
            return None, (f"the classes of {path.name} are not those of LAS ({shortened(cell)}): all its points count",)
    return np.array([row.number("classification", default=_UNCLASSIFIED) for row in rows]).astype(np.uint8), ()


def places_of(rows: Sequence[Row], path: Path) -> np.ndarray:
    """Easting, northing, height (N, 3) of rows of a table.

    Raises
    ------
    CompareError
        If there is none.
    """
    if not rows:
        raise CompareError(f"{path} has no points; expected lines of easting, northing, height")
    return np.array([[row.number(name) for name in PLACE] for row in rows])


def level_of_cloud(shape: Mesh | Cloud) -> float | None:
    """Height of the water over a cloud, in its CRS, by the depths of its points; None where it has no one level."""
    if not isinstance(shape, Cloud):
        return None
    depth = next((shape.extra[name] for name in DEPTH_NAMES if name in shape.extra), None)
    wet = None if depth is None else depth > 0.0
    if depth is None or wet is None or not wet.any():
        return None
    unit = 1.0 if shape.crs is None or not has_height(shape.crs) else height_unit_m(shape.crs)
    levels = shape.points[wet, 2] + depth[wet] / unit
    low, middle, high = np.quantile(levels, [0.02, 0.5, 0.98])
    return float(middle) if (high - low) * unit < _ONE_LEVEL_M else None
