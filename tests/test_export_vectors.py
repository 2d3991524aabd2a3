"""Lines and areas of a run: where they lie by the drawn plane, read by other libraries than those that wrote them."""

import json
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import ezdxf
import laspy
import numpy as np
import pyogrio.raw
import pytest
from pyproj import CRS, Transformer
from small_bed import SLOPE
from small_survey import small_survey
from stored_run import plane_stored, run_of

from geo.errors import UnwritableFile
from geo.vectors import DxfLine, Layer, write_dxf, write_geojson, write_geopackage, write_shapefile
from survey.errors import SurveyError
from survey.export.export import export
from survey.export.loaded import LoadedRun
from survey.export.registry import ExportOptions
from survey.export.vectors import ONE_VIEW, TWO_VIEWS, seen_of, unseen_of
from survey.folder.survey import load_survey
from survey.progress import Progress
from survey.report.seen_cells import DELETED, GLINT, code_at
from survey.run.edits import Edits
from survey.run.flight import load_flight, save_flight
from survey.run.folder import GAPS
from survey.run.stored import save_arrays
from survey.water.surface import curvature_drop, plane_under, still_water

TO_CRS = Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True)
# Cells of 0.2 m on the rim of the hole have points in one half only.
RIM_M = 0.5 * 0.2 * SLOPE
# The level surface falls by so much over the survey, and LAS rounds to 1 mm.
LEVEL_M = 1.1e-3
HOLE_AT, HOLE_M = np.array([1.0, -1.0]), 1.0


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    """A survey over a plane that rises out of the water, and a run in whose cloud is a hole under water."""
    folder = tmp_path_factory.mktemp("vectors")
    stored = plane_stored(folder / "small")
    survey = load_survey(small_survey(folder / "small"))
    keep = np.linalg.norm(stored.bed.xyz[:, :2] - HOLE_AT, axis=1) > HOLE_M
    common = np.full(int(keep.sum()), 0.004, dtype=np.float32)
    holed = replace(stored, bed=stored.bed[keep], points_crs=stored.points_crs[keep], std_common=common)
    path = run_of(holed, folder / "run")
    save_flight(path, survey)
    return path, survey


def lines_of(path, survey) -> tuple[list[np.ndarray], list[dict]]:
    """The lines, or outer rings, of a GeoJSON in plan [m], local, and the properties."""
    said = json.loads(path.read_text(encoding="utf-8"))
    lines = []
    for feature in said["features"]:
        coordinates = feature["geometry"]["coordinates"]
        degrees = np.array(coordinates[0] if feature["geometry"]["type"] == "Polygon" else coordinates)
        assert np.allclose(degrees.mean(axis=0), [10.168, 46.9], atol=0.01), "longitude first"
        plan = np.column_stack(TO_CRS.transform(*degrees.T))
        lines.append(survey.frame.local_from_crs(np.column_stack([plan, np.full(len(plan), 2105.0)]))[:, :2])
    return lines, [feature["properties"] for feature in said["features"]]


def test_the_shoreline_is_where_the_plane_meets_the_water(block, tmp_path):
    path, survey = block
    export(path, options=ExportOptions(resolution_m=0.2), shoreline=tmp_path / "s.geojson")
    lines, _ = lines_of(tmp_path / "s.geojson", survey)
    assert len(lines) == 1
    np.testing.assert_allclose(lines[0][:, 0], 0.3 / SLOPE, atol=0.01)
    assert np.ptp(lines[0][:, 1]) > 13.0


def test_a_drawing_has_the_shoreline_at_the_height_of_the_water(block, tmp_path):
    path, survey = block
    export(path, options=ExportOptions(resolution_m=0.2), shoreline=tmp_path / "s.dxf")
    drawing = ezdxf.readfile(tmp_path / "s.dxf")
    assert drawing.header["$INSUNITS"] == 6
    assert drawing.header.custom_vars.get("crs") == "EPSG:25832+5778"
    (line,) = drawing.modelspace().query('POLYLINE[layer=="shoreline"]')
    places = np.array([vertex.dxf.location for vertex in line.vertices])
    np.testing.assert_allclose(survey.frame.local_from_crs(places)[:, 0], 0.3 / SLOPE, atol=0.01)
    np.testing.assert_allclose(places[:, 2], survey.config.water.level_m, atol=LEVEL_M)
    # It is replaced, and a drawing of somebody else is not.
    export(path, options=ExportOptions(resolution_m=0.4), shoreline=tmp_path / "s.dxf")
    ezdxf.new().saveas(tmp_path / "mine.dxf")
    with pytest.raises(SurveyError, match=r"mine\.dxf"):
        export(path, shoreline=tmp_path / "mine.dxf")


def test_a_shapefile_of_contours_has_heights_and_the_crs(block, tmp_path):
    path, survey = block
    options = ExportOptions(resolution_m=0.2, interval_m=0.1)
    export(path, options=options, contours=tmp_path / "c.shp.zip")
    meta, _, shapes, columns = pyogrio.raw.read(f"/vsizip/{tmp_path / 'c.shp.zip'}")
    assert (CRS(meta["crs"]).to_epsg(), meta["geometry_type"], list(meta["fields"])) == (
        25832, "LineString Z", ["depth_m"],
    )  # fmt: skip
    for shape, depth in zip(shapes, columns[0], strict=True):
        heights = np.frombuffer(shape[9:], "<f8").reshape(-1, 3)[:, 2]
        np.testing.assert_allclose(heights, survey.config.water.level_m - depth, atol=LEVEL_M)


@pytest.mark.parametrize(("crs", "said"), [("EPSG:4258+5778", "in degrees"), ("EPSG:2263+5703", "one unit")])
def test_a_drawing_needs_one_unit_of_length(tmp_path, crs, said):
    with pytest.raises(UnwritableFile, match=said):
        write_dxf(tmp_path / "x.dxf", [DxfLine("a", np.zeros((2, 3)))], CRS(crs))


def test_a_drawing_in_feet_says_so(tmp_path):
    write_dxf(tmp_path / "x.dxf", [DxfLine("a/b", np.eye(3))], CRS("EPSG:2263+6360"))
    drawing = ezdxf.readfile(tmp_path / "x.dxf")
    assert drawing.header["$INSUNITS"] == 21
    assert "a_b" in drawing.layers


@pytest.mark.parametrize(("unit", "number"), [("km", 7), ("m", 6), ("ft", 2), ("us-ft", 21), ("ind-ft", 0)])
def test_a_drawing_has_the_number_of_its_unit_and_none_where_there_is_none(tmp_path, unit, number):
    crs = CRS(f"+proj=utm +zone=32 +datum=WGS84 +units={unit} +vunits={unit} +no_defs")
    write_dxf(tmp_path / "x.dxf", [DxfLine("a", np.eye(3))], crs)
    assert ezdxf.readfile(tmp_path / "x.dxf").header["$INSUNITS"] == number


CRS_OF_FILES = ["EPSG:25832+5778", "EPSG:2264+6360", "EPSG:31256", "EPSG:27700", "EPSG:2056", "EPSG:4326", "EPSG:3857"]


@pytest.mark.parametrize("write", [write_geopackage, write_shapefile])
@pytest.mark.parametrize("crs", [*CRS_OF_FILES, "+proj=tmerc +lon_0=11 +x_0=1000 +ellps=GRS80 +units=m +no_defs"])
def test_a_layer_of_any_crs_reads_as_it_was_written(tmp_path, write, crs):
    pytest.importorskip("pyogrio")
    line = np.array([[1.0, 2.0], [3.0, 5.0]])
    layer = Layer("contours", "LineString", [line], CRS(crs), {"depth_m": [1.5]}, heights=[np.array([1.0, 2.0])])
    write(tmp_path / "x", layer)
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


@pytest.mark.parametrize("write", [write_geopackage, write_shapefile])
@pytest.mark.parametrize("error", [RuntimeError("disk"), ValueError("field"), OSError("gone")])
def test_what_gdal_refuses_is_an_error_of_the_file(tmp_path, monkeypatch, write, error):
    def refused(*args, **kwargs):
        raise error

    layer = Layer("a", "LineString", [np.eye(2)], CRS("EPSG:25832"), {"depth_m": [1.0]})
    with pytest.raises(UnwritableFile, match=r"cannot write .*nowhere.*folder does not exist"):
        write(tmp_path / "nowhere" / "x", layer)
    monkeypatch.setattr(pyogrio.raw, "write", refused)
    with pytest.raises(UnwritableFile, match=rf"cannot write .*x: .*{error}"):
        write(tmp_path / "x", layer)
    assert list(tmp_path.iterdir()) == []


def test_contours_have_the_depth_of_the_plane_and_the_interval_that_was_asked_for(block, tmp_path):
    path, survey = block
    options = ExportOptions(resolution_m=0.2, interval_m=0.05)
    export(path, options=options, contours=tmp_path / "c.geojson")
    lines, said = lines_of(tmp_path / "c.geojson", survey)
    assert sorted({entry["depth_m"] for entry in said}) == pytest.approx(np.arange(13) * 0.05)
    for line, entry in zip(lines, said, strict=True):
        np.testing.assert_allclose(0.3 - SLOPE * line[:, 0], entry["depth_m"], atol=RIM_M)
    # Around the hole a line ends, and goes on behind it.
    assert sum(entry["depth_m"] == 0.4 for entry in said) == 1
    assert sum(entry["depth_m"] == 0.25 for entry in said) == 2
    with pytest.raises(SurveyError, match="--interval is -1, expected metres between contours"):
        export(path, options=replace(options, interval_m=-1.0), contours=tmp_path / "d.geojson")
    with pytest.raises(SurveyError, match=r"--interval 1e-09 makes over 1000 contours.*; give a larger one"):
        export(path, options=replace(options, interval_m=1e-9), contours=tmp_path / "d.geojson")
    export(path, options=ExportOptions(resolution_m=0.2), contours=tmp_path / "c.geojson")
    _, said = lines_of(tmp_path / "c.geojson", survey)
    assert 5 <= len({entry["depth_m"] for entry in said}) <= 20


def test_a_footprint_is_where_the_border_of_the_photograph_projects_from(block, tmp_path):
    path, survey = block
    export(path, footprints=tmp_path / "f.geojson")
    rings, said = lines_of(tmp_path / "f.geojson", survey)
    assert [entry["image"] for entry in said] == [view.name for view in survey.views]
    for ring, view in zip(rings, survey.views, strict=True):
        inner = ring[np.abs(ring).max(axis=1) < 6.5]
        pixels = view.camera.project(np.column_stack([inner, SLOPE * inner[:, 0] - 0.3]), survey.water)
        w, h = view.camera.width, view.camera.height
        to_border = np.min(
            [np.abs(pixels[:, 0]), np.abs(pixels[:, 0] - w), np.abs(pixels[:, 1]), np.abs(pixels[:, 1] - h)], 0
        )
        # Heights are those of cells of 0.2 m: half a cell of slope moves a place at 18 degrees by 1.5 mm.
        assert to_border.max() < 0.03
    # 12.8 m by 9.6 m at the water, and a little more below it.
    assert said[0]["area_m2"] == pytest.approx(12.8 * 9.6 * (1.0 + 0.3 / 1.333 / 20.0) ** 2, rel=0.01)


def test_where_no_bed_was_seen_is_a_polygon_a_mask_and_classes_of_las(block, tmp_path):
    path, survey = block
    export(path, unseen=tmp_path / "u.geojson")
    rings, said = lines_of(tmp_path / "u.geojson", survey)
    hole = [n for n, ring in enumerate(rings) if np.linalg.norm(ring.mean(axis=0) - HOLE_AT) < 0.5]
    assert len(hole) == 1
    assert said[hole[0]]["views"] == "two or more"
    # Cells that touch a point on the rim are not empty: a ring of up to one cell of 0.2 m is missing.
    assert np.pi * (HOLE_M - 0.3) ** 2 < said[hole[0]]["area_m2"] < np.pi * HOLE_M**2
    with LoadedRun(path) as run:
        cells, codes, frame = seen_of(run), unseen_of(run), run.flight.frame
        places = survey.frame.crs_from_local([[*HOLE_AT, 0.0], [-3.0, 2.0, 0.0], [500.0, 0.0, 0.0]])
        assert code_at(cells.grid, codes, places[:, :2], frame).tolist() == [TWO_VIEWS, 0, 0]
        number = int((codes > 0).sum())
        assert (codes == ONE_VIEW).any()
        assert not (codes[cells.middles[..., 0] > 0.5 + 0.3 / SLOPE] > 0).any(), "dry ground is not water"
    export(path, options=ExportOptions(no_bed=True), copc=tmp_path / "u.copc.laz", las=tmp_path / "u.las")
    for name in ("u.copc.laz", "u.las"):
        las = laspy.read(tmp_path / name)
        classes = np.asarray(las.classification)
        assert ((classes == 45).sum(), (classes == 41).sum()) == (number, number)
        for column in ("depth", "std", "std_common", "incidence"):
            assert ((np.asarray(las[column]) == -9999.0) == (classes > 40)).all(), column
        np.testing.assert_allclose(np.asarray(las.z)[classes > 40], 2105.0, atol=2e-3)
        east, north = (np.asarray(v)[classes == 45] for v in (las.x, las.y))
        local = survey.frame.local_from_crs(np.column_stack([east, north, np.full(number, 2105.0)]))
        assert (np.linalg.norm(local[:, :2] - HOLE_AT, axis=1) < 0.1).any()


def test_gaps_have_the_reasons_of_the_run_and_those_of_edits(block, tmp_path):
    rasterio = pytest.importorskip("rasterio")
    path, survey = block
    copy = Path(shutil.copytree(path, tmp_path / "run"))
    with LoadedRun(copy) as run:
        cells = seen_of(run)
    codes = np.where(cells.gaps == TWO_VIEWS, GLINT, cells.gaps)
    save_arrays(copy / GAPS, codes=codes, origin=np.array(cells.grid.origin), side=np.array(cells.grid.side_m))
    edits, around = Edits(copy), np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    away = survey.frame.crs_from_local(np.column_stack([around + np.array([3.0, -2.0]), np.zeros(4)]))
    edits.delete(edits.inside(away[:, :2]))
    export(copy, gaps=tmp_path / "g.tif", unseen=tmp_path / "u.geojson")
    with rasterio.open(tmp_path / "g.tif") as raster:
        places = survey.frame.crs_from_local([[*HOLE_AT, 0.0], [3.0, -2.0, 0.0], [-3.0, 2.0, 0.0]])
        assert [int(value[0]) for value in raster.sample(places[:, :2])] == [GLINT, DELETED, 0]
        area_m2 = float(raster.tags()[f"AREA_{DELETED}_M2"])
    assert 0.5 < area_m2 < 1.0  # cells that touch a point on the rim are not empty
    assert "glint: white in the views" in {said["reason"] for said in lines_of(tmp_path / "u.geojson", survey)[1]}


def test_a_geopackage_has_its_crs_and_is_read_without_the_library_that_wrote_it(block, tmp_path):
    pytest.importorskip("pyogrio", reason="pyogrio is not installed: pip install 'bathynerf[vector]'")
    path, survey = block
    for _ in range(2):  # an earlier one is replaced
        export(path, footprints=tmp_path / "f.gpkg")
    with sqlite3.connect(tmp_path / "f.gpkg") as database:
        contents = database.execute("select table_name, identifier, srs_id, min_x, max_y from gpkg_contents").fetchall()
        images = [row[0] for row in database.execute("select image from footprints")]
        systems = database.execute("select organization from gpkg_spatial_ref_sys where srs_id = 25832").fetchall()
        (shape,) = database.execute("select geom from footprints").fetchone()
    database.close()
    assert contents[0][:3] == ("footprints", "bathynerf footprints", 25832)
    assert [row[0].upper() for row in systems] == ["EPSG"]
    assert images == [view.name for view in survey.views]
    assert abs(contents[0][3] - 589005.6) < 0.2
    assert shape[:2] == b"GP"


def test_another_library_reads_the_geojson(block, tmp_path):
    pyogrio = pytest.importorskip("pyogrio", reason="pyogrio is not installed: pip install 'bathynerf[vector]'")
    path, survey = block
    export(path, footprints=tmp_path / "f.geojson")
    info = pyogrio.read_info(tmp_path / "f.geojson")
    assert CRS(info["crs"]) == CRS("EPSG:4326")
    assert (info["features"], info["geometry_type"]) == (len(survey.views), "Polygon")


def test_rings_of_polygons_are_wound_as_rfc_7946_wants_them(tmp_path):
    square = np.array([[0.0, 0], [0, 1], [1, 1], [1, 0], [0, 0]])
    layer = Layer("a", "Polygon", [[9.0 + square, 9.25 + 0.5 * square[::-1]]], CRS("EPSG:4326"), {"name": ["é"]})
    write_geojson(tmp_path / "a.geojson", layer)
    said = json.loads((tmp_path / "a.geojson").read_text(encoding="utf-8"))
    outer, inner = (np.array(ring) for ring in said["features"][0]["geometry"]["coordinates"])
    areas = [float((r[:-1, 0] * r[1:, 1] - r[1:, 0] * r[:-1, 1]).sum()) for r in (outer - 9.0, inner - 9.0)]
    assert areas[0] > 0.0 > areas[1]
    assert said["features"][0]["properties"] == {"name": "é"}


@pytest.mark.parametrize("suffix", ["geojson", "gpkg"])
def test_a_layer_without_features_is_a_whole_file(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    layer = Layer("shoreline", "LineString", [], CRS("EPSG:25832+5778"), {"depth_m": []})
    if suffix == "gpkg":
        pytest.importorskip("pyogrio")
        write_geopackage(path, layer)
        with sqlite3.connect(path) as database:
            assert database.execute("select count(*) from shoreline").fetchone() == (0,)
        database.close()
    else:
        write_geojson(path, layer)
        assert json.loads(path.read_text(encoding="utf-8"))["features"] == []


def test_a_layer_without_features_is_said_to_be_empty(tmp_path, capsys):
    stored = plane_stored(tmp_path / "small")
    deep = stored.bed.depth > 0.2
    path = run_of(replace(stored, bed=stored.bed[deep], points_crs=stored.points_crs[deep]), tmp_path / "run")
    with Progress(verbosity=0):
        export(path, options=ExportOptions(resolution_m=0.2), shoreline=tmp_path / "s.geojson")
    assert "s.geojson: nothing to show, the layer shoreline is empty" in capsys.readouterr().err
    assert json.loads((tmp_path / "s.geojson").read_text(encoding="utf-8"))["features"] == []


def test_a_dry_survey_has_contours_of_height_and_no_shoreline(tmp_path):
    stored = plane_stored(tmp_path / "small")
    dry = replace(stored, bed=replace(stored.bed, depth=np.full(len(stored.bed), np.nan, np.float32)))
    path = run_of(dry, tmp_path / "run")
    export(path, options=ExportOptions(resolution_m=0.2), contours=tmp_path / "c.geojson")
    said = json.loads((tmp_path / "c.geojson").read_text(encoding="utf-8"))
    heights = [feature["properties"]["height_m"] for feature in said["features"]]
    assert 2104.0 < min(heights) < max(heights) < 2105.1
    with pytest.raises(SurveyError, match="is a dry survey and has no shoreline; leave --shoreline out"):
        export(path, shoreline=tmp_path / "s.geojson")


def test_the_water_of_a_run_of_kilometres_follows_the_earth(block, tmp_path):
    _, survey = block
    reached = np.array([[-100.0, 0.0, 80.0], [8000.0, 0.0, 80.0]])
    departure = still_water(survey.frame, survey.water, reached)
    save_flight(tmp_path, replace(survey, observations=replace(survey.observations, departure=departure)))
    flight = load_flight(tmp_path)
    crs = survey.frame.crs_from_local([8000.0, 0.0, -curvature_drop(8000.0)])
    there = survey.frame.local_from_crs([*crs[:2], 2105.0])
    assert flight.level(there[None, :2])[0] == pytest.approx(there[2], abs=1e-3)
    # A camera 5 m over the water there lies in the plane that touches the water at the origin.
    camera = replace(survey.views[0].camera, centre=np.add(there, (0.0, 0.0, 5.0)))
    under = plane_under(flight.water, flight.departure, camera.centre)
    assert under.height(*there[:2]) == pytest.approx(there[2], abs=1e-3)
    assert (under.slope_x - flight.water.slope_x) == pytest.approx(-2.0 * curvature_drop(8000.0) / 8000.0, rel=0.01)


@pytest.mark.parametrize("suffix", ["gpkg", "geojson", "dxf"])
def test_a_layer_that_somebody_edited_is_kept_and_one_that_was_looked_at_is_replaced(block, tmp_path, suffix):
    path, file = block[0], tmp_path / f"c.{suffix}"
    export(path, options=ExportOptions(resolution_m=0.2), contours=file)
    if suffix == "gpkg":
        # As QGIS does that only shows it.
        with sqlite3.connect(file) as database:
            database.execute("pragma journal_mode = wal")
        database.close()
    export(path, options=ExportOptions(resolution_m=0.4), contours=file)
    if suffix == "gpkg":
        with sqlite3.connect(file) as database:
            database.execute("create table notes (text)")
        database.close()
    else:
        file.write_text(file.read_text().replace("contours", "depths"))
    with pytest.raises(SurveyError, match="which somebody has changed since bathynerf wrote it"):
        export(path, options=ExportOptions(resolution_m=0.2), contours=file)
