"""Features, lines and polygons of vector files: GeoJSON (RFC 7946 and older), GeoPackage, shapefile, DXF, KML, GPX."""

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar
from xml.etree import ElementTree

import numpy as np
import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError
from shapely.errors import ShapelyError
from shapely.geometry import LineString, Point, Polygon, shape
from shapely.geometry.base import BaseGeometry, BaseMultipartGeometry

from geo.crs import horizontal_crs, horizontal_unit
from geo.errors import UnreadableFile
from geo.files import existing_file, library_for
from geo.grid import Grid
from geo.transformation import WGS84, transformed

GEOJSON = (".geojson", ".json")
_MARKUP = (".kml", ".gpx")
SUFFIXES = (*GEOJSON, ".gpkg", ".shp", ".dxf", *_MARKUP)

# A file, and the name of a layer behind it.
_WITH_LAYER = re.compile(r"(.+\.[A-Za-z]{3,4})(?:\|layername=|:)([^/\\]+)")
# GDAL goes by content, and some of its formats (VRT, services of maps) name other files and addresses, which it reads.
# How files of vectors begin: pyogrio offers no choice of drivers. A DXF begins with a group of its first section, or
# with comments.
_BEGINNINGS = {
    ".gpkg": rb"SQLite format 3\x00",
    ".shp": rb"\x00\x00\x27\x0a",
    ".dxf": rb"AutoCAD Binary DXF\r\n\x1a\x00|(\xef\xbb\xbf)?(\s*999[^\S\n]*\n[^\n]*\n)*\s*0\s+SECTION\b",
}
# Drivers that go by a tag of XML find it anywhere at the beginning.
_TAG = re.compile(rb"<[A-Za-z?!]")
_LOOKED_AT_BYTES = 1 << 16
# $INSUNITS of DXF: lengths [m] by number.
UNITS_OF_DRAWINGS = {
    1: 0.0254, 2: 0.3048, 4: 0.001, 5: 0.01, 6: 1.0, 7: 1000.0, 10: 0.9144, 14: 0.1, 21: 1200.0 / 3937.0,
}  # fmt: skip
_UNIT_OF_DRAWING = re.compile(rb"\$INSUNITS\s+70\s+(\d+)")
_HEAD_BYTES = 1 << 16
# What content of another form raises in `json`, `shapely` and pyogrio.
_FAULTS = (
    ShapelyError, CRSError, ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError,
    RuntimeError, OSError,
)  # fmt: skip


@dataclass(frozen=True)
class Feature:
    geometry: BaseGeometry  # Easting or longitude first
    properties: dict[str, Any]  # With the layer of a drawing and the folder of KML as "layer"

    @property
    def layer(self) -> str:
        """The layer by its attributes; empty for none."""
        named = (str(value) for name, value in self.properties.items() if str(name).casefold() == "layer" and value)
        return next(named, "")

    def parts(self) -> Iterator[BaseGeometry]:
        """The points, lines and polygons that the geometry consists of."""
        if isinstance(self.geometry, BaseMultipartGeometry):
            for each in self.geometry.geoms:
                yield from replace(self, geometry=each).parts()
        elif not self.geometry.is_empty:
            yield self.geometry


@dataclass(frozen=True)
class Features:
    """Content of a vector file."""

    features: tuple[Feature, ...]
    crs: CRS | None  # None where the file states none
    unit_m: float | None = None  # [m]: of a drawing that states one


def layer_of(path: str | Path) -> tuple[Path, str | None]:
    """A file and the layer in it that ``FILE|layername=LAYER``, as QGIS writes it, or ``FILE:LAYER`` names.

    >>> layer_of("plan.gpkg|layername=dredged")[1], layer_of("plan.gpkg:dredged")[1], layer_of("plan.gpkg")[1]
    ('dredged', 'dredged', None)
    """
    named = _WITH_LAYER.fullmatch(str(path))
    return (Path(path), None) if named is None or Path(path).exists() else (Path(named[1]), named[2])


def layers_of(path: Path) -> list[str | None]:
    """The layers with geometries of a GeoPackage; None alone for other files, whose features say their layer."""
    if existing_file(path).suffix.lower() != ".gpkg":
        return [None]
    try:
        return list(_kinds(path))
    except RuntimeError as error:
        raise UnreadableFile(f"{path} has no layers that can be read ({str(error)[:80]}); export it again.") from error


def _kinds(path: Path) -> dict[str, str]:
    """Kinds of geometries by layer, of those that have geometries."""
    layers = vector_library(path).list_layers(path.absolute()).tolist()
    return {str(name): str(kind) for name, kind in layers if kind is not None}


def read_features(path: str | Path, kind: str, layer: str | None = None) -> Features:
    """All features of a vector file, of one layer, which the path may name, too; errors name the expected ``kind``."""
    path, named = layer_of(path)
    path, layer = existing_file(path), layer or named
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        known = ", ".join(("", *SUFFIXES[2:]))
        raise UnreadableFile(f'{path} has the suffix "{path.suffix}", expected {kind} as one of {GEOJSON[0]}{known}.')
    try:
        if suffix in _MARKUP:
            content = Features(tuple(_of_markup(path)), WGS84)
        else:
            content = _of_geojson(path) if suffix in GEOJSON else _by_gdal(path, layer)
        if not all(np.isfinite(shapely.get_coordinates(feature.geometry)).all() for feature in content.features):
            raise ValueError("coordinates that are not finite")
    except UnreadableFile:
        raise
    except _FAULTS as error:
        reason = f"without the member {error}" if isinstance(error, KeyError) else " ".join(str(error).split())[:80]
        raise UnreadableFile(f"{path} has no {kind} that can be read ({reason}); export it again.") from error
    return content


def in_horizontal_crs(geometry: BaseGeometry, source: CRS, target: CRS, path: Path | str) -> BaseGeometry:
    """A geometry of a file, in plan, transformed to another horizontal CRS."""
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


def _of_markup(path: Path) -> Iterator[Feature]:
    """The placemarks of KML, or waypoints, routes and tracks of GPX, with their names."""
    text = path.read_text(encoding="utf-8-sig")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise UnreadableFile(f"{path} has a document type, expected none; remove it, or export the file again.")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise UnreadableFile(f"{path} is not well-formed XML ({error}); export it again.") from error
    for element in root.iter():
        # Without the namespace, of which versions differ.
        element.tag = str(element.tag).rpartition("}")[2]
    suffix = path.suffix.lower()
    if f".{root.tag}" != suffix:
        raise UnreadableFile(f"{path} begins with <{root.tag[:40]}>, expected <{suffix[1:]}>; export it again.")
    # Of folders in each other the inner one counts, which comes later.
    pairs = [(item, folder.findtext("name")) for folder in root.iter("Folder") for item in folder.iter("Placemark")]
    folders = {item: (name or "").strip() for item, name in pairs}
    for item in root.iter():
        named = {"name": (item.findtext("name") or "").strip(), "layer": folders.get(item, "")}
        if item.tag == "Placemark":
            geometries = [_of_kml(part) for part in item.iter() if part.tag in ("Point", "LineString", "Polygon")]
        elif item.tag in ("wpt", "rte", "trk"):
            parts = [item] if item.tag != "trk" else list(item.iter("trkseg"))
            geometries = [_of_gpx(part) for part in parts]
        else:
            continue
        for geometry in geometries:
            yield Feature(geometry, named)


def _of_kml(part: ElementTree.Element) -> BaseGeometry:
    # Heights over the ground are none; without a mode programs write heights.
    is_flat = "ToGround" in (part.findtext("altitudeMode") or "")

    def corners(element: ElementTree.Element) -> list[tuple[float, ...]]:
        numbers = [tuple(map(float, one.split(","))) for one in (element.findtext("coordinates") or "").split()]
        if not numbers:
            raise ValueError("no coordinates")
        return [one[:2] if is_flat else one[:3] for one in numbers]

    if part.tag != "Polygon":
        return Point(corners(part)[0]) if part.tag == "Point" else LineString(corners(part))
    rings = [corners(ring) for side in ("outer", "inner") for ring in part.iterfind(f"{side}BoundaryIs/LinearRing")]
    return Polygon(rings[0], rings[1:])


def _of_gpx(part: ElementTree.Element) -> BaseGeometry:
    points = [part] if part.tag == "wpt" else [*part.iter("rtept"), *part.iter("trkpt")]
    places = [
        (float(p.attrib["lon"]), float(p.attrib["lat"]), *map(float, filter(None, [p.findtext("ele")]))) for p in points
    ]
    return Point(places[0]) if part.tag == "wpt" else LineString(places)


def vector_library(path: Path) -> ModuleType:
    """`pyogrio`, for a GeoPackage, shapefile or DXF that may be given to it."""
    library = library_for(path, "pyogrio", "vector")
    with path.open("rb") as stream:
        beginning = stream.read(_LOOKED_AT_BYTES)
    suffix = path.suffix.lower()
    is_foreign = suffix == ".dxf" and _TAG.search(beginning) is not None
    if is_foreign or re.match(_BEGINNINGS[suffix], beginning) is None:
        raise UnreadableFile(
            f"{path} does not begin as a file with the suffix {path.suffix} does; export it again in that format."
        )
    return library


def _by_gdal(path: Path, layer: str | None) -> Features:
    pyogrio = vector_library(path)
    meta, _, shapes, columns = pyogrio.raw.read(path.absolute(), layer=_layer(path, layer))
    values = zip(*(column.tolist() for column in columns), strict=True)
    rows = [dict(zip(meta["fields"], row, strict=True)) for row in values] or [{}] * len(shapes)
    # Solids and symbols of a drawing have no counterpart.
    geometries = shapely.from_wkb(shapes, on_invalid="ignore")
    features = (Feature(each, row) for each, row in zip(geometries, rows, strict=True) if each is not None)
    crs = None if meta["crs"] is None else CRS.from_user_input(meta["crs"])
    with path.open("rb") as stream:
        stated = _UNIT_OF_DRAWING.search(stream.read(_HEAD_BYTES)) if path.suffix.lower() == ".dxf" else None
    return Features(tuple(features), crs, None if stated is None else UNITS_OF_DRAWINGS.get(int(stated[1])))


def _layer(path: Path, layer: str | None) -> str:
    """The layer of a file to read: the one of that name, or the only one with geometries."""
    kinds = _kinds(path)
    if layer in kinds:
        return layer
    listed = ", ".join(f"{name} ({kind})" for name, kind in kinds.items())
    if layer is not None:
        raise UnreadableFile(f"{path} has no layer {layer[:80]}, expected one of {listed}.")
    if not kinds:
        raise UnreadableFile(f"{path} has no layer of points, lines or polygons; export one into it.")
    if len(kinds) > 1:
        raise UnreadableFile(
            f"{path} has {len(kinds)} layers, {listed}; name the one that counts, as {path.name}:{next(iter(kinds))}."
        )
    return next(iter(kinds))


_Shape = TypeVar("_Shape")
# Attributes that name a line, in any case; a DXF has layers.
_NAMES = ("name", "id", "line", "profile", "layer")
# Places of a ring, the first again as the last, that enclose nothing.
_FEWEST_OF_RING = 3


@dataclass(frozen=True)
class Line:
    """A line of two corners or more."""

    name: str  # By its attributes, else its number from 1
    corners: np.ndarray  # (N, 2): easting or longitude first


def read_lines(path: str | Path, crs: CRS, around: np.ndarray) -> list[Line]:
    """All lines of a file, or of a layer in it (`layer_of`), in the horizontal part of crs.

    GeoJSON has longitude and latitude of WGS 84, or the CRS that an older file names; a GeoPackage and a shapefile
    state their own; a DXF states none, and is taken to be in crs, as is a shapefile without .prj. A DXF in another unit
    than crs is converted where its coordinates lie around the cloud, of corners ``around`` (2, 2) in crs, only then:
    templates state units that nobody meant.
    """
    lines = [
        (_named(properties), np.array(line.coords))
        for line, properties in _in_crs(path, "lines", LineString, crs, around)
    ]
    if not lines:
        raise UnreadableFile(f"{path} has no line of two corners or more; draw the profile as a line.")
    return [Line(name, corners) for name, corners in _numbered(lines)]


def assumed_crs(path: str | Path) -> list[str]:
    """The sentence that WGS 84 is assumed, of GeoJSON that names no CRS; none of other files."""
    is_assumed = layer_of(path)[0].suffix.lower() in GEOJSON and read_features(path, "lines or polygons").crs is None
    return [f"{Path(path).name} names no CRS: taken as longitude and latitude of WGS 84 (RFC 7946)"] * is_assumed


def read_polygons(path: str | Path, crs: CRS, around: np.ndarray) -> dict[str, Polygon]:
    """All polygons of a file by name, and closed lines, a drawing's polygons; in crs as `read_lines` has them."""
    polygons = [
        (_named(properties), part if isinstance(part, Polygon) else Polygon(part))
        for part, properties in _in_crs(path, "polygons", (Polygon, LineString), crs, around)
        if isinstance(part, Polygon) or (part.is_closed and len(part.coords) > _FEWEST_OF_RING)
    ]
    if not polygons:
        raise UnreadableFile(
            f"{path} has no polygon and no closed line, expected one at least; draw the area as a polygon."
        )
    return dict(_numbered(polygons))


def cells_inside(polygons: Iterable[Polygon], grid: Grid) -> np.ndarray:
    """Whether the middle of each cell (rows, columns) lies in a polygon."""
    from rasterio.features import geometry_mask
    from rasterio.transform import Affine

    return geometry_mask(list(polygons), grid.shape, Affine(*grid.transform), invert=True)


def points_inside(polygons: Iterable[Polygon], points: np.ndarray) -> np.ndarray:
    """Whether each point (N, 2) lies in a polygon."""
    # Rings that cross themselves become those that the even-odd rule has.
    area = shapely.union_all([shapely.make_valid(polygon) for polygon in polygons])
    shapely.prepare(area)
    return shapely.contains_xy(area, points)


def _in_crs(
    path: str | Path, plural: str, kinds: type | tuple[type, ...], crs: CRS, around: np.ndarray
) -> list[tuple[Any, dict[str, Any]]]:
    content, path, target = read_features(path, plural), layer_of(path)[0], horizontal_crs(crs)
    unstated = WGS84 if path.suffix.lower() in GEOJSON else target
    source = unstated if content.crs is None else horizontal_crs(content.crs)
    is_assumed = content.crs is None and unstated is WGS84
    named = f"{path}, GeoJSON without a crs, is taken as longitude and latitude of WGS 84," if is_assumed else str(path)
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
    for name, (_, geometry) in zip(names, found, strict=True):
        numbers[name] += 1
        named.append((f"{name} {numbers[name]}" if name in several else name, geometry))
    return named


def _named(attributes: dict[str, Any]) -> str:
    by_name = {str(name).lower(): value for name, value in attributes.items() if value not in (None, "")}
    return next((str(by_name[name]) for name in _NAMES if name in by_name), "")
