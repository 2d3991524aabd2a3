"""Control in every format and CRS: the same points and marks."""

from html import escape

import numpy as np
import pytest
from control_files import METASHAPE, POINTS, SURVEY_CRS, gathered, marks, odm, table, written
from pyproj import CRS, Transformer

from geo.crs import height_unit_m
from survey.control.formats import read_checkpoints
from survey.control.reading import in_crs, merge_control, read_control
from survey.errors import ControlError

WKT = CRS("EPSG:25832").to_wkt("WKT1_GDAL")
FORMAT_FILES = {
    "gcp list": {"gcp_list__txt": odm()},
    "gcp list under another name, tabs, carriage returns, a mark of byte order": {
        "ground__txt": ("\ufeff# by hand\n" + odm().replace(" ", "\t")).replace("\n", "\r\n")
    },
    "gcp list with a role": {"gcp_list__txt": odm().replace("p1\n", "p1 extra\n")},
    "names in other case and folders": {"gcp_list__txt": odm(images=("C:\\shots\\a\\0000.JPG", "A/0001.jpg"))},
    "PROJ string": {"g__txt": odm(header="+proj=utm +zone=32 +ellps=GRS80 +units=m +no_defs\t")},
    "tables": {"points__csv": table(), "marks__csv": marks()},
    "tables with decimal commas": {"points__txt": table(mark=";", decimal=","), "marks__csv": marks()},
    "tables with tabs": {"points__txt": table(mark="\t"), "marks__csv": marks().replace(",", "\t")},
    "Metashape": {"points__xml": METASHAPE},
    "Metashape with its CRS": {"points__xml": METASHAPE.replace("<reference><", f"<reference>{escape(WKT)}<")},
    "coordinates as Metashape writes them": {
        "points__csv": "#CoordinateSystem: EPSG:25832\n#Label,X/Easting,Y/Northing,Z/Altitude,Accuracy_(m),Error_(m)\n"
        + "".join(f"{name},{e},{n},{h},,0.01\n" for name, e, n, h in POINTS)
        + "# Total error: 0.01\n",
        "marks__csv": marks(),
    },
}


@pytest.mark.parametrize("files", FORMAT_FILES.values(), ids=FORMAT_FILES.keys())
def test_every_format_gives_the_same_points_and_marks(tmp_path, files):
    found, _, _ = gathered(written(tmp_path, **files))
    assert [point.name for point in found.points] == ["p1", "p2", "p3"]
    assert np.abs(np.array([point.place for point in found.points]) - [place for _, *place in POINTS]).max() < 1e-6
    expected = [(p, f"a/000{j}.jpg", (10.5 + i, 20.5 + j)) for i, p in enumerate(("p1", "p2", "p3")) for j in range(2)]
    assert [(mark.point, mark.view, mark.pixel) for mark in found.marks] == expected


@pytest.mark.parametrize(
    ("header", "code"), [("EPSG:4326", 4326), ("WGS84", 4326), ("WGS84 UTM 33N", 32633), ("EPSG:3857", 3857)]
)
def test_points_in_another_horizontal_crs_are_transformed_and_that_is_said(tmp_path, header, code):
    to_theirs = Transformer.from_crs("EPSG:25832", f"EPSG:{code}", always_xy=True)
    points = [(name, *to_theirs.transform(e, n), h) for name, e, n, h in POINTS]
    found, assumptions, _ = gathered(written(tmp_path, gcp_list__txt=odm(points, header)))
    assert np.abs(np.array([point.place for point in found.points]) - [place for _, *place in POINTS]).max() < 1e-3
    assert [point.place[2] for point in found.points] == [h for *_, h in POINTS]
    assert any("are transformed to ETRS89 / UTM zone 32N" in text for text in assumptions)


def test_lines_without_names_are_of_one_point_where_their_coordinates_are_the_same(tmp_path):
    text = "\n".join(line.rsplit(" ", 1)[0] if i else line for i, line in enumerate(odm().splitlines()))
    found, _, _ = gathered(written(tmp_path, gcp_list__txt=text))
    assert [point.name for point in found.points] == ["gcp_list 1", "gcp_list 2", "gcp_list 3"]
    assert len(found.marks) == 6


def test_a_name_of_an_image_with_a_space_is_whole_between_tabs(tmp_path):
    (path,) = written(tmp_path, gcp_list__txt=odm(images=("my photo.jpg",)).replace(" ", "\t").replace("my\t", "my "))
    found, _ = merge_control([read_control(path)], SURVEY_CRS, {"my photo.jpg": (64, 48)})
    assert {mark.view for mark in found.marks} == {"my photo.jpg"}


def test_accuracies_and_roles_come_from_the_file(tmp_path):
    (path,) = written(tmp_path, points__xml=METASHAPE)
    p1, p2, p3 = read_control(path).points
    assert (p1.std_m, p2.std_m) == (None, (0.02, 0.03, 0.05))
    assert (p1.is_check, p2.is_check, p3.is_check) == (False, False, True)
    text = "label;x;y;z;accuracy_x/y_(m);accuracy_z_(m);role\na;1;2;3;0,01;0,02;check\nb;1;2;4;;;\n"
    (path,) = written(tmp_path, points__csv=text)
    a, b = read_control(path).points
    assert (a.std_m, a.is_check, b.std_m, b.is_check) == ((0.01, 0.01, 0.02), True, None, False)
    (path,) = written(tmp_path, points__csv="Label,Enable,X,Y,Z,sigma\na,0,1,2,3,0.1\nb,1,1,2,4,0.1\n")
    a, b = read_control(path).points
    assert (a.is_check, b.is_check, b.std_m) == (True, False, (0.1, 0.1, 0.1))
    (path,) = written(tmp_path, gcp_list__txt="EPSG:25832\n1 2 3 4 5 a.jpg a check\n1 2 3 4 5 b.jpg a\n")
    assert [point.is_check for point in read_control(path).points] == [True, False]


def test_a_standard_deviation_of_0_is_unknown_for_check_points_and_refused_for_control(tmp_path):
    (path,) = written(tmp_path, points__csv="name,easting,northing,height,std,role\na,1,2,3,0,check\nb,1,2,4,0.1,\n")
    assert [point.std_m for point in read_checkpoints(path)] == [None, (0.1, 0.1, 0.1)]
    assert [point.std_m for point in read_control(path).points] == [None, (0.1, 0.1, 0.1)]
    path.write_text(path.read_text().replace(",check", ","))
    with pytest.raises(ControlError, match=r"are 0, 0, 0, expected .* columns out and give \[control\] std_m"):
        read_control(path)


def test_check_points_without_marks_are_kept_and_control_points_without_are_named(tmp_path):
    text = table().replace("height\n", "height,role\n").replace("2106.0000\n", "2106.0000,check\n")
    paths = written(tmp_path, points__csv=text, marks__csv=marks(("p1",)))
    found, _, warnings = gathered(paths)
    assert [point.name for point in found.points] == ["p1"]
    assert [point.name for point in found.unmarked] == ["p3"]
    (unmarked,) = [text for text in warnings if "without a mark" in text]
    assert unmarked.startswith("1 control point without a mark in a photograph, left out: p2 (")
    assert "points.csv, line 3" in unmarked


def test_marks_that_belong_to_nothing_are_left_out_by_name(tmp_path):
    text = marks() + "other.jpg,p1,3,4\n0000.jpg,stranger,3,4\n"
    _, _, warnings = gathered(written(tmp_path, points__csv=table(), marks__csv=text))
    assert any("1 photograph that the survey does not have" in w and "line 8" in w for w in warnings)
    assert any("1 point without coordinates" in w and "stranger (first in" in w for w in warnings)


def test_little_control_is_doubted(tmp_path):
    _, _, warnings = gathered(written(tmp_path, gcp_list__txt=odm(POINTS[:2])))
    assert any(text.startswith("2 control points with marks, expected 3 or more") for text in warnings)
    flat = [(name, e, n, 0.0) for name, e, n, _ in POINTS]
    _, _, warnings = gathered(written(tmp_path, gcp_list__txt=odm(flat)))
    assert any("the height 0" in text for text in warnings)


@pytest.mark.parametrize("crs", ["EPSG:25832+5778", "EPSG:2264+6360"])
@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("ft", 0.3048), ("ftUS", 1200.0 / 3937.0)])
def test_heights_of_control_and_check_points_have_the_unit_of_their_column(tmp_path, crs, unit, metres):
    path, survey = tmp_path / "points.csv", CRS(crs)
    # A foot that does not say which of the two is that of the CRS.
    metres = height_unit_m(survey) if unit == "ft" and height_unit_m(survey) < 1.0 else metres
    path.write_text(f"name,easting,northing,height_{unit}\na,589012,5194736,{10.0 / metres!r}\n")
    for given in (read_control(path).points, read_checkpoints(path)):
        (point,), _ = in_crs(given, survey)
        assert point.place[2] * height_unit_m(survey) == pytest.approx(10.0, rel=1e-12)
    path.write_text(f"name,easting,northing,depth_{unit}\na,589012,5194736,{10.0 / metres!r}\n")
    (point,), _ = in_crs(read_checkpoints(path, 30.0 / height_unit_m(survey), survey), survey)
    assert point.place[2] * height_unit_m(survey) == pytest.approx(20.0, rel=1e-12)


@pytest.mark.parametrize("said", ["EPSG:2264", "EPSG:2264+6360"])
def test_depths_with_a_crs_of_their_own_have_its_unit_in_plan_and_heights_of_the_survey(tmp_path, said):
    path, survey = tmp_path / "depths.csv", CRS("EPSG:32119+5703")
    path.write_text(f"# CoordinateSystem: {said}\nx_ftUS,y_ftUS,depth_ftUS\n1400000,600000,10\n")
    (point,), _ = in_crs(read_checkpoints(path, 500.0, survey), survey)
    foot = 1200.0 / 3937.0
    # One datum and one projection: a foot of the survey and a metre alone.
    assert point.place == pytest.approx((1400000 * foot, 600000 * foot, 500.0 - 10 * foot), abs=0.01)


@pytest.mark.parametrize("unit", ["ft", "feet", "ftUS"])
@pytest.mark.parametrize("said", ["# CoordinateSystem: EPSG:2264+6360\n", ""])
def test_a_bare_foot_is_that_of_the_crs(tmp_path, unit, said):
    path, survey = tmp_path / "points.csv", CRS("EPSG:2264+6360")
    path.write_text(f"{said}x_{unit},y_{unit},z_{unit}\n1400000,600000,1000\n")
    (point,), _ = in_crs(read_checkpoints(path, None, survey), survey)
    assert point.place == pytest.approx((1400000.0, 600000.0, 1000.0), abs=1e-9, rel=0.0)
