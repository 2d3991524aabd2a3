"""Lines and polygons in plan, read from vector files (`geo.features`)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import rasterio
import shapely
from pyproj import CRS
from rasterio.features import geometry_mask
from shapely import LineString, Polygon

from geo.crs import horizontal_crs, horizontal_unit
from geo.errors import UnreadableFile
from geo.features import GEOJSON, in_horizontal_crs, layer_of, read_features
from geo.grid import Grid
from geo.transformation import WGS84

_Shape = TypeVar("_Shape")
# Attributes that name a line, in any case; a DXF has layers.
_NAMES = ("name", "id", "line", "profile", "layer")
_WGS84_OF_GEOJSON = "GeoJSON without a crs, is taken as longitude and latitude of WGS 84"
# Places of a ring, the first again as the last, that enclose nothing.
_FEWEST_OF_RING = 3


@dataclass(frozen=True)
class Line:
    """A line of two corners or more."""

    name: str  # By its attributes, else its number from 1
    corners: np.ndarray  # (N, 2): easting or longitude first


def read_lines(path: str | Path, crs: CRS, around: np.ndarray) -> list[Line]:
    """All lines of a file, in the horizontal part of crs.

    GeoJSON has longitude and latitude of WGS 84, or the CRS that an older file names; a GeoPackage and a shapefile
    state their own; a DXF states none, and is taken to be in crs, as is a shapefile without .prj. A DXF in another unit
    than crs is converted where its coordinates lie around the cloud only then: templates state units that nobody meant.

    Parameters
    ----------
    path : Path
        May name a layer, see `geo.features.layer_of`.
    around : (2, 2), in crs
        Lowest and highest corner of the cloud that the lines are for.
    """
    found = [
        (_named(properties), np.array(line.coords))
        for line, properties in _in_crs(path, "lines", LineString, crs, around)
    ]
    if not found:
        raise UnreadableFile(f"{path} has no line of two corners or more; draw the profile as a line.")
    return [Line(name, corners) for name, corners in _numbered(found)]


def assumed_crs(path: str | Path) -> list[str]:
    """The sentence that WGS 84 is assumed, of GeoJSON that names no CRS; none of other files."""
    is_assumed = layer_of(path)[0].suffix.lower() in GEOJSON and read_features(path, "lines or polygons").crs is None
    return [f"{Path(path).name} names no CRS: taken as longitude and latitude of WGS 84 (RFC 7946)"] * is_assumed


def read_polygons(path: str | Path, crs: CRS, around: np.ndarray) -> dict[str, Polygon]:
    """All polygons of a file by name, in the horizontal part of crs, easting or longitude first; else as `read_lines`.

    Closed lines are polygons: a drawing has no others.
    """
    found = [
        (_named(properties), part if isinstance(part, Polygon) else Polygon(part))
        for part, properties in _in_crs(path, "polygons", (Polygon, LineString), crs, around)
        if isinstance(part, Polygon) or (part.is_closed and len(part.coords) > _FEWEST_OF_RING)
    ]
    if not found:
        raise UnreadableFile(
            f"{path} has no polygon and no closed line, expected one at least; draw the area as a polygon."
        )
    return dict(_numbered(found))


def cells_inside(polygons: Iterable[Polygon], grid: Grid) -> np.ndarray:
    """Whether the middle of each cell (rows, columns) lies in a polygon."""
    return geometry_mask(list(polygons), grid.shape, rasterio.Affine(*grid.transform), invert=True)


def points_inside(polygons: Iterable[Polygon], points: np.ndarray) -> np.ndarray:
    """Whether each point (N, 2) lies in a polygon."""
    # Rings that cross themselves become those that the even-odd rule has.
    area = shapely.union_all([shapely.make_valid(polygon) for polygon in polygons])
    shapely.prepare(area)
    return shapely.contains_xy(area, points)


def _in_crs(
    path: str | Path, plural: str, kinds: type | tuple[type, ...], crs: CRS, around: np.ndarray
) -> list[tuple[Any, dict[str, Any]]]:
    """Parts of some kinds of the geometries of a file, in the horizontal part of crs, with their attributes."""
    content, path, target = read_features(path, plural), layer_of(path)[0], horizontal_crs(crs)
    unstated = WGS84 if path.suffix.lower() in GEOJSON else target
    source = unstated if content.crs is None else horizontal_crs(content.crs)
    named = f"{path}, {_WGS84_OF_GEOJSON}," if content.crs is None and unstated is WGS84 else str(path)
    found = [
        (in_horizontal_crs(part, source, target, named), feature.properties)
        for feature in content.features
        for part in feature.parts()
        if isinstance(part, kinds)
    ]
    unit_m = horizontal_unit(target) if target.is_projected else None
    if content.unit_m is None or unit_m is None or content.unit_m == unit_m:
        return found
    factor, box = content.unit_m / unit_m, shapely.box(*around.ravel())
    scaled = [(shapely.transform(part, lambda plan: plan * factor), properties) for part, properties in found]
    meets, meets_scaled = (any(box.intersects(part) for part, _ in parts) for parts in (found, scaled))
    return scaled if meets_scaled and not meets else found


def _numbered(found: list[tuple[str, _Shape]]) -> list[tuple[str, _Shape]]:
    """Shapes with a name each: a number where they have none, and where parts of one feature or layer have the same."""
    names = [name or str(number) for number, (name, _) in enumerate(found, 1)]
    several = {name for name, times in Counter(names).items() if times > 1}
    numbers: Counter[str] = Counter()
    named = []
    for name, (_, shape) in zip(names, found, strict=True):
        numbers[name] += 1
        named.append((f"{name} {numbers[name]}" if name in several else name, shape))
    return named


def _named(attributes: dict[str, Any]) -> str:
    by_name = {str(name).lower(): value for name, value in attributes.items() if value not in (None, "")}
    return next((str(by_name[name]) for name in _NAMES if name in by_name), "")
