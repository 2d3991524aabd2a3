"""Lines and polygons in plan, written as GeoJSON (RFC 7946), GeoPackage, zipped shapefile or DXF."""

from __future__ import annotations

import io
import json
import re
import warnings
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

import numpy as np
import shapely
from pyproj import CRS
from shapely import LineString, MultiLineString, MultiPolygon, Point, Polygon
from shapely.geometry import mapping
from shapely.geometry.polygon import orient
from shapely.ops import split

from geo.compatibility import crosses, crs_difference
from geo.crs import crs_code, crs_name, height_unit_m, horizontal_crs, horizontal_unit, is_geographic
from geo.errors import GeoError, UnwritableFile
from geo.features import UNITS_OF_DRAWINGS
from geo.files import library_for, write_text, write_whole
from geo.transformation import WGS84, Transformation

# Of a degree: a tenth of a millimetre.
_DECIMALS = 9
_MERIDIAN = LineString([(180.0, -90.0), (180.0, 90.0)])
# Characters that DXF does not allow in names of layers.
_NOT_IN_NAMES = re.compile(r"[<>/\\\":;?*|=`\x00-\x1f]")


@dataclass(frozen=True)
class Layer:
    name: str  # One word, e.g. "contours".
    kind: Literal["Point", "LineString", "Polygon"]
    # For each feature a place (2,), a line (N, 2), or closed rings (N, 2), the outer one first; easting first
    shapes: list
    crs: CRS  # Its horizontal part counts
    columns: dict[str, list] = field(default_factory=dict)  # Attributes of the features, by name
    notes: str = ""  # What the features are
    # For each line its heights (N,), in crs; None where there are none. GeoJSON and GeoPackage leave them out.
    heights: list | None = None


def geodataframe(layer: Layer) -> Any:
    """The layer as ``geopandas.GeoDataFrame`` in the horizontal part of its CRS, lines with heights where it has some.

    Raises GeoError if geopandas is not installed.
    """
    try:
        import geopandas
    except ModuleNotFoundError as error:
        raise GeoError("geopandas is not installed: pip install 'bathynerf[geopandas]'") from error
    shapes = layer.shapes
    if layer.heights is not None:
        shapes = [np.column_stack(line) for line in zip(shapes, layer.heights, strict=True)]
    geometry = [_shape(layer.kind, shape) for shape in shapes]
    return geopandas.GeoDataFrame(layer.columns, geometry=geometry, crs=horizontal_crs(layer.crs))


def write_geojson(path: str | Path, layer: Layer) -> str | None:
    """Write a layer as GeoJSON, in longitude and latitude of WGS 84, as RFC 7946 wants it, whole or not at all.

    The member ``bathynerf`` names the CRS that the features were made in, and the accuracy of the transformation as
    PROJ states it. Shapes across the meridian of 180 degrees are cut there. Returns a warning where places are less
    well known in WGS 84 than in the CRS of the layer.
    """
    places = [line for shape in layer.shapes for line in (shape if layer.kind == "Polygon" else [shape])]
    operation = require_wgs84(path, layer.crs, np.concatenate(places) if places else np.zeros((0, 2)))

    def in_wgs84(line: np.ndarray) -> np.ndarray:
        return np.round(np.column_stack(operation(*np.asarray(line, dtype=np.float64).T)), _DECIMALS)

    features = []
    for number, shape in enumerate(layer.shapes):
        parts = (
            cut_polygon([in_wgs84(ring) for ring in shape]) if layer.kind == "Polygon" else cut_line(in_wgs84(shape))
        )
        properties = {name: values[number] for name, values in layer.columns.items()}
        features.append({"type": "Feature", "properties": properties, "geometry": _geometry(layer.kind, parts)})
    about = {
        "made_by": "bathynerf",
        "crs_of_survey": crs_code(layer.crs) or layer.crs.name,
        "accuracy_of_wgs84_m": operation.accuracy_m,
        "about": layer.notes,
    }
    collection = {"type": "FeatureCollection", "name": layer.name, "bathynerf": about, "features": features}
    write_text(path, json.dumps(collection, ensure_ascii=False, allow_nan=False))
    return operation.warning(f"places in {path}") if layer.shapes else None


def cut_line(line: np.ndarray) -> list[np.ndarray]:
    """The parts of a line (N, 2) [deg] on both sides of 180 degrees, in their order (RFC 7946, section 3.1.9)."""
    return [part[0] for part in _cut(LineString(_unwrapped(line)))] if crosses(line) else [line]


def cut_polygon(rings: list[np.ndarray]) -> list[list[np.ndarray]]:
    """The parts of a polygon on both sides, each as its closed rings (N, 2) [deg] with the outer one first."""
    if not crosses(np.concatenate(rings)):
        return [rings]
    outer, *holes = (_unwrapped(ring) for ring in rings)
    return _cut(Polygon(outer, holes))


def _unwrapped(line: np.ndarray) -> np.ndarray:
    """The line with longitudes from 0 to 360 degrees, without a jump at the meridian."""
    line = np.array(line, dtype=np.float64)
    line[line[:, 0] < 0.0, 0] += 360.0
    return line


def _cut(shape: LineString | Polygon) -> list[list[np.ndarray]]:
    """The parts of a shape on both sides of 180 degrees, each as its lines (N, 2) with longitudes of -180 to 180."""
    parts = []
    for part in split(shape, _MERIDIAN).geoms:
        east = 360.0 if part.representative_point().x > 180.0 else 0.0
        lines = [part] if isinstance(part, LineString) else [part.exterior, *part.interiors]
        parts.append([np.array(line.coords) - [east, 0.0] for line in lines])
    return parts


def require_wgs84(path: str | Path, crs: CRS, places: np.ndarray) -> Transformation:
    """The transformation to WGS 84 at places (N, 2) in crs; raises GeoError where its grid is not there."""
    operation = Transformation.between(crs, WGS84, places)
    operation.require_best(str(path), "or write a GeoPackage, which keeps the CRS of the survey.")
    return operation


def _geometry(kind: str, parts: list) -> dict:
    """A geometry of lines, or of polygons of rings (N, 2) [deg]; one of several parts where it was cut."""
    shapes = [orient(_shape(kind, part)) if kind == "Polygon" else _shape(kind, part) for part in parts]
    several = MultiPolygon if kind == "Polygon" else MultiLineString
    return mapping(shapes[0] if len(shapes) == 1 else several(shapes))


def _shape(kind: str, shape) -> Point | LineString | Polygon:
    return Polygon(shape[0], shape[1:]) if kind == "Polygon" else (Point if kind == "Point" else LineString)(shape)


def write_geopackage(path: str | Path, layer: Layer) -> None:
    """Write a layer as GeoPackage in its own CRS, whole or not at all."""
    options = {"layer_options": {"IDENTIFIER": f"bathynerf {layer.name}", "DESCRIPTION": layer.notes}}
    with write_whole(path) as stream, _folder_beside(path) as work:
        # GDAL knows the format by the suffix.
        copy = Path(work) / "copy.gpkg"
        _write_by_gdal(copy, Path(path), layer, "GPKG", layer=layer.name, **options)
        stream.write(copy.read_bytes())


def _folder_beside(path: str | Path) -> TemporaryDirectory:
    is_file = Path(path).is_file() or not Path(path).exists()
    return TemporaryDirectory(prefix=".", suffix=".part", dir=Path(path).resolve().parent if is_file else None)


def _write_by_gdal(copy: Path, path: Path, layer: Layer, driver: str, /, **options) -> None:
    """Write a layer in its own CRS by GDAL to ``copy``, which will become ``path``, and read it once more."""
    pyogrio = library_for(path, "pyogrio", "vector", to_write=True)
    crs, shapes, kind = horizontal_crs(layer.crs), layer.shapes, str(layer.kind)
    if layer.heights is not None and driver == "ESRI Shapefile":
        shapes = [np.column_stack([line, z]) for line, z in zip(shapes, layer.heights, strict=True)]
        kind = f"{kind} Z"
    try:
        pyogrio.raw.write(
            copy,
            geometry=shapely.to_wkb([_shape(layer.kind, shape) for shape in shapes], flavor="iso", byte_order=1),
            field_data=[np.array(values) for values in layer.columns.values()],
            fields=np.array(list(layer.columns), dtype=object),
            driver=driver,
            geometry_type=kind,
            crs=crs_code(crs) or crs.to_wkt(),
            **options,
        )
        with warnings.catch_warnings():
            # Of the measures that every shapefile of lines with heights has.
            warnings.simplefilter("ignore", UserWarning)
            stated = pyogrio.read_info(copy)["crs"]
        read = None if stated is None else CRS.from_user_input(stated)
    except (RuntimeError, ValueError, OSError) as error:
        raise UnwritableFile(
            f"cannot write {path}: {str(error)[:80]}; most likely no space is left on the disk: free some or write "
            "elsewhere."
        ) from error
    if read is None or crs_difference(read, crs) is not None:
        raise UnwritableFile(f"cannot write {path}: its format cannot hold the CRS {crs.name}; choose another --crs.")


def write_shapefile(path: str | Path, layer: Layer) -> None:
    """Write a layer as a shapefile in its own CRS, its files in one ZIP, whole or not at all; lines with heights."""
    with write_whole(path) as stream, _folder_beside(path) as work:
        _write_by_gdal(Path(work) / f"{layer.name}.shp", Path(path), layer, "ESRI Shapefile")
        content = BytesIO()
        with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
            for part in sorted(Path(work).iterdir()):
                archive.writestr(zipfile.ZipInfo(part.name), part.read_bytes(), zipfile.ZIP_DEFLATED)
        stream.write(content.getvalue())


class DxfLine(NamedTuple):
    """A polyline."""

    layer: str
    places: np.ndarray  # (N, 3): Easting, northing and height, in the units of a CRS


def lines_of(layer: Layer) -> list[DxfLine]:
    """The lines of a layer with heights."""
    pairs = zip(layer.shapes, layer.heights or [], strict=True)
    return [DxfLine(layer.name, np.column_stack([line, heights])) for line, heights in pairs]


def require_drawable(path: str | Path, crs: CRS) -> None:
    """Raise UnwritableFile where a CRS is in degrees, or in different units in plan and in height."""
    if is_geographic(crs):
        raise UnwritableFile(
            f"{path}: DXF has coordinates in a unit of length, and {crs_name(crs)} is in degrees; give --crs, e.g. "
            "a UTM zone"
        )
    unit = horizontal_unit(crs)
    if abs(height_unit_m(crs) / unit - 1.0) > 1e-9:
        raise UnwritableFile(
            f"{path}: a DXF has one unit for plan and heights, and {crs_name(crs)} has {unit:.10g} m in plan and "
            f"{height_unit_m(crs):.10g} m in height; give --crs with the same unit in both"
        )


def write_dxf(path: str | Path, lines: Sequence[DxfLine], crs: CRS) -> None:
    """Write polylines as DXF (R2010), whole or not at all; a layer for each name, the CRS in a custom property."""
    require_drawable(path, crs)
    unit = horizontal_unit(crs)
    ezdxf = library_for(path, "ezdxf", "dxf", to_write=True)
    drawing = ezdxf.new("R2010")
    codes = (code for code, length in UNITS_OF_DRAWINGS.items() if abs(length / unit - 1.0) < 1e-9)
    drawing.header["$INSUNITS"] = next(codes, 0)
    drawing.header.custom_vars.append("made_by", "bathynerf")
    drawing.header.custom_vars.append("crs", crs_code(crs) or crs_name(crs))
    space = drawing.modelspace()
    if lines:
        places = np.concatenate([line.places for line in lines])
        space.reset_extents(places.min(axis=0).tolist(), places.max(axis=0).tolist())
    for line in lines:
        layer = _NOT_IN_NAMES.sub("_", line.layer)
        if layer not in drawing.layers:
            drawing.layers.add(layer)
        is_ring = len(line.places) > 3 and bool((line.places[0] == line.places[-1]).all())
        places = line.places[:-1] if is_ring else line.places
        space.add_polyline3d(places.tolist(), close=is_ring, dxfattribs={"layer": layer})
    text = io.StringIO()
    drawing.write(text)
    with write_whole(path) as stream:
        stream.write(text.getvalue().encode(drawing.output_encoding, errors="dxfreplace"))
