"""Features of vector files: GeoJSON (RFC 7946 and older), GeoPackage, shapefile and DXF."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError
from shapely.errors import ShapelyError
from shapely.geometry import shape
from shapely.geometry.base import BaseGeometry, BaseMultipartGeometry

from geo.errors import UnreadableFile
from geo.files import existing_file, library_for
from geo.transformation import transformed

GEOJSON = (".geojson", ".json")
SUFFIXES = (*GEOJSON, ".gpkg", ".shp", ".dxf")

# What content of another form raises in `json`, `shapely` and pyogrio.
_FAULTS = (
    ShapelyError, CRSError, ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError,
    RuntimeError, OSError,
)  # fmt: skip


@dataclass(frozen=True)
class Feature:
    """A geometry with its attributes."""

    geometry: BaseGeometry  # Easting or longitude first
    properties: dict[str, Any]

    def parts(self) -> Iterator[BaseGeometry]:
        """The points, lines and polygons that the geometry consists of."""
        yield from _parts(self.geometry)


@dataclass(frozen=True)
class Features:
    """Content of a vector file."""

    features: tuple[Feature, ...]
    crs: CRS | None  # None where the file states none


def read_features(path: str | Path, kind: str) -> Features:
    """All features of a vector file; of several layers those of the first.

    Parameters
    ----------
    kind : str
        What an error names as expected, e.g. "polygons".

    Raises
    ------
    UnreadableFile
        If it is none of the formats, is damaged, has coordinates that are no finite numbers, or names a CRS that is not
        known.
    """
    path = existing_file(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        known = ", ".join(("", *SUFFIXES[2:]))
        raise UnreadableFile(f'{path} has the suffix "{path.suffix}", expected {kind} as one of {GEOJSON[0]}{known}.')
    try:
        found = _of_geojson(path) if suffix in GEOJSON else _by_gdal(path)
        if not all(np.isfinite(shapely.get_coordinates(each.geometry)).all() for each in found.features):
            raise ValueError("coordinates that are not finite")
    except _FAULTS as error:
        reason = f"without the member {error}" if isinstance(error, KeyError) else " ".join(str(error).split())[:80]
        raise UnreadableFile(f"{path} has no {kind} that can be read ({reason}); export it again.") from error
    return found


def in_horizontal_crs(geometry: BaseGeometry, source: CRS, target: CRS, path: Path) -> BaseGeometry:
    """A geometry of a file, in plan, transformed to another horizontal CRS.

    Raises
    ------
    UnreadableFile
        If it is not on the map of the target.
    GeoError
        If there is no transformation: see `geo.transformation.transformed`.
    """
    geometry = shapely.force_2d(geometry)
    if source.equals(target, ignore_axis_order=True):
        return geometry

    def moved(plan: np.ndarray) -> np.ndarray:
        with_height = np.column_stack([plan, np.zeros(len(plan))])
        return transformed(source, target, with_height, str(path), "or give it in the CRS of the cloud.")[:, :2]

    geometry = shapely.transform(geometry, moved)
    if not np.isfinite(shapely.get_coordinates(geometry)).all():
        raise UnreadableFile(f"{path} has corners that are not on the map of {target.name}; correct them or its CRS.")
    return geometry


def _parts(geometry: BaseGeometry) -> Iterator[BaseGeometry]:
    if isinstance(geometry, BaseMultipartGeometry):
        for each in geometry.geoms:
            yield from _parts(each)
    elif not geometry.is_empty:
        yield geometry


def _of_geojson(path: Path) -> Features:
    content = json.loads(path.read_bytes())
    named = content.get("crs")
    crs = None if named is None else CRS.from_user_input(str(named["properties"]["name"])[:200])
    items = content["features"] if content["type"] == "FeatureCollection" else [content]
    return Features(tuple(_feature(item) for item in items if item.get("geometry", item) is not None), crs)


def _feature(item: dict[str, Any]) -> Feature:
    if item["type"] != "Feature":
        return Feature(shape(item), {})
    properties = item.get("properties")
    return Feature(shape(item["geometry"]), properties if isinstance(properties, dict) else {})


def _by_gdal(path: Path) -> Features:
    raw = library_for(path, "pyogrio.raw", "vector")
    meta, _, shapes, columns = raw.read(path)
    values = zip(*(column.tolist() for column in columns), strict=True)
    rows = [dict(zip(meta["fields"], row, strict=True)) for row in values] or [{}] * len(shapes)
    # Solids and symbols of a drawing have no counterpart.
    geometries = shapely.from_wkb(shapes, on_invalid="ignore")
    features = (Feature(each, row) for each, row in zip(geometries, rows, strict=True) if each is not None)
    crs = None if meta["crs"] is None else CRS.from_user_input(meta["crs"])
    return Features(tuple(features), crs)
