"""Lines and polygons of vector files: layers, units of drawings, closed lines, parts, and what misses the cloud."""

import json
import re

import ezdxf
import numpy as np
import pyogrio
import pytest
import shapely
from pyproj import CRS

from geo.errors import UnreadableFile
from geo.features import UNITS_OF_DRAWINGS, assumed_crs, layer_of, read_lines, read_polygons
from geo.vectors import DxfLine, write_dxf

pytestmark = pytest.mark.filterwarnings("ignore:.*crs.*:UserWarning")
UTM = CRS("EPSG:25832+7837")
CORNER = np.array([676_114.0, 5_311_474.0])
OPPOSITE = np.array([676_117.0, 5_311_476.0])
AROUND = np.array([CORNER, CORNER + 12.0])
BOX = shapely.box(*CORNER, *OPPOSITE)
LINE = shapely.LineString([CORNER, OPPOSITE])


def layers_in(path, **layers):
    """A GeoPackage with layers of one geometry each; None: a table without geometries."""
    for name, geometry in layers.items():
        pyogrio.raw.write(
            path,
            geometry=None if geometry is None else np.array([shapely.to_wkb(geometry)], dtype=object),
            field_data=[np.array([name])], fields=np.array(["name"], dtype=object), driver="GPKG", layer=name,
            geometry_type=None if geometry is None else geometry.geom_type, crs="EPSG:25832", append=path.exists(),
        )  # fmt: skip
    return path


@pytest.mark.parametrize("form", ["{}:dredged", "{}|layername=dredged"])
def test_the_layer_that_is_named_is_read(tmp_path, form):
    path = layers_in(tmp_path / "plan.gpkg", outline=BOX.buffer(9.0), dredged=BOX)
    (polygon,) = read_polygons(form.format(path), UTM, AROUND).values()
    assert polygon.area == pytest.approx(6.0)


@pytest.mark.parametrize(
    ("named", "words"),
    [
        ("", "has 2 layers, outline (Polygon), cuts (LineString); name the one that counts, as plan.gpkg:outline."),
        (":dredge", "has no layer dredge, expected one of outline (Polygon), cuts (LineString)."),
    ],
)
@pytest.mark.parametrize("read", [read_lines, read_polygons])
def test_of_several_layers_none_is_taken_silently(tmp_path, read, named, words):
    path = layers_in(tmp_path / "plan.gpkg", outline=BOX, cuts=LINE)
    with pytest.raises(UnreadableFile, match=re.escape(words)):
        read(f"{path}{named}", UTM, AROUND)


def test_tables_without_geometries_do_not_count_as_layers(tmp_path):
    path = layers_in(tmp_path / "plan.gpkg", cuts=LINE, layer_styles=None)
    assert [line.name for line in read_lines(path, UTM, AROUND)] == ["cuts"]
    with pytest.raises(UnreadableFile, match="has no layer of points, lines or polygons"):
        read_lines(layers_in(tmp_path / "none.gpkg", layer_styles=None), UTM, AROUND)


def test_geojson_without_a_crs_is_said_to_be_in_wgs84_where_that_cannot_be(tmp_path):
    path = tmp_path / "a.geojson"
    path.write_text(shapely.to_geojson(LINE))
    with pytest.raises(UnreadableFile, match="GeoJSON without a crs, is taken as longitude and latitude of WGS 84"):
        read_lines(path, UTM, AROUND)


def test_a_file_whose_name_looks_like_a_layer_is_a_file(tmp_path):
    path = tmp_path / "a.gpkg:b"
    assert layer_of(path) == (tmp_path / "a.gpkg", "b")
    path.write_bytes(b"")
    assert layer_of(path) == (path, None)


def drawing(path, places, unit, *, closed=False):
    made = ezdxf.new("R2010")
    made.header["$INSUNITS"] = unit
    made.modelspace().add_lwpolyline([tuple(place) for place in places], close=closed)
    made.saveas(path)
    return path


@pytest.mark.parametrize("code", [0, *UNITS_OF_DRAWINGS])
@pytest.mark.parametrize("is_meant", [True, False])
def test_a_drawing_is_converted_where_it_lies_over_the_cloud_only_then(tmp_path, code, is_meant):
    """CAD templates state inches or millimetres for coordinates in metres."""
    unit = UNITS_OF_DRAWINGS.get(code, 1.0)
    places = np.array(LINE.coords) / (unit if is_meant else 1.0)
    (line,) = read_lines(drawing(tmp_path / "a.dxf", places, code), UTM, AROUND)
    np.testing.assert_allclose(line.corners, LINE.coords, atol=1e-6)


@pytest.mark.parametrize("suffix", ["dxf", "geojson", "gpkg"])
def test_a_closed_line_is_an_area(tmp_path, suffix):
    path, ring = tmp_path / f"a.{suffix}", shapely.LineString(BOX.exterior.coords)
    if suffix == "dxf":
        drawing(path, ring.coords[:-1], 6, closed=True)
    elif suffix == "gpkg":
        layers_in(path, area=ring)
    else:
        named = {"type": "name", "properties": {"name": "EPSG:25832"}}
        path.write_text(json.dumps({**json.loads(shapely.to_geojson(ring)), "crs": named}))
    (polygon,) = read_polygons(path, UTM, AROUND).values()
    assert polygon.area == pytest.approx(6.0)
    with pytest.raises(UnreadableFile, match="no polygon and no closed line"):
        read_polygons(drawing(tmp_path / "open.dxf", LINE.coords, 6), UTM, AROUND)


def test_rings_are_written_closed_and_a_drawing_has_its_extent(tmp_path):
    ring = np.column_stack([np.array(BOX.exterior.coords), np.full(5, 580.0)])
    line = np.column_stack([np.array(LINE.coords), [581.0, 582.0]])
    write_dxf(tmp_path / "a.dxf", [DxfLine("bed", ring), DxfLine("bed", line)], UTM)
    made = ezdxf.readfile(tmp_path / "a.dxf")
    assert [(len(each.vertices), each.is_closed) for each in made.modelspace()] == [(4, True), (2, False)]
    np.testing.assert_allclose(made.header["$EXTMIN"], [*CORNER, 580.0])
    np.testing.assert_allclose(made.header["$EXTMAX"], [*OPPOSITE, 582.0])
    (polygon,) = read_polygons(tmp_path / "a.dxf", UTM, AROUND).values()
    assert polygon.area == pytest.approx(6.0)


@pytest.mark.parametrize("crs", [None, {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}])
def test_that_geojson_without_a_crs_is_taken_as_wgs84_is_said(tmp_path, crs):
    content = {"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": {}, "geometry": shapely.geometry.mapping(LINE)}
    ]}  # fmt: skip
    (tmp_path / "a.geojson").write_text(json.dumps(content if crs is None else content | {"crs": crs}))
    assert [text[:24] for text in assumed_crs(tmp_path / "a.geojson")] == ["a.geojson names no CRS: "] * (crs is None)
    assert assumed_crs(layers_in(tmp_path / "a.gpkg", line=LINE)) == []
