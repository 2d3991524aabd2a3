"""Lines in plan, read from GeoJSON, GeoPackage, shapefile or DXF."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from geo.crs import horizontal_crs
from geo.errors import UnreadableFile
from geo.files import existing_file
from geo.optional import library_for
from geo.polygons import DEPTH, in_map_of, read_geojson

_JSON, _BY_GDAL = (".geojson", ".json"), (".gpkg", ".shp", ".dxf")
# Well-known binary.
_LINE, _MULTI_LINE = 2, 5
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
        Line(name or str(number), corners if source is None else in_map_of(corners, source, target, path))
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
        raise UnreadableFile(f"{path} cannot be read for lines ({str(error)[:80]}); export it again.") from error


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
