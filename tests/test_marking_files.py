"""Marks put into gcp_list.txt and clicks.csv: what is there stays, and the readers of `process` get every pixel."""

from pathlib import Path

import numpy as np
import pytest
from control_files import odm, table
from small_survey import E0, LEVEL, N0, replaced, small_survey

from geo.crs import parse_crs
from survey.control.formats import read_gcp_list
from survey.errors import SurveyError
from survey.folder.found import find_survey
from survey.marking.gcp_file import ControlMark, header_of, points_without_mark, read_clicks, with_click, with_marks
from survey.marking.geometry import survey_to_mark
from survey.marking.mark_store import GROUND, WATER, MarkStore, PointKey
from survey.marking.masks import mask_path
from survey.photos.poses import PoseFile, PoseFrame

CRS = parse_crs("EPSG:25832+5778")
IMAGES = ("0000.jpg", "0001.jpg", "my photograph 2.jpg")
PLACE = (E0 + 1.25, N0 - 2.5, LEVEL + 0.125)


def mark(name="new", image="0001.jpg", pixel=(12.3456, 40.5), is_check=False) -> ControlMark:
    return ControlMark(name, PLACE, is_check, image, pixel)


def test_a_new_list_has_the_crs_and_the_mark_as_process_reads_it(tmp_path):
    path = tmp_path / "gcp_list.txt"
    path.write_text(with_marks(path, [mark()], CRS, IMAGES))
    # The centre of its first pixel is 0, 0.
    assert path.read_text() == "EPSG:25832\n589013.2500 5194733.5000 2105.1250 11.846 40.000 0001.jpg new\n"
    content = read_gcp_list(path)
    assert content.points[0].place == PLACE
    assert content.marks[0].pixel == pytest.approx((12.346, 40.5), abs=1e-9)


def test_marks_are_moved_and_removed_in_place_and_all_other_lines_stay(tmp_path):
    path = tmp_path / "gcp_list.txt"
    given = odm(header="# by hand\nEPSG:25832") + "\n# of another survey\n1 2 3 4 5 strange.jpg p1 note\n"
    path.write_text(given)
    path.write_text(with_marks(path, [mark("p2", "0000.jpg", (30.0, 31.0))], CRS, IMAGES))
    lines, before = path.read_text().splitlines(), given.splitlines()
    assert [i for i, (a, b) in enumerate(zip(lines, before, strict=True)) if a != b] == [4]
    # The coordinates of a point are those that the file has, to the letter.
    assert lines[4] == f"{E0 + 4.25} {N0 - 3.0} {LEVEL + 0.5} 29.500 30.500 0000.jpg p2"
    path.write_text(with_marks(path, [mark("p2", "0000.jpg", None)], CRS, IMAGES))
    assert path.read_text().splitlines() == before[:4] + before[5:]
    assert with_marks(path, [mark("p2", "0000.jpg", None)], CRS, IMAGES) == path.read_text()


def test_the_coordinates_of_a_point_outlive_its_last_mark(tmp_path):
    path = tmp_path / "gcp_list.txt"
    path.write_text(given := odm(images=("0000.jpg",)))
    path.write_text(with_marks(path, [mark("p2", "0000.jpg", None)], CRS, IMAGES))
    (point,) = points_without_mark(path)
    assert (point.name, point.place) == ("p2", (E0 + 4.25, N0 - 3.0, LEVEL + 0.5))
    assert [point.name for point in read_gcp_list(path).points] == ["p1", "p3"]
    path.write_text(with_marks(path, [mark("p2", "0000.jpg", (11.5, 20.5))], CRS, IMAGES))
    assert sorted(path.read_text().split()) == sorted(given.replace(" 11 20 ", " 11.000 20.000 ").split())


def test_names_with_spaces_and_roles_are_read_back(tmp_path):
    path = tmp_path / "gcp_list.txt"
    path.write_text(with_marks(path, [mark("rod 4", IMAGES[2], is_check=True)], CRS, IMAGES))
    content = read_gcp_list(path)
    assert (content.marks[0].view, content.points[0].name, content.points[0].is_check) == (IMAGES[2], "rod 4", True)


def test_points_without_names_are_marked_without(tmp_path):
    path = tmp_path / "gcp_list.txt"
    path.write_text(f"EPSG:25832\n{E0} {N0} {LEVEL} 10 20 0000.jpg\n")
    path.write_text(with_marks(path, [mark("gcp_list 1")], CRS, IMAGES))
    assert path.read_text().splitlines()[2] == f"{E0} {N0} {LEVEL} 11.846 40.000 0001.jpg"
    assert {mark.point for mark in read_gcp_list(path).marks} == {"gcp_list 1"}


@pytest.mark.parametrize("header", ["EPSG:4326", "EPSG:25833", "+proj=utm +zone=32 +ellps=GRS80 +units=m +no_defs"])
def test_new_points_of_a_list_in_another_crs_come_back_where_they_are(tmp_path, header):
    path = tmp_path / "gcp_list.txt"
    path.write_text(f"{header}\n")
    path.write_text(with_marks(path, [mark()], CRS, IMAGES))
    (tmp_path / "s").mkdir()
    store = store_of(tmp_path / "s", gcps=path.read_text())
    assert np.abs(np.array(store.points()[PointKey(GROUND, "new")].place) - PLACE).max() < 2e-4


@pytest.mark.parametrize(
    ("crs", "header"),
    [("EPSG:25832+5778", "EPSG:25832"), ("EPSG:2263+6360", "EPSG:2263"), ("EPSG:32618+6360", "EPSG:32618+6360")],
)
def test_the_header_tells_the_unit_of_the_heights(crs, header):
    assert header_of(parse_crs(crs)) == header


def test_a_crs_without_a_code_is_written_as_a_proj_string(tmp_path):
    crs = parse_crs(
        "+proj=tmerc +lon_0=9.2 +k=1 +x_0=500000 +y_0=0 +ellps=GRS80 +units=m +geoidgrids=@null +vunits=m +no_defs"
    )
    path = tmp_path / "gcp_list.txt"
    path.write_text(with_marks(path, [mark()], crs, IMAGES))
    assert "+proj=tmerc" in path.read_text()
    assert read_gcp_list(path).points[0].place == PLACE


def test_clicks_keep_columns_order_comments_and_decimal_commas(tmp_path):
    path = tmp_path / "clicks.csv"
    path.write_text("# at the stones\nname;image;x;y;std;note\nw1;0000.jpg;10,5;20,25;1,5;sharp\nw1;0001;3;4;;\n")
    path.write_text(with_click(path, "w2", "0001.jpg", (7.25, 8.125), IMAGES))
    assert path.read_text() == (
        "# at the stones\nname,image,x,y,std,note\nw1,0000.jpg,10.5,20.25,1.5,sharp\nw1,0001,3,4,,\n"
        "w2,0001.jpg,7.250,8.125,,\n"
    )
    path.write_text(with_click(path, "w1", "0001.jpg", (1.0, 2.0), IMAGES))
    assert "w1,0001,1.000,2.000,,\n" in path.read_text()
    path.write_text(with_click(path, "w1", "0000.jpg", None, IMAGES))
    rows = read_clicks(path, IMAGES)
    assert [(row.name, row.image, row.pixel) for row in rows] == [
        ("w1", "0001.jpg", (1.0, 2.0)),
        ("w2", "0001.jpg", (7.25, 8.125)),
    ]


def store_of(folder, *, gcps: str | None = None, points=None, control: str = 'gcps = "gcp_list.txt"') -> MarkStore:
    small_survey(folder, toml=replaced() + f"[control]\n{control}\n")
    if gcps is not None:
        (folder / "gcp_list.txt").write_text(gcps)
    config, found = survey_to_mark(folder)
    return MarkStore(config, found, points)


def test_process_reads_what_was_marked(tmp_path):
    folder, points = tmp_path / "s", tmp_path / "gcps.csv"
    points.write_text(table())
    store = store_of(folder, points=points)
    assert [key.name for key in store.points()] == ["p1", "p2", "p3"]
    for i, name in enumerate(("p1", "p2", "p3")):
        for j in range(2):
            store.set(PointKey(GROUND, name), f"000{j}.jpg", (10.125 + i, 20.5 + j))
    found = find_survey(folder)
    assert found.control is not None
    assert [(mark.point, mark.view) for mark in found.control.merged.marks][:2] == [
        ("p1", "0000.jpg"),
        ("p1", "0001.jpg"),
    ]
    assert [mark.pixel for mark in found.control.merged.marks][:2] == [(10.125, 20.5), (10.125, 21.5)]
    assert store.settings() == []


def test_edits_are_taken_back_one_by_one(tmp_path):
    store = store_of(tmp_path / "s", gcps=odm(images=("0000.jpg",)))
    key, path = PointKey(GROUND, "p1"), tmp_path / "s" / "gcp_list.txt"
    before = store.marks()
    store.set(key, "0000.jpg", (1.0, 2.0))
    store.set(key, "0000.jpg", None)
    store.set(key, "0001.jpg", (5.0, 6.0))
    assert [store.undo().image for _ in range(3)] == ["0001.jpg", "0000.jpg", "0000.jpg"]
    assert store.marks() == before
    assert not store.can_undo
    with pytest.raises(SurveyError, match="nothing to undo"):
        store.undo()
    assert sorted(line.split()[6] for line in path.read_text().splitlines()[1:]) == ["p1", "p2", "p3"]


def test_what_another_program_writes_meanwhile_stays(tmp_path):
    store = store_of(tmp_path / "s", gcps=odm(images=("0000.jpg",)))
    path = tmp_path / "s" / "gcp_list.txt"
    path.write_text(path.read_text() + f"{E0} {N0} {LEVEL} 1 2 0003.jpg p1\n")
    store.set(PointKey(GROUND, "p2"), "0001.jpg", (5.0, 6.0))
    assert store.marks()[PointKey(GROUND, "p1")]["0003.jpg"] == (1.5, 2.5)
    assert len(path.read_text().splitlines()) == 6


def test_marks_of_other_files_go_into_the_list_when_it_is_written_first(tmp_path):
    folder = tmp_path / "s"
    folder.mkdir()
    (folder / "gcps.csv").write_text(table())
    (folder / "marks.csv").write_text("image,name,x,y\n0000.jpg,p1,10.5,20.5\n0001.jpg,p2,3.5,4.5\n")
    store = store_of(folder, control='gcps = "gcps.csv"\nmarks = "marks.csv"')
    assert store.marks()[PointKey(GROUND, "p1")] == {"0000.jpg": (10.5, 20.5)}
    assert not store.control_path.exists()
    store.set(PointKey(GROUND, "p3"), "0000.jpg", (7.5, 8.5))
    assert {key.name: len(own) for key, own in store.marks().items()} == {"p1": 1, "p2": 1, "p3": 1}
    assert store.settings() == ['[control] gcps = ["gcps.csv", "gcp_list.txt"], without marks']


def test_removing_a_mark_that_is_not_there_writes_no_file(tmp_path):
    store = store_of(tmp_path / "s")
    for key in (store.add(GROUND, "new", PLACE), store.add(WATER, "w1", None)):
        store.set(key, "0000.jpg", None)
    assert not store.can_undo
    assert not store.control_path.exists()
    assert not store.clicks_path.exists()


def test_a_mark_of_a_point_that_was_taken_out_of_the_file_is_not_put_back(tmp_path):
    store = store_of(tmp_path / "s", gcps=odm())
    store.set(PointKey(GROUND, "p1"), "0000.jpg", (1.0, 2.0))
    store.set(PointKey(GROUND, "p2"), "0000.jpg", (3.0, 4.0))
    lines = store.control_path.read_text().splitlines()
    store.control_path.write_text("\n".join([line for line in lines if " p2" not in line]) + "\n")
    with pytest.raises(SurveyError, match="mark of p2 cannot be put back"):
        store.undo()
    assert store.undo().key == PointKey(GROUND, "p1")


def test_points_without_names_keep_their_marks_when_the_first_is_removed_and_put_back(tmp_path):
    rows = [(1, "0000.jpg", 10), (2, "0000.jpg", 20), (1, "0001.jpg", 11), (2, "0001.jpg", 21), (3, "0002.jpg", 30)]
    lines = [f"{E0 + east} {N0} {LEVEL} {at} {at} {image}" for east, image, at in rows]
    store = store_of(tmp_path / "s", gcps="\n".join(["EPSG:25832", *lines, ""]))
    points, before = store.points(), store.marks()
    places = {key: point.place for key, point in points.items()}
    for key, image in [(key, image) for key, own in before.items() for image in own]:
        store.set(key, image, None)
        assert {key: point.place for key, point in store.points().items()} == places
    assert store.marks() == {}
    while store.can_undo:
        store.undo()
    assert store.marks() == before
    assert {key: point.place for key, point in store.points().items()} == places


def test_points_and_spots_are_added_by_name(tmp_path):
    store = store_of(tmp_path / "s")
    new = store.add(GROUND, " n1 ", PLACE)
    spot = store.add(WATER, "w1", None)
    assert (new, spot) == (PointKey(GROUND, "n1"), PointKey(WATER, "w1"))
    for name, what in (("n1", "already"), ("", "needs a letter"), ("a,b", "no comma")):
        with pytest.raises(SurveyError, match=what):
            store.add(GROUND, name, PLACE)
    with pytest.raises(SurveyError, match="no coordinates"):
        store.add(GROUND, "n2", None)
    with pytest.raises(SurveyError, match="outside of"):
        store.set(new, "0000.jpg", (65.0, 3.0))
    with pytest.raises(SurveyError, match="no photograph"):
        store.set(new, "else.jpg", (5.0, 3.0))
    store.set(spot, "0002.jpg", (64.0, 0.0))
    assert (tmp_path / "s" / "clicks.csv").read_text() == "image,x,y,name\n0002.jpg,64.000,0.000,w1\n"
    assert store.settings() == ['[water] clicks = "clicks.csv", in place of the level that is there']


def test_a_file_that_cannot_be_read_is_not_written_over(tmp_path):
    store = store_of(tmp_path / "s", gcps=odm())
    path = tmp_path / "s" / "gcp_list.txt"
    path.write_text("not a list\n")
    with pytest.raises(SurveyError, match="not a CRS"):
        store.set(PointKey(GROUND, "p1"), "0000.jpg", (5.0, 3.0))
    assert path.read_text() == "not a list\n"


def test_the_poses_file_is_read_once_for_the_masks_of_all_photographs(tmp_path, monkeypatch):
    found, read = find_survey(small_survey(tmp_path / "s")), []
    monkeypatch.setattr(
        "survey.folder.found.read_poses", lambda path: read.append(path) or PoseFile((), PoseFrame.GRID)
    )
    assert {mask_path(found, name).name for name in found.images} == {f"{Path(n).stem}_mask.png" for n in found.images}
    assert read == [found.poses_path]
