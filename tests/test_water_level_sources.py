"""The water level from vector files and from clicks in photographs: known places, what they are worth, refusals."""

import json
import re

import numpy as np
import pyogrio.raw
import pytest
import shapely
from pyproj import Transformer
from small_survey import E0, LEVEL, N0, replaced, rows_of, small_survey, unposed

from geo.crs import parse_crs
from geo.vectors import DxfLine, write_dxf
from survey.errors import ConfigError
from survey.folder.survey import load_survey
from survey.plan.check import check_survey
from survey.settings.config import parse_config
from survey.water.level import with_level
from survey.water.level_observation import points_of_surface
from survey.water.surface_features import HEIGHT_NAMES, points_of_features

CRS = parse_crs("EPSG:25832+5778")
RING = [[E0, N0, LEVEL], [E0 + 9, N0, LEVEL + 0.01], [E0 + 9, N0 + 9, LEVEL], [E0, N0, LEVEL]]


def feature(kind: str, coordinates, **properties) -> dict:
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


def written(folder, content) -> object:
    path = folder / "shore.geojson"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_the_ring_of_a_polygon_counts_each_vertex_once(tmp_path):
    points, notes = points_of_features(written(tmp_path, feature("Polygon", [RING])), CRS)
    np.testing.assert_array_equal(points, RING[:3])
    assert "taken as crs" in notes[0]


def test_an_older_file_names_its_crs_and_a_contour_line_its_height(tmp_path):
    to_utm31 = Transformer.from_crs("EPSG:25832", "EPSG:25831", always_xy=True)
    line = [list(to_utm31.transform(e, n)) for e, n, _ in RING[:3]]
    content = {
        "type": "FeatureCollection",
        "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25831"}},
        "features": [feature("MultiLineString", [line], ELEV=LEVEL)],
    }
    points, _ = points_of_features(written(tmp_path, content), CRS)
    np.testing.assert_allclose(points, np.array(RING[:3])[:, :2].tolist() @ np.eye(2, 3) + [0, 0, LEVEL], atol=1e-4)


HEIGHTS = [name for each in HEIGHT_NAMES for name in (each, each.upper(), each.title())]


@pytest.mark.parametrize("kind", ["Point", "MultiPoint", "LineString", "MultiLineString", "Polygon", "MultiPolygon"])
@pytest.mark.parametrize("value", [LEVEL, str(LEVEL)])
@pytest.mark.parametrize("name", HEIGHTS)
def test_a_property_is_the_height_where_all_third_coordinates_are_zero(tmp_path, name, value, kind):
    """As GIS programs export with "include z-dimension"."""
    ring = [[e, n, 0.0] for e, n, _ in RING]
    nested = {"Point": ring[0], "MultiPoint": ring, "LineString": ring, "MultiLineString": [ring]}
    coordinates = nested.get(kind, [ring] if kind == "Polygon" else [[ring]])
    features = [feature(kind, coordinates, **{name: value, "name": "west"}, id=7)]
    points, notes = points_of_features(written(tmp_path, {"type": "FeatureCollection", "features": features}), CRS)
    assert set(points[:, 2].tolist()) == {LEVEL}
    assert f"are 0: heights are those of its property {name}" in notes[0]
    # Heights that are there stay what they are, and so does a level of 0 that nothing else contradicts.
    high = feature("MultiPoint", [[*ring[0][:2], 1.5], ring[1]], **{name: value})
    assert points_of_features(written(tmp_path, high), CRS)[0][:, 2].tolist() == [1.5, 0.0]
    sea = feature("MultiPoint", ring, name="west", id=7)
    assert set(points_of_features(written(tmp_path, sea), CRS)[0][:, 2].tolist()) == {0.0}


@pytest.mark.parametrize("third", [[], [0.0]])
@pytest.mark.parametrize(
    ("properties", "named"),
    [({"level": 2.0, "ELEV": 5.0}, ["level = 2", "elev = 5"]), ({"z": 1.0, "height": "3"}, ["height = 3", "z = 1"]),
     ({"depth": 2.5}, ["depth = 2.5"]), ({"Wasserstand_Hoehe": 6.5}, ["Wasserstand_Hoehe = 6.5"])],
)  # fmt: skip
def test_properties_that_may_be_heights_are_refused_by_name(tmp_path, properties, named, third):
    ring = [[e, n, *third] for e, n, _ in RING]
    with pytest.raises(ConfigError, match="keep one property level") as refused:
        points_of_features(written(tmp_path, feature("LineString", ring, **properties)), CRS)
    assert all(name in str(refused.value) for name in [*named, "all 0" if third else "property"])


def test_a_feature_without_the_property_is_refused_where_third_coordinates_are_zero(tmp_path):
    ring = [[e, n, 0.0] for e, n, _ in RING]
    features = [feature("LineString", ring, level=2.0), feature("LineString", ring)]
    with pytest.raises(ConfigError, match="features without a height"):
        points_of_features(written(tmp_path, {"type": "FeatureCollection", "features": features}), CRS)


@pytest.mark.filterwarnings("ignore:.*crs.*:UserWarning")
@pytest.mark.parametrize("suffix", [".gpkg", ".shp", ".dxf"])
def test_other_vector_files_give_the_same_points(tmp_path, suffix):
    line = shapely.LineString(RING[:3])
    driver = {".gpkg": "GPKG", ".shp": "ESRI Shapefile", ".dxf": "DXF"}[suffix]
    path, crs = tmp_path / f"shore{suffix}", None if suffix == ".dxf" else "EPSG:25832"
    names = ([], []) if suffix == ".dxf" else ([np.array([7])], ["id"])
    pyogrio.raw.write(
        path, np.array([shapely.to_wkb(line, flavor="iso")], object), *names, geometry_type="LineString Z", crs=crs,
        driver=driver,
    )  # fmt: skip
    found, notes = points_of_surface(path, "shoreline", CRS)
    np.testing.assert_allclose([(*each.place, each.level_m) for each in found], RING[:3], atol=1e-6)
    assert notes.warnings == ()
    of_unit = "shore.dxf has units of 0.0254 m by its $INSUNITS, and coordinates that are in the area of crs without: "
    assert notes.assumptions == (() if crs else (f"{of_unit}taken as they are", "shore.dxf names no CRS: taken as crs"))


@pytest.mark.parametrize(("code", "is_refused"), [("EPSG:25832+5778", False), ("EPSG:25832+7837", True)])
def test_heights_of_another_datum_than_that_of_crs_are_refused(tmp_path, code, is_refused):
    path = tmp_path / "shore.gpkg"
    shapes = np.array([shapely.to_wkb(shapely.LineString(RING[:3]), flavor="iso")], object)
    pyogrio.raw.write(path, shapes, [np.array([7])], ["id"], geometry_type="LineString Z", crs=code, driver="GPKG")
    if not is_refused:
        assert len(points_of_features(path, CRS)[0]) == 3
        return
    with pytest.raises(ConfigError, match=r"has heights in .*DHHN2016.*, expected those of"):
        points_of_features(path, CRS)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "can be read"),
        ("[" * 100_000, "can be read"),
        ("[1, 2]", "can be read"),
        ('{"type": "Point", "coordinates": [1, 2, ' + "9" * 10_000 + "]}", "can be read"),
        ('{"type": "Point", "coordinates": [1, 2, ' + "9" * 4_000 + "]}", "can be read"),
        ('{"type": "Point", "coordinates": [1, NaN, 2]}', "not finite"),
        ('{"type": "Point", "coordinates": {"a": 1}}', "can be read"),
        ({"type": "Point", "coordinates": [1, 2, None]}, "can be read"),
        ('{"type": "Point", "coordinates": [1, 2, NaN]}', "finite numbers"),
        (feature("Polygon", 5), "can be read"),
        (feature("LineString", [[1, 2], [3, 4]]), "positions without a height"),
        ({"type": "Topology"}, "topology"),
        ({"type": "Feature", "geometry": {"coordinates": []}}, "can be read"),
        ({"type": "Point", "coordinates": [1, 2, 3], "crs": {"properties": {"name": "EPSG:0"}}}, "EPSG:0"),
    ],
)
def test_other_content_is_refused_by_name(tmp_path, content, message):
    path = written(tmp_path, content)
    with pytest.raises(ConfigError, match=message) as refused:
        points_of_features(path, CRS)
    assert "shore.geojson" in str(refused.value)
    assert len(str(refused.value)) < 600


def clicks_of(survey, rng, *, std: float, num: int = 6) -> list[str]:
    """Lines of a table of clicks: places on the water as all views see them, with errors."""
    lines = ["image,x,y,name"]
    for i in range(num):
        place = np.array([E0 + 2.0 + rng.uniform(-3, 5), N0 - 2.0 + rng.uniform(-3, 3), LEVEL])
        local = survey.frame.local_from_crs(place)
        for view in survey.views:
            x, y = view.camera.project(local, None) + std * rng.normal(size=2)
            if 0 < x < view.camera.width and 0 < y < view.camera.height:
                lines.append(f"{view.name},{x:.4f},{y:.4f},p{i}")
    return lines


@pytest.fixture
def clicked(tmp_path, rng):
    """A survey whose level is that of clicks; its lens distorts."""
    lens = ('model = "PINHOLE"', 'model = "OPENCV"\ndistortion = [-0.1, 0.02, 0.001, 0.0]')
    truth = load_survey(small_survey(tmp_path / "truth", toml=replaced(lens)))
    folder = small_survey(tmp_path / "s", toml=replaced(lens, (f"level_m = {LEVEL}", 'clicks = "clicks.csv"')))
    return truth, folder


def test_clicks_without_errors_give_the_level_to_the_digits_of_the_file(clicked, rng):
    truth, folder = clicked
    (folder / "clicks.csv").write_text("\n".join(clicks_of(truth, rng, std=0.0)))
    survey = load_survey(folder)
    # 0.0001 px of 0.2 m are 20 micrometres across, and some times that in height.
    assert survey.config.water.level_m == pytest.approx(LEVEL, abs=1e-3)
    assert survey.water.height(0.0, 0.0) == pytest.approx(survey.frame.local_from_crs([E0, N0, LEVEL])[2], abs=1e-2)
    assert survey.provenance.is_level_known
    assert [level.source for level in survey.observations.levels] == ["clicks"] * 6
    assert any("from 6 points in [water] clicks" in text for text in survey.findings.assumptions)
    assert rows_of(check_survey(folder), "Found")["water"].startswith("level 2105")


def test_the_stated_standard_deviation_of_clicks_is_theirs(clicked, rng):
    truth, folder = clicked
    sigmas = []
    for _ in range(12):
        lines = clicks_of(truth, rng, std=0.5)
        (folder / "clicks.csv").write_text("\n".join([lines[0] + ",std", *(line + ",0.5" for line in lines[1:])]))
        survey = load_survey(folder)
        sigmas += [(level.level_m - LEVEL) / level.std_m for level in survey.observations.levels]
    # 72 deviates of unit variance: the mean of their squares is within 0.5 of one but once in 300 times.
    assert np.mean(np.square(sigmas)) == pytest.approx(1.0, abs=0.5)
    assert abs(np.mean(sigmas)) < 4.0 / 72**0.5


def test_clicks_of_a_survey_without_poses_wait_for_them(tmp_path):
    folder = unposed(tmp_path / "s", (f"level_m = {LEVEL}", 'clicks = "clicks.csv"'))
    (folder / "clicks.csv").write_text("image,x,y,name\n")
    assert (
        rows_of(check_survey(folder), "Found")["water"]
        == "its level by the clicks in clicks.csv, once the poses are known"
    )


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (["0000.jpg,10,10,a"], "no place that two photographs with poses show"),
        (["0000.jpg,10,10,a", "none.jpg,10,10,a"], "no place that two"),
        (["0000.jpg,10,10,a", "0001.jpg,900,10,a"], "expected a pixel in 0001.jpg"),
        (["0000.jpg,10,10,", "0001.jpg,10,10,"], "name is empty"),
        (["0000.jpg,10,ten,a"], "expected a finite number"),
    ],
)
def test_clicks_that_tell_nothing_are_refused(tmp_path, rows, message):
    folder = small_survey(tmp_path / "s", toml=replaced((f"level_m = {LEVEL}", 'clicks = "clicks.csv"')))
    (folder / "clicks.csv").write_text("\n".join(["image,x,y,name", *rows]) + "\n")
    with pytest.raises(ConfigError, match=message):
        load_survey(folder)


def test_a_click_at_another_spot_costs_its_place_and_is_said(clicked, rng):
    truth, folder = clicked
    lines = clicks_of(truth, rng, std=0.0)
    wrong = next(i for i, line in enumerate(lines) if line.endswith("p3"))
    image, x, y, name = lines[wrong].split(",")
    lines[wrong] = f"{image},{float(x) * 0.2:.3f},{float(y) * 0.2:.3f},{name}"
    (folder / "clicks.csv").write_text("\n".join(lines))
    survey = load_survey(folder)
    assert len(survey.observations.levels) == 5
    assert any("1 places of clicks.csv give no level (first: p3)" in text for text in survey.findings.warnings)


@pytest.mark.parametrize("mark", [-9999.0, -32768.0, 1e6])
def test_a_mark_of_no_data_is_no_level(tmp_path, mark):
    ring = [[x, y, mark] for x, y, *_ in RING]
    with pytest.raises(ConfigError, match="a no-data value; remove those points"):
        points_of_features(written(tmp_path, feature("LineString", ring)), CRS)


def lines_of(heights: dict[str, float], *, step: float = 0.0) -> dict[str, list]:
    """A line of 12 vertices in each layer, at its height and falling by ``step`` from one to the next."""
    return {
        name: [[E0 + 3 * i, N0 + 2 * i + 10 * n, height - step * i] for i in range(12)]
        for n, (name, height) in enumerate(heights.items())
    }


def write_layers(path, lines: dict[str, list]) -> None:
    """Lines of layers in the form of the suffix of a path."""
    kind = path.suffix
    if kind in (".geojson", ".kml"):
        to_lonlat = Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True)
        lines = {name: [[*to_lonlat.transform(e, n), h] for e, n, h in line] for name, line in lines.items()}
    if kind == ".geojson":
        features = [feature("LineString", line, Layer=name) for name, line in lines.items()]
        path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    elif kind == ".kml":
        texts = {name: " ".join(",".join(map(repr, place)) for place in line) for name, line in lines.items()}
        marks = (
            f"<Folder><name>{name}</name><Placemark><LineString><coordinates>{text}</coordinates></LineString>"
            "</Placemark></Folder>"
            for name, text in texts.items()
        )
        path.write_text(f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{"".join(marks)}</Document></kml>')
    elif kind == ".csv":
        rows = [f"{n}{i},{name},{e},{no},{h}" for n, (name, line) in enumerate(lines.items())
                for i, (e, no, h) in enumerate(line)]  # fmt: skip
        path.write_text("\n".join(["name,code,easting,northing,height", *rows]))
    elif kind == ".dxf":
        write_dxf(path, [DxfLine(name, np.array(line)) for name, line in lines.items()], CRS)
    else:
        driver = {".gpkg": "GPKG", ".shp": "ESRI Shapefile"}[kind]
        shapes = [shapely.to_wkb(shapely.LineString(line), flavor="iso") for line in lines.values()]
        names = [np.array([name], object) for name in lines]
        parts = [
            ([shape], of, {"layer": of[0], "append": path.exists()}) for shape, of in zip(shapes, names, strict=True)
        ]
        for shape, of, options in [(shapes, np.array(list(lines), object), {})] if kind == ".shp" else parts:
            pyogrio.raw.write(
                path, np.array(shape, object), [of], ["layer"], geometry_type="LineString Z", crs="EPSG:25832",
                driver=driver, **options,
            )  # fmt: skip


KINDS = [".geojson", ".kml", ".csv", ".dxf", ".gpkg", ".shp"]


@pytest.mark.parametrize("suffix", KINDS)
@pytest.mark.parametrize("other", [LEVEL + 2.0, LEVEL - 0.8, LEVEL + 30.0, LEVEL + 0.2])
def test_layers_of_several_heights_are_named_and_one_is_asked_for(tmp_path, suffix, other):
    path = tmp_path / f"plan{suffix}"
    write_layers(path, lines_of({"WATERLINE": LEVEL, "CONTOURS": other}))
    words = (
        rf"2 layers or codes .* WATERLINE \({LEVEL:.2f}\), CONTOURS \({other:.2f}\); give .* \[water\] layer = \"WATER"
    )
    with pytest.raises(ConfigError, match=words):
        points_of_surface(path, "shoreline", CRS)
    found, _ = points_of_surface(path, "shoreline", CRS, "WATERLINE")
    assert {round(each.level_m, 6) for each in found} == {LEVEL}
    assert len(points_of_surface(path, "shoreline", CRS, "WATERLINE, CONTOURS")[0]) == 24
    with pytest.raises(ConfigError, match=r'no layer (or code )?"SHORE", .*: WATERLINE, CONTOURS'):
        points_of_surface(path, "shoreline", CRS, "SHORE")


@pytest.mark.parametrize("suffix", KINDS)
def test_layers_of_one_height_are_one_water(tmp_path, suffix):
    path = tmp_path / f"plan{suffix}"
    write_layers(path, lines_of({"WEST": LEVEL, "EAST": LEVEL + 0.04}))
    assert len(points_of_surface(path, "shoreline", CRS)[0]) == 24


@pytest.mark.parametrize("key", ["shoreline", "gnss_points", "surface"])
@pytest.mark.parametrize("suffix", KINDS)
def test_a_slope_beyond_that_of_a_rapid_is_refused_from_every_source(tmp_path, key, suffix):
    write_layers(tmp_path / f"plan{suffix}", lines_of({"a": LEVEL, "b": LEVEL}, step=0.4))
    config = parse_config(f'[water]\n{key} = "plan{suffix}"\nlayer = "a,b"\n')
    with pytest.raises(ConfigError, match=rf"\[water\] {key} have slopes .* degrees, expected a rise of at most 0.065"):
        with_level(tmp_path, config, {}, CRS)
    write_layers(tmp_path / f"river{suffix}", lines_of({"a": LEVEL, "b": LEVEL}, step=0.02))
    config = parse_config(f'[water]\n{key} = "river{suffix}"\nlayer = "a,b"\n')
    assert with_level(tmp_path, config, {}, CRS)[0].water.slope_east != 0.0


def test_points_of_the_bed_among_those_of_the_water_are_named_and_refused_where_they_are_half(tmp_path):
    def levelled(*of_bed):
        rows = [f"{E0 + 3 * i},{N0 + (i * i) % 13},{LEVEL - (i in of_bed):.3f}" for i in range(16)]
        (tmp_path / "rod.csv").write_text("easting,northing,height\n" + "\n".join(rows))
        return with_level(tmp_path, parse_config('[water]\ngnss_points = "rod.csv"\n'), {}, CRS)[3].warnings

    assert any("2 of 16 points" in text and "under it" in text for text in levelled(3, 8))
    with pytest.raises(ConfigError, match=r"gnss_points lie more than 5 .* they are not of one water"):
        levelled(*range(1, 16, 2))


@pytest.mark.parametrize(
    ("code", "unit_m"), [(4, 1e-3), (5, 1e-2), (2, 0.3048), (21, 1200 / 3937), (6, 1.0), (1, None), (0, None)]
)
@pytest.mark.parametrize("scales", [True, False])
def test_the_unit_of_a_drawing_counts_where_its_coordinates_have_it(tmp_path, code, unit_m, scales):
    path, factor = tmp_path / "plan.dxf", unit_m if scales and unit_m else 1.0
    places = np.array(lines_of({"a": LEVEL})["a"]) / factor
    write_dxf(path, [DxfLine("a", places)], CRS)
    text = path.read_text()
    path.write_text(re.sub(r"(\$INSUNITS\s+70\s+)6", rf"\g<1>{code}", text))
    found, notes = points_of_features(path, CRS)
    np.testing.assert_allclose(found, np.array(lines_of({"a": LEVEL})["a"]), atol=1e-5)
    assert any("$INSUNITS" in note for note in notes) == (code not in (6, 0))


@pytest.mark.parametrize(("code", "is_refused"), [(4, True), (2, True), (6, False), (1, False), (0, False)])
def test_a_unit_of_a_drawing_that_nothing_decides_is_refused(tmp_path, code, is_refused):
    path, local = (
        tmp_path / "plan.dxf",
        parse_crs("+proj=tmerc +lat_0=47 +lon_0=10 +ellps=GRS80 +units=m +vunits=m +type=crs"),
    )
    write_dxf(path, [DxfLine("a", np.array(lines_of({"a": LEVEL})["a"]))], local)
    path.write_text(re.sub(r"(\$INSUNITS\s+70\s+)6", rf"\g<1>{code}", path.read_text()))
    if is_refused:
        with pytest.raises(ConfigError, match=r"by its .INSUNITS, expected 1 m as in"):
            points_of_features(path, local)
    else:
        assert len(points_of_features(path, local)[0]) == 12


@pytest.mark.parametrize(
    ("name", "note"), [("lon", "taken as longitude and latitude of WGS 84"), ("grid", "taken as crs")]
)
def test_what_geojson_without_crs_is_taken_for_is_said(tmp_path, name, note):
    line = lines_of({"a": LEVEL})["a"]
    given = line
    if name == "lon":
        to_lonlat = Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True)
        given = [[*to_lonlat.transform(e, n), h] for e, n, h in line]
    content = [feature("LineString", given), {"type": "Feature", "geometry": None}]
    path = written(tmp_path, {"type": "FeatureCollection", "features": content})
    points, notes = points_of_features(path, CRS)
    assert note in notes[0]
    # Degrees of JSON have all their digits.
    np.testing.assert_allclose(points, line, atol=1e-6)


def test_kml_on_the_ground_has_no_heights(tmp_path):
    write_layers(tmp_path / "a.kml", lines_of({"a": 0.0}))
    with pytest.raises(ConfigError, match="features without a height"):
        points_of_features(tmp_path / "a.kml", CRS)


@pytest.mark.parametrize(("name", "metres"), [("level_ft", 0.3048), ("elev_cm", 0.01), ("z", 1.0), ("height [m]", 1.0)])
def test_a_property_with_a_unit_is_converted(tmp_path, name, metres):
    found, _ = points_of_features(written(tmp_path, feature("LineString", [[1, 2], [3, 4]], **{name: 650.0})), CRS)
    assert set(found[:, 2].tolist()) == {650.0 * metres}
