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
from geo.values import is_no_data_value
from survey.errors import ConfigError

_LARGEST_BYTES = 100_000_000
# Properties in which programs store the height of 2D geometries, e.g. of contour lines.
_HEIGHT_NAMES = ("level", "height", "elevation", "elev", "ele", "z", "altitude")
# Parts of names of properties that may be heights, of an unknown kind or unit.
_LIKE_HEIGHTS = (
    *_HEIGHT_NAMES[:4],
    "alt",
    "depth",
    "stage",
    "wse",
    "hoehe",
    "höhe",
    "tiefe",
    "cote",
    "quota",
    "z_",
    "_z",
)
_DEPTH_OF_COORDINATES = {
    "Point": 0, "MultiPoint": 1, "LineString": 1, "MultiLineString": 2, "Polygon": 2, "MultiPolygon": 3,
}  # fmt: skip


def points_of_geojson(path: Path, crs: CRS) -> tuple[np.ndarray, tuple[str, ...]]:
    """Easting, northing, height (N, 3) in crs of all vertices, each once, and what was assumed of them.

    A third coordinate is the height, in the heights of crs; else, or where all third coordinates are 0, a property such
    as level or ELEV is (programs write 0 where a layer has a third coordinate and no heights). Coordinates are
    longitude and latitude (RFC 7946), in the CRS that an older file names, or in crs where they are too large for
    degrees.

    Raises
    ------
    ConfigError
        If the file cannot be read, is no GeoJSON, or has a vertex without a height, with several, or off the map.
    GeoError
        If it cannot be transformed to crs: see `geo.transformation.transformed`.
    """
    content = _content(path)
    vertices = list(_vertices(path, content, {}, 0))
    name, notes = _height_property(path, vertices)
    points = np.array(list(dict.fromkeys(_with_heights(path, vertices, name)))).reshape(-1, 3)
    if (wrong := next((height for height in points[:, 2].tolist() if is_no_data_value(height)), None)) is not None:
        raise ConfigError(f"{path} has the height {wrong:g}, a no-data value; remove those points")
    source = _crs_of(path, content)
    if source is None:
        in_degrees = len(points) == 0 or bool((np.abs(points[:, :2]) <= (180.0, 90.0)).all())
        if not in_degrees or is_geographic(crs):
            if not in_degrees:
                notes += (f"{path.name} names no CRS, and its coordinates are too large for degrees: taken as crs",)
            return points, notes
        source = CRS("EPSG:4326")
    target = horizontal_crs(crs)
    if len(points) and not source.equals(target, ignore_axis_order=True):
        points = transformed(source, target, points, str(path), "or give the points in crs.")
        if not np.isfinite(points).all():
            raise ConfigError(f"{path} has coordinates that are not on the map of {source.name} and {target.name}")
    return points, notes


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


def _vertices(path: Path, item: Any, properties: dict, depth: int) -> Iterator[tuple[list[float], dict]]:
    """Coordinates of the vertices of an object and of what it holds, each with the properties of its feature."""
    kind = item.get("type") if isinstance(item, dict) else None
    if not isinstance(kind, str) or depth > 8:
        raise ConfigError(f"{path} is not GeoJSON: an object without a type was found; export it again")
    if kind == "FeatureCollection" or kind == "GeometryCollection":
        inside = item.get("features" if kind == "FeatureCollection" else "geometries")
        for each in inside if isinstance(inside, list) else []:
            yield from _vertices(path, each, properties, depth + 1)
    elif kind == "Feature":
        if item.get("geometry") is not None:
            held = item.get("properties")
            yield from _vertices(path, item["geometry"], held if isinstance(held, dict) else {}, depth + 1)
    elif kind in _DEPTH_OF_COORDINATES:
        for position in _positions(item.get("coordinates"), _DEPTH_OF_COORDINATES[kind]):
            yield _coordinates(path, position), properties
    else:
        raise ConfigError(f"{path} has a {kind[:40]}, expected points, lines or polygons; export it again")


def _positions(coordinates: Any, depth: int) -> Iterator[Any]:
    if depth == 0:
        yield coordinates
        return
    for part in coordinates if isinstance(coordinates, list) else [None]:
        yield from _positions(part, depth - 1)


def _coordinates(path: Path, position: Any) -> list[float]:
    """The first three, or two, coordinates of a position."""
    numbers = [_number(value) for value in position[:3]] if isinstance(position, list) else []
    if len(numbers) < 2 or not all(math.isfinite(value) for value in numbers):
        raise ConfigError(f"{path} has the position {str(position)[:60]}, expected two or three finite numbers")
    return numbers


def _is_flat(vertices: list[tuple[list[float], dict]]) -> bool:
    """Whether there are third coordinates, all of them 0."""
    thirds = [numbers[2] for numbers, _ in vertices if len(numbers) > 2]
    return bool(thirds) and not any(thirds)


def _height_property(path: Path, vertices: list[tuple[list[float], dict]]) -> tuple[str | None, tuple[str, ...]]:
    """A property that has the heights where third coordinates are 0 throughout, and a note of it."""
    names = sorted({name for _, properties in vertices for name in _names_like_heights(properties)})
    if not names or not _is_flat(vertices):
        return None, ()
    return names[0], (f"all third coordinates of {path.name} are 0: heights are those of its property {names[0]}",)


def _with_heights(
    path: Path, vertices: list[tuple[list[float], dict]], name: str | None
) -> Iterator[tuple[float, float, float]]:
    """Vertices with their heights: the third coordinates, unless a property ``name`` has them."""
    is_flat = _is_flat(vertices)
    for numbers, properties in vertices:
        if len(numbers) > 2 and name is None:
            yield numbers[0], numbers[1], numbers[2]
        else:
            yield numbers[0], numbers[1], _height_of(path, properties, is_flat)


def _names_like_heights(properties: dict) -> list[str]:
    """Names of properties that hold a number and may be a height."""
    return [
        str(name)
        for name, value in properties.items()
        if math.isfinite(_number_in(value))
        and (str(name).casefold() in _HEIGHT_NAMES or any(part in str(name).casefold() for part in _LIKE_HEIGHTS))
    ]


def _height_of(path: Path, properties: dict, is_flat: bool) -> float:
    """The height among the properties of a feature; ConfigError where there is none, or several that differ."""
    known = {str(name).casefold(): _number_in(value) for name, value in properties.items()}
    heights = {name: known[name] for name in _HEIGHT_NAMES if math.isfinite(known.get(name, math.nan))}
    flat = "third coordinates that are all 0, and " if is_flat else ""
    remedy = f"keep one property {_HEIGHT_NAMES[0]} with the height in crs, or give the height as third coordinate"
    if len(set(heights.values())) > 1:
        said = ", ".join(f"{name} = {value:g}" for name, value in heights.items())
        raise ConfigError(f"{path} has {flat}several properties that may be the height ({said}); {remedy}")
    if heights:
        return next(iter(heights.values()))
    if like := _names_like_heights(properties):
        said = ", ".join(f"{name} = {_number_in(properties[name]):g}" for name in like[:4] if name in properties)
        raise ConfigError(f"{path} has {flat or 'positions without a height, and '}the property {said}; {remedy}")
    raise ConfigError(
        f"{path} has {'features without a height' if is_flat else 'positions without a height'}, expected three "
        f"coordinates, or a property {_HEIGHT_NAMES[0]}; a line in plan alone does not tell the level: measure heights "
        "along it, or give level_m"
    )


def _number_in(value: Any) -> float:
    """A number, or a text that is one, as columns of text are exported; NaN where it is none."""
    if isinstance(value, str) and len(value) < 40:
        try:
            return float(value)
        except ValueError:
            return math.nan
    return _number(value)


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
