"""Lines and polygons in plan, read from GeoJSON (RFC 7946 and older), GeoPackage, shapefile or DXF."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import rasterio
from pyproj import CRS
from pyproj.exceptions import CRSError
from rasterio.features import geometry_mask

from geo.crs import horizontal_crs
from geo.errors import UnreadableFile
from geo.files import existing_file, library_for
from geo.transformation import WGS84, transformed

# Each polygon as its rings (N, 2), the outer one first.
Polygons = list[list[np.ndarray]]

Found = TypeVar("Found")

_POLYGON, _MULTI = 3, 6
# The deepest nesting of GeoJSON collections that is read.
DEPTH = 12
_JSON, _BY_GDAL = (".geojson", ".json"), (".gpkg", ".shp", ".dxf")
# Well-known binary.
_LINE, _MULTI_LINE = 2, 5
# Attributes that name a line, in any case; a DXF has layers.
_NAMES = ("name", "id", "line", "profile", "layer")


def read_polygons(path: str | Path, crs: CRS) -> Polygons:
    """All polygons of a file, in the horizontal part of crs, easting or longitude first.

    GeoJSON has longitude and latitude of WGS 84, or the CRS that an older file names; a GeoPackage states its own.

    Raises
    ------
    UnreadableFile
        If it is another format, is damaged, or has no polygon.
    GeoError
        If it cannot be taken to crs: see `geo.transformation.transformed`.
    """
    path = existing_file(path)
    suffix = path.suffix.lower()
    if suffix not in (".geojson", ".json", ".gpkg"):
        raise UnreadableFile(f'{path} has the suffix "{path.suffix}", expected polygons as .geojson or .gpkg.')
    polygons, source = _of_geopackage(path) if suffix == ".gpkg" else read_geojson(path, "polygons", _gathered)
    if not polygons:
        raise UnreadableFile(f"{path} has no polygon, expected one at least; draw the area as a polygon.")
    target = horizontal_crs(crs)
    return [[in_horizontal_crs(ring, source, target, path) for ring in polygon] for polygon in polygons]


def cells_inside(
    polygons: Polygons, transform: tuple[float, float, float, float, float, float], shape: tuple[int, int]
) -> np.ndarray:
    """Whether the middle of each cell (rows, columns) lies in a polygon; the transform is that of `PlanCells`."""
    shapes = [{"type": "Polygon", "coordinates": [ring.tolist() for ring in polygon]} for polygon in polygons]
    return geometry_mask(shapes, shape, rasterio.Affine(*transform), invert=True)


def points_inside(polygons: Polygons, points: np.ndarray) -> np.ndarray:
    """Whether each point (N, 2) lies in a polygon: by an odd number of its edges to the east (even-odd rule)."""
    x, y = points.T
    inside = np.zeros(len(points), dtype=bool)
    for polygon in polygons:
        is_odd = np.zeros(len(points), dtype=bool)
        for ring in polygon:
            for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
                if y0 != y1:
                    crosses = (y0 > y) != (y1 > y)
                    is_odd ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
        inside |= is_odd
    return inside


def in_horizontal_crs(ring: np.ndarray, source: CRS, target: CRS, path: Path) -> np.ndarray:
    """Corners (N, 2) of a file, transformed to another horizontal CRS; GeoError where that is not possible."""
    if not source.equals(target, ignore_axis_order=True):
        with_height = np.column_stack([ring, np.zeros(len(ring))])
        remedy = "or give it in the CRS of the cloud."
        ring = transformed(source, target, with_height, str(path), remedy)[:, :2]
    if not np.isfinite(ring).all():
        raise UnreadableFile(f"{path} has corners that are not on the map of {target.name}; correct them or its CRS.")
    return ring


def read_geojson(path: Path, shapes: str, gather: Callable[[Any], Found]) -> tuple[Found, CRS]:
    """Result of ``gather`` on the content of a GeoJSON file, and the horizontal CRS of its coordinates.

    ``shapes`` is what an error names as expected; ``gather`` may raise for content of another form.

    Raises
    ------
    UnreadableFile
        If it is no GeoJSON, or names a CRS that is not known.
    """
    try:
        content = json.loads(path.read_bytes())
        found, named = gather(content), content.get("crs")
    except (ValueError, TypeError, KeyError, IndexError, OverflowError, RecursionError, AttributeError) as error:
        raise UnreadableFile(f"{path} is not GeoJSON with {shapes} ({str(error)[:80]}); export it again.") from error
    if named is None:
        return found, WGS84
    try:
        return found, horizontal_crs(CRS.from_user_input(str(named["properties"]["name"])))
    except (CRSError, TypeError, KeyError) as error:
        raise UnreadableFile(f"{path} names a CRS that is not known ({str(named)[:60]}); export it again.") from error


def _gathered(content: Any) -> Polygons:
    found: Polygons = []
    _gather(content, found, DEPTH)
    return found


def _gather(item: Any, found: Polygons, depth: int) -> None:
    """Add the polygons of a GeoJSON object and of what it holds."""
    kind = item["type"]
    if depth == 0:
        raise ValueError("collections in collections")
    if kind == "FeatureCollection" or kind == "GeometryCollection":
        for each in item["features" if kind == "FeatureCollection" else "geometries"]:
            _gather(each, found, depth - 1)
    elif kind == "Feature":
        if item["geometry"] is not None:
            _gather(item["geometry"], found, depth - 1)
    elif kind == "Polygon":
        found.append([_ring(ring) for ring in item["coordinates"]])
    elif kind == "MultiPolygon":
        found += [[_ring(ring) for ring in polygon] for polygon in item["coordinates"]]


def _ring(positions: list) -> np.ndarray:
    ring = np.array([position[:2] for position in positions], dtype=np.float64)
    if ring.ndim != 2 or ring.shape[1] != 2 or len(ring) < 4 or not np.isfinite(ring).all():
        raise ValueError(f"a ring is {str(positions)[:60]}, expected four positions or more")
    return ring


def _of_geopackage(path: Path) -> tuple[Polygons, CRS]:
    raw = library_for(path, "pyogrio.raw", "vector")
    try:
        said, _, shapes, _ = raw.read(path, columns=[], force_2d=True)
        found: Polygons = []
        for shape in shapes:
            if shape is not None:
                _gather_wkb(shape, 0, found)
        return found, horizontal_crs(CRS.from_user_input(said["crs"]))
    except (CRSError, ValueError, RuntimeError, OSError, struct.error) as error:
        raise UnreadableFile(
            f"{path} is not a GeoPackage with polygons ({str(error)[:80]}); export it again."
        ) from error


def _gather_wkb(wkb: bytes, at: int, found: Polygons) -> int:
    """Add the polygons of well-known binary from a byte on; returns the byte behind it."""
    order = _order(wkb, at)
    kind, count = struct.unpack_from(f"{order}II", wkb, at + 1)
    at += 9
    if kind == _MULTI:
        for _ in range(count):
            at = _gather_wkb(wkb, at, found)
    elif kind == _POLYGON:
        rings = []
        for _ in range(count):
            (num,) = struct.unpack_from(f"{order}I", wkb, at)
            rings.append(np.frombuffer(wkb, f"{order}f8", 2 * num, at + 4).reshape(-1, 2).astype(np.float64))
            at += 4 + 16 * num
        found.append(rings)
    return at


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
        If it is none of these, is damaged, or has no line.
    GeoError
        If it cannot be taken to crs: see `geo.transformation.transformed`.
    """
    path = existing_file(path)
    suffix = path.suffix.lower()
    if suffix not in (*_JSON, *_BY_GDAL):
        known = ", ".join((_JSON[0], *_BY_GDAL))
        raise UnreadableFile(f'{path} has the suffix "{path.suffix}", expected lines as one of {known}.')
    found, source = (
        read_geojson(path, "lines", lambda content: list(_walk(content, "", DEPTH)))
        if suffix in _JSON
        else _by_gdal(path)
    )
    if not found:
        raise UnreadableFile(f"{path} has no line of two corners or more; draw the profile as a line.")
    target = horizontal_crs(crs)
    return [
        Line(name or str(number), corners if source is None else in_horizontal_crs(corners, source, target, path))
        for number, (name, corners) in enumerate(found, 1)
    ]


def _named(attributes: dict[str, Any]) -> str:
    by_name = {str(name).lower(): value for name, value in attributes.items() if value not in (None, "")}
    return next((str(by_name[name]) for name in _NAMES if name in by_name), "")


def _corners(positions: Any) -> np.ndarray:
    corners = np.array([position[:2] for position in positions], dtype=np.float64)
    if corners.ndim != 2 or len(corners) < 2 or not np.isfinite(corners).all():
        raise ValueError(f"a line is {str(positions)[:60]}, expected two positions or more")
    return corners


def _walk(item: Any, name: str, depth: int) -> Iterator[tuple[str, np.ndarray]]:
    """Names and corners of the lines of a GeoJSON object and of what it holds."""
    kind = item["type"]
    if depth == 0:
        raise ValueError("collections in collections")
    if kind in ("FeatureCollection", "GeometryCollection"):
        for each in item["features" if kind == "FeatureCollection" else "geometries"]:
            yield from _walk(each, name, depth - 1)
    elif kind == "Feature":
        if item["geometry"] is not None:
            yield from _walk(item["geometry"], _named(item.get("properties") or {}), depth - 1)
    elif kind == "LineString":
        yield name, _corners(item["coordinates"])
    elif kind == "MultiLineString":
        for part in item["coordinates"]:
            yield name, _corners(part)


def _by_gdal(path: Path) -> tuple[list[tuple[str, np.ndarray]], CRS | None]:
    raw = library_for(path, "pyogrio.raw", "vector")
    try:
        said, _, shapes, values = raw.read(path, force_2d=True)
        rows = [dict(zip(said["fields"], row, strict=True)) for row in zip(*values, strict=True)] or [{}] * len(shapes)
        found = [
            (_named(row), corners)
            for row, shape in zip(rows, shapes, strict=True)
            if shape is not None
            for corners in _of_wkb(shape)
        ]
        return found, None if said["crs"] is None else horizontal_crs(CRS.from_user_input(said["crs"]))
    except (CRSError, ValueError, RuntimeError, OSError, struct.error, IndexError) as error:
        raise UnreadableFile(f"{path} has no lines that can be read ({str(error)[:80]}); export it again.") from error


def _of_wkb(wkb: bytes) -> Iterator[np.ndarray]:
    """The lines of well-known binary in plan; other geometries have none."""
    order = _order(wkb, 0)
    (kind,) = struct.unpack_from(f"{order}I", wkb, 1)
    if kind == _LINE:
        yield _line(wkb, 0)[0]
    elif kind == _MULTI_LINE:
        (count,) = struct.unpack_from(f"{order}I", wkb, 5)
        at = 9
        for _ in range(count):
            corners, at = _line(wkb, at)
            yield corners


def _order(wkb: bytes, at: int) -> str:
    return "<" if wkb[at] == 1 else ">"


def _line(wkb: bytes, at: int) -> tuple[np.ndarray, int]:
    order = _order(wkb, at)
    (count,) = struct.unpack_from(f"{order}I", wkb, at + 5)
    values = np.frombuffer(wkb, f"{order}f8", 2 * count, at + 9).astype(np.float64)
    return _corners(values.reshape(-1, 2)), at + 9 + 16 * count
