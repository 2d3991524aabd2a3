"""Lines and polygons in plan, read from vector files (`geo.features`)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from pyproj import CRS
from rasterio.features import geometry_mask
from shapely import LineString, Polygon

from geo.crs import horizontal_crs
from geo.errors import UnreadableFile
from geo.features import GEOJSON, in_horizontal_crs, read_features
from geo.transformation import WGS84

# Attributes that name a line, in any case; a DXF has layers.
_NAMES = ("name", "id", "line", "profile", "layer")


@dataclass(frozen=True)
class Line:
    """A line of two corners or more."""

    name: str  # By its attributes, else its number from 1
    corners: np.ndarray  # (N, 2): easting or longitude first


def read_lines(path: str | Path, crs: CRS) -> list[Line]:
    """All lines of a file, in the horizontal part of crs.

    GeoJSON has longitude and latitude of WGS 84, or the CRS that an older file names; a GeoPackage and a shapefile
    state their own; a DXF states none, and is taken to be in crs, as is a shapefile without .prj.

    Raises
    ------
    UnreadableFile
        If it is another format, is damaged, or has no line.
    GeoError
        If it cannot be taken to crs: see `geo.transformation.transformed`.
    """
    found = [
        (_named(properties), np.array(line.coords)) for line, properties in _in_crs(path, "lines", LineString, crs)
    ]
    if not found:
        raise UnreadableFile(f"{path} has no line of two corners or more; draw the profile as a line.")
    return [Line(name or str(number), corners) for number, (name, corners) in enumerate(found, 1)]


def read_polygons(path: str | Path, crs: CRS) -> list[Polygon]:
    """All polygons of a file, in the horizontal part of crs, easting or longitude first; formats as of `read_lines`.

    Raises
    ------
    UnreadableFile
        If it is another format, is damaged, or has no polygon.
    GeoError
        If it cannot be taken to crs: see `geo.transformation.transformed`.
    """
    found = [polygon for polygon, _ in _in_crs(path, "polygons", Polygon, crs)]
    if not found:
        raise UnreadableFile(f"{path} has no polygon, expected one at least; draw the area as a polygon.")
    return found


def cells_inside(
    polygons: list[Polygon], transform: tuple[float, float, float, float, float, float], shape: tuple[int, int]
) -> np.ndarray:
    """Whether the middle of each cell (rows, columns) lies in a polygon; the transform is that of `PlanCells`."""
    return geometry_mask(polygons, shape, rasterio.Affine(*transform), invert=True)


def points_inside(polygons: list[Polygon], points: np.ndarray) -> np.ndarray:
    """Whether each point (N, 2) lies in a polygon."""
    # Rings that cross themselves become those that the even-odd rule has.
    area = shapely.union_all([shapely.make_valid(polygon) for polygon in polygons])
    shapely.prepare(area)
    return shapely.contains_xy(area, points)


def _in_crs(path: str | Path, plural: str, kind: type, crs: CRS) -> list[tuple[Any, dict[str, Any]]]:
    """Parts of one kind of the geometries of a file, in the horizontal part of crs, with their attributes."""
    content, path, target = read_features(path, plural), Path(path), horizontal_crs(crs)
    unstated = WGS84 if path.suffix.lower() in GEOJSON else target
    source = unstated if content.crs is None else horizontal_crs(content.crs)
    return [
        (in_horizontal_crs(part, source, target, path), feature.properties)
        for feature in content.features
        for part in feature.parts()
        if isinstance(part, kind)
    ]


def _named(attributes: dict[str, Any]) -> str:
    by_name = {str(name).lower(): value for name, value in attributes.items() if value not in (None, "")}
    return next((str(by_name[name]) for name in _NAMES if name in by_name), "")
