"""Profiles of the bed along lines, and the formats that lines come in."""

import csv
import json
import re

import ezdxf
import numpy as np
import pyogrio.raw
import pytest
import shapely
from command_line import bathynerf
from pyproj import CRS, Transformer

from geo.crs import height_unit_m, horizontal_crs
from geo.errors import UnreadableFile
from geo.features import Line, read_lines
from geo.las import write_cloud
from survey.errors import SurveyError
from survey.export.profiles import COLUMNS, Bed, profiles_along, write_picture
from survey.progress import Progress

UTM = CRS("EPSG:25832+7837")
AROUND = np.array([[0.0, 0.0], [1e7, 1e7]])
# Of the plane: height in the middle, rise per metre east and north.
MIDDLE_M, EAST, NORTH, LEVEL_M = 100.0, 0.1, -0.05, 101.5
AT = {"EPSG:25832+7837": (589012.0, 5194736.0), "EPSG:2263+6360": (990000.0, 200000.0), "EPSG:4979": (10.2, 46.9)}
LINES = {"A-B": [[-4.0, -3.0], [0.0, 0.0], [4.0, 3.0]], "across": [[-12.0, 2.0], [12.0, 2.0]]}


def metres_of(code: str) -> np.ndarray:
    """One unit east and one north of the place of a CRS in metres on the ground."""
    if code != "EPSG:4979":
        return np.full(2, CRS(code).axis_info[0].unit_conversion_factor)
    lat = np.radians(AT[code][1])
    return np.radians(1.0) * np.array([6.3781e6 * np.cos(lat) / (1.0 - 0.0067 * np.sin(lat) ** 2) ** 0.5, 6.3698e6])


def places_of(code: str, plan_m) -> np.ndarray:
    """Places (N, 2) in a CRS from metres about its place."""
    return np.asarray(plan_m) / metres_of(code) + AT[code]


def plane_cloud(path, code="EPSG:25832+7837"):
    """A plane of 16 x 12 m with a point each 10 cm, under level water."""
    crs = CRS(code)
    plan = np.stack(np.meshgrid(np.arange(-8.0, 8.0, 0.1), np.arange(-6.0, 6.0, 0.1)), axis=-1).reshape(-1, 2)
    height = MIDDLE_M + plan @ [EAST, NORTH]
    points = np.column_stack([places_of(code, plan), height / height_unit_m(crs)])
    return las(path, points, crs, LEVEL_M - height)


def las(path, points: np.ndarray, crs: CRS, depth_m: np.ndarray):
    n = len(points)
    write_cloud(
        path, points, crs, rgb=np.full((n, 3), 100, np.uint8), depth_m=depth_m, std_m=np.full(n, 0.02),
        num_views=np.full(n, 5, np.uint8), incidence_deg=np.full(n, 10.0), is_wet=np.full(n, True),
        std_common_m=np.full(n, 0.01),
    )  # fmt: skip
    return path


@pytest.mark.parametrize("code", AT)
def test_a_profile_of_a_plane_is_the_plane_in_every_unit(tmp_path, code):
    bed = Bed(plane_cloud(tmp_path / "bed.las", code))
    profile = bed.along(Line("A-B", places_of(code, LINES["A-B"])), step_m=0.25)
    assert profile.distance == pytest.approx(np.arange(0.0, 10.01, 0.25), rel=2e-3)
    true = MIDDLE_M + profile.distance * (0.8 * EAST + 0.6 * NORTH) + np.array([-4.0, -3.0]) @ [EAST, NORTH]
    unit_m = height_unit_m(profile.crs)
    assert profile.bed * unit_m == pytest.approx(true, abs=0.01)
    assert profile.water * unit_m == pytest.approx(LEVEL_M, abs=2e-3)
    assert profile.depth == pytest.approx(LEVEL_M - true, abs=0.012)
    assert profile.std == pytest.approx(0.02, abs=1e-3)
    assert profile.std_common == pytest.approx(0.01, abs=1e-3)
    assert (profile.num_points > 5).all()
    assert np.isnan(profile.reference).all()


def test_where_there_are_no_points_nothing_is_said(tmp_path):
    profile = Bed(plane_cloud(tmp_path / "bed.las")).along(
        Line("across", places_of("EPSG:25832+7837", LINES["across"]))
    )
    beyond = np.abs(profile.distance - 12.0) > 8.3
    assert beyond.any()
    assert np.isnan(profile.bed[beyond]).all()
    assert np.isfinite(profile.bed[np.abs(profile.distance - 12.0) < 7.9]).all()
    assert profile.distance[-1] == pytest.approx(24.0)


@pytest.mark.parametrize("is_mesh", [True, False])
def test_a_reference_stands_beside_the_bed(tmp_path, is_mesh):
    cloud = plane_cloud(tmp_path / "bed.las")
    reference = tmp_path / ("truth.obj" if is_mesh else "truth.las")
    corners = np.array([[-9.0, -7.0], [9.0, -7.0], [9.0, 7.0], [-9.0, 7.0]])
    if is_mesh:
        heights = MIDDLE_M - 0.1 + corners @ [EAST, NORTH]
        vertices = np.column_stack([places_of("EPSG:25832+7837", corners), heights])
        lines = [f"v {east:.3f} {north:.3f} {height:.6f}" for east, north, height in vertices]
        reference.write_text("\n".join([*lines, "f 1 2 3", "f 1 3 4"]))
    else:
        plan = np.random.default_rng(1).uniform([-9, -7], [9, 7], (40_000, 2))
        heights = MIDDLE_M - 0.1 + plan @ [EAST, NORTH]
        las(reference, np.column_stack([places_of("EPSG:25832+7837", plan), heights]), UTM, LEVEL_M - heights)
    bed = Bed(cloud, reference)
    profile = bed.along(Line("A-B", places_of("EPSG:25832+7837", LINES["A-B"])))
    assert profile.error == pytest.approx(0.1, abs=0.005 if is_mesh else 0.02)


@pytest.mark.parametrize(
    ("end", "step_m", "words"),
    [
        ([0.0, 0.0], 0.1, "the line 1 has no length"),
        ([1e6, 0.0], 0.001, "makes more than 200,000 places along the 1000000 m of the line 1; give --step 5 or more"),
        ([8.0, 0.0], 0.0, "--step is 0, expected metres between places"),
        ([8.0, 0.0], -1.0, "--step is -1, expected metres between places"),
        ([8.0, 0.0], np.inf, "--step is inf, expected metres between places"),
    ],
)
def test_a_line_without_length_and_a_step_that_is_unusable_are_refused(tmp_path, end, step_m, words):
    bed = Bed(plane_cloud(tmp_path / "bed.las"))
    with pytest.raises(SurveyError, match=re.escape(words)):
        bed.along(Line("1", places_of("EPSG:25832+7837", [[0.0, 0.0], end])), step_m=step_m)


def test_a_picture_of_many_profiles_says_that_it_shows_the_first(tmp_path, caplog):
    bed = Bed(plane_cloud(tmp_path / "bed.las"))
    profiles = [
        bed.along(Line(str(number), places_of("EPSG:25832+7837", [[-1.0, y], [1.0, y]])), step_m=0.1)
        for number, y in enumerate((0.0, 0.1, 0.2))
    ]
    for path, shown, most in (("two", profiles[:2], 2), ("first", profiles, 2), ("all", profiles, 3)):
        write_picture(tmp_path / path, shown, most=most)
    assert (tmp_path / "first").read_bytes() == (tmp_path / "two").read_bytes() != (tmp_path / "all").read_bytes()
    assert [record.message for record in caplog.records] == [
        f"{tmp_path / 'first'} shows the first 2 of 3 profiles; --csv and --dxf hold all of them"
    ]


def lines_file(path, lines: dict[str, np.ndarray]):
    """Lines in UTM, written in the format of a path; GeoJSON in degrees."""
    if path.suffix == ".geojson":
        way = Transformer.from_crs(horizontal_crs(UTM), "EPSG:4326", always_xy=True)
        features = [
            {"type": "Feature", "properties": {"name": name},
             "geometry": {"type": "LineString", "coordinates": np.column_stack(way.transform(*line.T)).tolist()}}
            for name, line in lines.items()
        ]  # fmt: skip
        path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
        return path
    shapes = [shapely.to_wkb(shapely.LineString(line)) for line in lines.values()]
    field, crs = ("Layer", None) if path.suffix == ".dxf" else ("name", "EPSG:25832")
    driver = {".gpkg": "GPKG", ".shp": "ESRI Shapefile", ".dxf": "DXF"}[path.suffix]
    names = np.array(list(lines), dtype=object)
    pyogrio.raw.write(
        path, np.array(shapes, dtype=object), [names], [field], geometry_type="LineString", crs=crs, driver=driver
    )
    return path


@pytest.mark.filterwarnings("ignore:.*crs.*:UserWarning")
@pytest.mark.parametrize("suffix", [".geojson", ".gpkg", ".shp", ".dxf"])
def test_lines_of_every_format_are_the_same(tmp_path, suffix):
    lines = {name: places_of("EPSG:25832+7837", corners) for name, corners in LINES.items()}
    found = read_lines(lines_file(tmp_path / f"lines{suffix}", lines), UTM, AROUND)
    assert [line.name for line in found] == list(lines)
    for line in found:
        assert line.corners == pytest.approx(lines[line.name], abs=1e-4)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("l.geojson", '{"type": "Point", "coordinates": [1, 2]}', "has no line of two corners or more"),
        ("l.geojson", '{"type": "LineString", "coordinates": [[1, 2]]}', "point array must contain 0 or >1 elements"),
        ("l.geojson", '{"type": "LineString", "coordinates": [[1, 2], [1, null]]}', "has no lines that can be read"),
        ("l.geojson", "[1, 2]", "has no lines that can be read"),
        ("l.geojson", "{", "has no lines that can be read"),
        ("l.gpkg", "no database", "does not begin as a file with the suffix .gpkg does"),
        ("l.dxf", "no drawing", "does not begin as a file with the suffix .dxf does"),
        ("l.gpx", "<gpx/>", "has no line of two corners or more"),
        ("l.kmz", "PK", "expected lines as one of .geojson, .gpkg, .shp, .dxf, .kml, .gpx"),
    ],
)
def test_a_file_without_lines_is_refused(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(UnreadableFile, match=re.escape(words)):
        read_lines(tmp_path / name, UTM, AROUND)


def test_parts_of_collections_are_lines_with_the_names_of_their_features(tmp_path):
    part = {"type": "MultiLineString", "coordinates": [[[10, 46], [10.1, 46]], [[10, 46.1], [10.1, 46.1]]]}
    feature = {"type": "Feature", "properties": {"Name": "dam"}, "geometry": part}
    other = {"type": "Feature", "properties": None, "geometry": {"type": "GeometryCollection", "geometries": [part]}}
    path = tmp_path / "l.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature, other]}))
    assert [line.name for line in read_lines(path, UTM, AROUND)] == ["dam 1", "dam 2", "3", "4"]


def test_the_command_prints_and_writes_profiles(tmp_path):
    cloud = plane_cloud(tmp_path / "bed.las")
    lines = lines_file(
        tmp_path / "l.geojson", {name: places_of("EPSG:25832+7837", corners) for name, corners in LINES.items()}
    )
    table, picture = tmp_path / "p.csv", tmp_path / "p.png"
    result = bathynerf("profile", cloud, "--lines", lines, "--csv", table, "--picture", picture, "--step", "0.5")
    assert result.exit_code == 0, result.stderr
    first, second = result.stdout.splitlines()
    assert re.match(r"A-B +10\.0 m, bed known at 100.* of 21 places; deepest", first)
    assert second.startswith("across")
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert tuple(rows[0]) == (*COLUMNS, "crs")
    assert [row["crs"] for row in rows[:2]] == ["EPSG:25832+7837", ""]
    assert len(rows) == 21 + 49
    assert rows[-1]["bed"] == rows[-1]["std_m"] == rows[-1]["reference"] == ""
    assert float(rows[0]["bed"]) + float(rows[0]["depth_m"]) == pytest.approx(float(rows[0]["water"]), abs=2e-4)
    assert picture.read_bytes()[:4] == b"\x89PNG"
    # Written again over its own, and not over what it reads.
    assert profiles_along(cloud, lines, csv_path=table)
    refused = bathynerf("profile", cloud, "--lines", lines, "--csv", lines)
    assert (refused.exit_code, "would overwrite the input" in refused.stderr) == (2, True)


def test_a_drawing_has_bed_and_water_of_each_profile(tmp_path):
    cloud, lines, path = plane_cloud(tmp_path / "c.las"), tmp_path / "l.geojson", tmp_path / "p.dxf"
    geometry = {"type": "LineString", "coordinates": places_of("EPSG:25832+7837", LINES["across"]).tolist()}
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    feature = {"type": "Feature", "properties": {"name": "across"}, "geometry": geometry}
    lines.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}))
    profiles_along(cloud, lines, dxf_path=path)
    space = ezdxf.readfile(path).modelspace()
    (bed,) = space.query('POLYLINE[layer=="bed across"]')
    places = np.array([vertex.dxf.location for vertex in bed.vertices])
    plan = (places[:, :2] - AT["EPSG:25832+7837"]) * metres_of("EPSG:25832+7837")
    # Off the cloud the line ends.
    assert np.abs(plan[:, 0]).max() < 8.3
    inner = np.abs(plan[:, 0]) < 7.5
    np.testing.assert_allclose(places[inner, 2], MIDDLE_M + plan[inner] @ [EAST, NORTH], atol=0.011)
    (water,) = space.query('POLYLINE[layer=="water across"]')
    np.testing.assert_allclose([v.dxf.location.z for v in water.vertices], LEVEL_M, atol=2e-3)


def test_lines_that_miss_the_cloud_are_an_error_or_a_warning(tmp_path, capsys):
    cloud, path = plane_cloud(tmp_path / "c.las"), tmp_path / "l.gpkg"
    far = {"far": places_of("EPSG:25832+7837", [[900.0, 0.0], [950.0, 0.0]])}
    with pytest.raises(SurveyError, match=r"no line of .* runs over the cloud"):
        profiles_along(cloud, lines_file(path, far))
    near = {"near": places_of("EPSG:25832+7837", LINES["A-B"])}
    with Progress(verbosity=0):
        profiles_along(cloud, lines_file(tmp_path / "both.gpkg", near | far))
    assert "1 line of both.gpkg without a point of the cloud near it: far" in " ".join(capsys.readouterr().err.split())
