"""Points of the water surface in vector files: the vertices of points, lines and polygons, with heights."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from pyproj import CRS

from geo.crs import crs_name, has_height, horizontal_crs, is_geographic
from geo.errors import UnreadableFile
from geo.features import GEOJSON, Features, read_features
from geo.reproject import has_same_heights
from geo.transformation import WGS84, transformed
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


def points_of_features(path: Path, crs: CRS) -> tuple[np.ndarray, tuple[str, ...]]:
    """Easting, northing, height (N, 3) in crs of all vertices of a vector file, each once, and what was assumed.

    A third coordinate is the height, in the heights of crs; else, or where all third coordinates are 0, a property such
    as level or ELEV is (programs write 0 where a layer has a third coordinate and no heights). Coordinates are in the
    CRS that the file states; where it states none, those of GeoJSON are longitude and latitude (RFC 7946), and others,
    or those too large for degrees, are in crs.

    Raises
    ------
    ConfigError
        If the file cannot be read, or has a vertex without a height, with several, or off the map.
    GeoError
        If it cannot be transformed to crs: see `geo.transformation.transformed`.
    """
    content = _content(path)
    vertices = list(_vertices(path, content))
    name, notes = _height_property(path, vertices)
    points = np.array(list(dict.fromkeys(_with_heights(path, vertices, name)))).reshape(-1, 3)
    if (wrong := next((height for height in points[:, 2].tolist() if is_no_data_value(height)), None)) is not None:
        raise ConfigError(f"{path} has the height {wrong:g}, a no-data value; remove those points")
    target = horizontal_crs(crs)
    source = None if content.crs is None else _plan_of(content.crs, crs, path)
    if source is None:
        is_in_degrees = bool((np.abs(points[:, :2]) <= (180.0, 90.0)).all())
        if path.suffix.lower() in GEOJSON and is_in_degrees:
            source = target if is_geographic(crs) else WGS84
        else:
            reason = ", and its coordinates are too large for degrees" if path.suffix.lower() in GEOJSON else ""
            return points, (*notes, f"{path.name} names no CRS{reason}: taken as crs")
    if len(points) and not source.equals(target, ignore_axis_order=True):
        points = transformed(source, target, points, str(path), "or give the points in crs.")
        if not np.isfinite(points).all():
            raise ConfigError(f"{path} has coordinates that are not on the map of {source.name} and {target.name}")
    return points, notes


def _plan_of(stated: CRS, crs: CRS, path: Path) -> CRS:
    """The horizontal part of the CRS that a file states; ConfigError where it states other heights than crs has."""
    if has_height(stated) and not has_same_heights(stated, crs):
        raise ConfigError(
            f"{path} has heights in {crs_name(stated)}, expected those of {crs_name(crs)}; transform it, or state a "
            "horizontal CRS alone if its heights are in crs"
        )
    return horizontal_crs(stated)


def _content(path: Path) -> Features:
    if path.is_file() and path.stat().st_size > _LARGEST_BYTES:
        raise ConfigError(f"{path} has more than {_LARGEST_BYTES // 1_000_000} MB, expected a shoreline; thin it")
    try:
        return read_features(path, "points, lines or polygons")
    except UnreadableFile as error:
        raise ConfigError(str(error)) from error


def _vertices(path: Path, content: Features) -> Iterator[tuple[list[float], dict]]:
    """The two or three coordinates of each vertex, with the properties of its feature."""
    for feature in content.features:
        coordinates = shapely.get_coordinates(feature.geometry, include_z=feature.geometry.has_z)
        for numbers in coordinates.tolist():
            if not math.isfinite(numbers[-1]):
                raise ConfigError(f"{path} has the position {numbers}, expected two or three finite numbers")
            yield numbers, feature.properties


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
        message = ", ".join(f"{name} = {value:g}" for name, value in heights.items())
        raise ConfigError(f"{path} has {flat}several properties that may be the height ({message}); {remedy}")
    if heights:
        return next(iter(heights.values()))
    if like := _names_like_heights(properties):
        message = ", ".join(f"{name} = {_number_in(properties[name]):g}" for name in like[:4] if name in properties)
        raise ConfigError(f"{path} has {flat or 'positions without a height, and '}the property {message}; {remedy}")
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
