"""Points of the water surface in GeoJSON: the vertices of its points, lines and polygons, with heights."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from geo.crs import horizontal_crs, is_geographic
from geo.transformation import transformed
from survey.errors import ConfigError

_LARGEST_BYTES = 100_000_000
# Where programs put the height of what has two coordinates, e.g. of a contour line.
_HEIGHT_NAMES = ("level", "height", "elevation", "elev", "ele", "z", "altitude")
_DEPTH_OF_COORDINATES = {
    "Point": 0, "MultiPoint": 1, "LineString": 1, "MultiLineString": 2, "Polygon": 2, "MultiPolygon": 3,
}  # fmt: skip


def points_of_geojson(path: Path, crs: CRS, notes: list[str]) -> np.ndarray:
    """Easting, northing, height (N, 3) in crs of all vertices, each once.

    A third coordinate is the height, in the heights of crs; else a property such as level or ELEV is. Coordinates are
    longitude and latitude (RFC 7946), in the CRS that an older file names, or in crs where they are too large for
    degrees.

    Raises
    ------
    ConfigError
        If the file cannot be read, is no GeoJSON, or has a vertex without a height or off the map.
    GeoError
        If it cannot be taken to crs: see `geo.transformation.transformed`.
    """
    content = _content(path)
    points = np.array(list(dict.fromkeys(_vertices(path, content, None, 0)))).reshape(-1, 3)
    source = _crs_of(path, content)
    if source is None:
        in_degrees = len(points) == 0 or bool((np.abs(points[:, :2]) <= (180.0, 90.0)).all())
        if not in_degrees or is_geographic(crs):
            if not in_degrees:
                notes.append(f"{path.name} names no CRS, and its coordinates are too large for degrees: taken as crs")
            return points
        source = CRS("EPSG:4326")
    target = horizontal_crs(crs)
    if len(points) and not source.equals(target, ignore_axis_order=True):
        points = transformed(source, target, points, str(path), "or give the points in crs.")
        if not np.isfinite(points).all():
            raise ConfigError(f"{path} has coordinates that are not on the map of {source.name} and {target.name}")
    return points


def _content(path: Path) -> dict:
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise ConfigError(f"{path} has more than {_LARGEST_BYTES // 1_000_000} MB, expected a shoreline; thin it")
        content = json.loads(path.read_bytes())
    except ConfigError:
        raise
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path} is not GeoJSON ({str(error)[:80]}); export it again") from error
    except OSError as error:
        raise ConfigError(f"{path} cannot be read ({error.strerror}); correct its name or its permissions") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path} is not GeoJSON, expected an object with a type; export it again")
    return content


def _vertices(path: Path, item: Any, height: float | None, depth: int) -> Iterator[tuple[float, float, float]]:
    """Vertices of an object and of what it holds; `height` is that of the feature around it."""
    kind = item.get("type") if isinstance(item, dict) else None
    if not isinstance(kind, str) or depth > 8:
        raise ConfigError(f"{path} is not GeoJSON: an object without a type was found; export it again")
    if kind == "FeatureCollection" or kind == "GeometryCollection":
        inside = item.get("features" if kind == "FeatureCollection" else "geometries")
        for each in inside if isinstance(inside, list) else []:
            yield from _vertices(path, each, height, depth + 1)
    elif kind == "Feature":
        if item.get("geometry") is not None:
            yield from _vertices(path, item["geometry"], _height_of(item.get("properties")), depth + 1)
    elif kind in _DEPTH_OF_COORDINATES:
        for position in _positions(item.get("coordinates"), _DEPTH_OF_COORDINATES[kind]):
            yield _vertex(path, position, height)
    else:
        raise ConfigError(f"{path} has a {kind[:40]}, expected points, lines or polygons; export it again")


def _positions(coordinates: Any, depth: int) -> Iterator[Any]:
    if depth == 0:
        yield coordinates
        return
    for part in coordinates if isinstance(coordinates, list) else [None]:
        yield from _positions(part, depth - 1)


def _vertex(path: Path, position: Any, height: float | None) -> tuple[float, float, float]:
    numbers = [_number(value) for value in position] if isinstance(position, list) else []
    if len(numbers) < 2 or not all(math.isfinite(value) for value in numbers[:3]):
        raise ConfigError(f"{path} has the position {str(position)[:60]}, expected two or three finite numbers")
    if len(numbers) == 2 and height is None:
        raise ConfigError(
            f"{path} has positions without a height, expected three coordinates, or a property {_HEIGHT_NAMES[0]}; a "
            "line in plan alone does not tell the level: measure heights along it, or give level_m"
        )
    return numbers[0], numbers[1], numbers[2] if len(numbers) > 2 else float(height or 0.0)


def _height_of(properties: Any) -> float | None:
    if not isinstance(properties, dict):
        return None
    by_name = {str(name).casefold(): _number(value) for name, value in properties.items()}
    return next((by_name[name] for name in _HEIGHT_NAMES if math.isfinite(by_name.get(name, math.nan))), None)


def _number(value: Any) -> float:
    """A JSON number; NaN where it is none, or too large for one."""
    try:
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    except OverflowError:
        return math.nan


def _crs_of(path: Path, content: dict) -> CRS | None:
    """The CRS that a file of the older standard names."""
    named = content.get("crs")
    properties = named.get("properties") if isinstance(named, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    if not isinstance(name, str):
        return None
    try:
        return horizontal_crs(CRS.from_user_input(name[:200]))
    except CRSError as error:
        raise ConfigError(f"{path} names the CRS {name[:60]!r}, which is not known; export it in crs") from error
