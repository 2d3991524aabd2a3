"""Files of other programs given as poses, control or areas: KML and GPX are read, the rest is named with a remedy."""

import numpy as np
import pytest
from pyproj import CRS, Transformer
from small_survey import small_survey

from geo.features import read_polygons
from survey.control.reading import in_crs, read_control
from survey.errors import ControlError, PosesError
from survey.pose_files import find_poses, find_unread, read_poses

UTM = CRS("EPSG:25832+5778")
POINTS = {"a": (589000.0, 5194700.0, 2104.5), "b 2": (589040.0, 5194710.0, 2103.25), "c": (589020.0, 5194750.0, 2106.0)}
TO_DEGREES = Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True)
DEGREES = {name: (*TO_DEGREES.transform(e, n), h) for name, (e, n, h) in POINTS.items()}


def kml(body: str, head: str = "") -> str:
    content = f"<Document><Folder>{body}</Folder></Document>"
    return f'<?xml version="1.0" encoding="UTF-8"?>{head}<kml xmlns="http://www.opengis.net/kml/2.2">{content}</kml>'


def placemark(name: str, place, mode: str = "") -> str:
    lon, lat, height = place
    point = f"<Point>{mode}<coordinates>{lon!r},{lat!r},{height!r}</coordinates></Point>"
    return f"<Placemark><name>{name}</name>{point}</Placemark>"


def waypoint(name: str, place) -> str:
    return f'<wpt lat="{place[1]!r}" lon="{place[0]!r}"><ele>{place[2]}</ele><name>{name}</name></wpt>'


def gpx(body: str) -> str:
    return f'<gpx xmlns="http://www.topografix.com/GPX/1/1" version="1.1">{body}</gpx>'


FILES = {
    "a.kml": kml("".join(placemark(*item) for item in DEGREES.items())),
    "absolute.KML": kml("".join(placemark(*i, "<altitudeMode>absolute</altitudeMode>") for i in DEGREES.items())),
    "a.gpx": gpx("".join(waypoint(*item) for item in DEGREES.items())),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_points_of_kml_and_gpx_are_control(tmp_path, name):
    path = tmp_path / name
    path.write_text(FILES[name])
    points, findings = in_crs(read_control(path).points, UTM)
    assert [point.name for point in points] == list(POINTS)
    assert np.abs(np.array([point.place for point in points]) - list(POINTS.values())).max() < 1e-4
    assert any("heights are taken as heights in crs" in text for text in findings.assumptions)


@pytest.mark.parametrize("hole", [False, True])
def test_polygons_of_kml_are_areas(tmp_path, hole):
    ring = [(589000.0, 5194700.0), (589100.0, 5194700.0), (589100.0, 5194800.0), (589000.0, 5194800.0)]
    inner = [(589040.0, 5194740.0), (589060.0, 5194740.0), (589060.0, 5194760.0), (589040.0, 5194760.0)]

    def boundary(side, corners):
        text = " ".join("{!r},{!r},0".format(*TO_DEGREES.transform(*corner)) for corner in [*corners, corners[0]])
        return f"<{side}BoundaryIs><LinearRing><coordinates>{text}</coordinates></LinearRing></{side}BoundaryIs>"

    rings = boundary("outer", ring) + (boundary("inner", inner) if hole else "")
    (tmp_path / "area.kml").write_text(kml(f"<Placemark><Polygon>{rings}</Polygon></Placemark>"))
    (polygon,) = read_polygons(
        tmp_path / "area.kml", UTM, np.array([588900.0, 5194600.0, 589200.0, 5194900.0])
    ).values()
    # Degrees are written to their last digit; a side of 100 m curves by some micrometres.
    assert polygon.area == pytest.approx(1e4 - (400.0 if hole else 0.0), abs=0.05)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.kml", kml(placemark("a", DEGREES["a"], "<altitudeMode>clampToGround</altitudeMode>")), "has no height"),
        ("a.kml", kml(placemark("", DEGREES["a"])), "has no name"),
        ("a.kml", kml("<Placemark><name>x</name></Placemark>"), "has no points"),
        ("a.kml", kml("", '<!DOCTYPE kml [<!ENTITY a "b">]>'), "has a document type"),
        ("a.kml", "<kml><Placemark>", "is not well-formed XML"),
        ("a.gpx", "<kml></kml>", "begins with <kml>, expected <gpx>"),
        ("a.gpx", gpx('<wpt lat="x" lon="1"><name>a</name></wpt>'), "that can be read"),
        ("a.gpx", gpx('<wpt lon="1"><name>a</name></wpt>'), "without the member 'lat'"),
        ("a.gpx", gpx("<trk><trkseg/></trk>"), "has no points"),
        ("a.kml", kml("<Placemark><Point><coordinates> </coordinates></Point></Placemark>"), "that can be read"),
        ("a.kmz", "PK", "unzip it"),
        ("points.xlsx", "PK", r"save it as \.csv"),
        ("p.gpkg", "SQLite", "export the points as a table"),
        ("x.opf", "{}", "export the control points"),
        ("x.PSX", "<", "export the markers from Metashape"),
    ],
)
def test_what_is_no_control_is_refused_with_the_remedy(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(ControlError, match=words):
        read_control(tmp_path / name)


PMATRIX = "0000.jpg " + " ".join(f"{v:.6f}" for v in np.linspace(1.0, 12.0, 12))
NO_POSES = {
    "quick_pmatrix.txt": PMATRIX, "PMatrix.TXT": PMATRIX, "project.opf": "{}", "scan.rcproj": "<", "scan.rsproj": "<",
    "flight.kml": FILES["a.kml"], "flight.KMZ": "PK", "track.gpx": FILES["a.gpx"], "Timestamp.MRK": "1 2",
    "a.psx": "<", "a.psz": "PK", "a.p4d": "<", "model.nvm": "NVM_V3", "bundle.out": "# Bundle", "block.ori": "1 2",
    "points.geojson": "{}", "a.pos": "1 2",
}  # fmt: skip


@pytest.mark.parametrize("name", NO_POSES)
def test_what_is_no_poses_is_refused_with_the_formats_that_are_read(tmp_path, name):
    folder = small_survey(tmp_path / "s")
    (folder / "cameras.csv").unlink()
    (folder / name).write_text(NO_POSES[name])
    with pytest.raises(PosesError, match=r"is not read: .*; expected one of: .*Metashape"):
        read_poses(folder / name)
    assert find_poses(folder) == []
    has_no_rotations = name.casefold().endswith((".kml", ".kmz", ".gpx", ".mrk", ".pos", ".geojson"))
    assert [text.split(" is not read")[0] for text in find_unread(folder)] == ([] if has_no_rotations else [name])
