"""A sentence for every mistake in a file of control, and none that ends in another error."""

import contextlib

import pytest
from control_files import METASHAPE, SIZES, SURVEY_CRS, gathered, marks, odm, table, written
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_survey import E0, LEVEL, N0

from geo.errors import GeoError
from survey.control.reading import merge_control, read_control
from survey.errors import ControlError

BOMB = "<!DOCTYPE d [<!ENTITY a 'aaaaaaaaaa'><!ENTITY b '&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;'>]>\n"
EXTERNAL = "<!DOCTYPE d [<!ENTITY x SYSTEM 'http://example.invalid/x'>]>\n"

FAULTS = {
    "empty": ({"gcp_list__txt": ""}, "gcp_list.txt is empty, expected points of GPX"),
    "only comments": ({"gcp_list__txt": "# nothing\n\n"}, "is empty, expected a line with its CRS"),
    "no points": ({"gcp_list__txt": "EPSG:25832\n"}, "gcps has no points; name a file with"),
    "no header": ({"gcp_list__txt": odm().split("\n", 1)[1]}, "line 1: .* is a line of a point, expected"),
    "header of no kind": ({"gcp_list__txt": odm(header="Gauss")}, 'line 1: "Gauss" is not a CRS that gcp_list.txt may'),
    "unknown code": ({"gcp_list__txt": odm(header="EPSG:999999")}, "is not a known CRS"),
    "unknown projection": ({"gcp_list__txt": odm(header="+proj=utmost +x=1")}, "is not a known CRS"),
    "zone 61": ({"gcp_list__txt": odm(header="WGS84 UTM 61N")}, "is not a UTM zone, expected 1 to 60"),
    "heights of another datum": ({"gcp_list__txt": odm(header="EPSG:25832+5773")}, "above EGM96 height, expected"),
    "ellipsoidal heights": ({"gcp_list__txt": odm(header="EPSG:4979")}, "above the ellipsoid, expected above"),
    "short line": ({"gcp_list__txt": odm() + "1 2 3\n"}, "line 8: 3 values were found, expected x y z px py image"),
    "NaN": ({"gcp_list__txt": odm().replace("2105.0 10 20", "nan 10 20")}, "line 2: z is nan, expected a finite"),
    "word": ({"gcp_list__txt": odm().replace("2105.0 10 20", "2105.0 ten 20")}, "line 2: px is ten"),
    "long number": ({"gcp_list__txt": odm().replace("2105.0 10 20", "9" * 4000 + " 10 20")}, "z is 9{57}"),
    "other place": (
        {"gcp_list__txt": odm().replace(f"{E0} {N0} {LEVEL} 10 21", f"{E0 + 1} {N0} {LEVEL} 10 21")},
        r"line 3: the point p1 is at 589013, 5194736, 2105, but at 589012, 5194736, 2105 in .*line 2",
    ),
    "second mark": ({"gcp_list__txt": odm() + f"{E0} {N0} {LEVEL} 3 4 0000.jpg p1\n"}, "line 8: p1 has a second mark"),
    "outside": ({"gcp_list__txt": odm().replace(" 10 20 ", " 70 20 ")}, "line 2: the mark of p1 at 70.5, 20.5"),
    "unknown images": ({"gcp_list__txt": odm(images=("x.jpg",))}, "no photograph of the survey is called x.jpg"),
    "no column": ({"points__csv": "name,easting,northing\na,1,2\n"}, "no column height; expected easting, northing"),
    "no header in a table": ({"points__csv": "p1,1,2,3\n"}, "the first line has no column easting, northing"),
    "no name": ({"points__csv": "name,x,y,z\n,1,2,3\n"}, "line 2: name is empty"),
    "wrong role": ({"points__csv": "name,x,y,z,role\na,1,2,3,both\n"}, 'the role is "both", expected control or check'),
    "wrong accuracy": ({"points__csv": "name,x,y,z,std\na,1,2,3,-1\n"}, "the standard deviations are -1, -1, -1"),
    "no marks": ({"points__csv": table()}, "names points without marks"),
    "no coordinates": ({"marks__csv": marks()}, "gcps has no points"),
    "unknown points": ({"points__csv": table(), "marks__csv": marks(("q",))}, "no point with coordinates is called q"),
    "unknown system": ({"points__csv": "# CoordinateSystem: PROJCS[\n" + table()}, '"PROJCS.* is not'),
    "latin-1": ({"gcp_list__txt": odm().replace("p1", "Fähre").encode("latin-1")}, "is not UTF-8"),
    "latin-1 under another name": ({"ground__txt": odm().replace("p1", "Fähre").encode("latin-1")}, "is not UTF-8"),
    "space in a name": (
        {"gcp_list__txt": odm(images=("shore 0000.JPG", "0001.jpg"))},
        '"shore 0000.JPG" has a space.*by tabs',
    ),
    "commas": ({"gcp_list__txt": "EPSG:25832\n1,2,3,4,5,0000.jpg\n"}, "separated by commas, expected spaces or tabs"),
    "unknown kind": ({"points__txt": "abc\n"}, "is not a known kind of control file, expected points"),
    "binary": ({"points__txt": b"\x00\xff\xfe" * 50}, "is not UTF-8"),
    "no markers": ({"m__xml": "<document/>"}, "has no markers"),
    "half of an XML": ({"m__xml": METASHAPE[:900]}, "is not well-formed XML"),
    "two chunks": (
        {"m__xml": "<d>" + 2 * "<chunk><markers><marker id='1' label='a'/></markers></chunk>" + "</d>"},
        "has markers of 2 chunks, expected one",
    ),
    "entities": ({"m__xml": METASHAPE.replace("<document", BOMB + "<document")}, "line 2: a document type"),
    "external entity": ({"m__xml": METASHAPE.replace("<document", EXTERNAL + "<document")}, "line 2: a document type"),
    "nested": ({"m__xml": "<a>" * 5000}, "nested more than 100 deep"),
    "number in XML": ({"m__xml": METASHAPE.replace('x="589012"', 'x="inf"')}, 'marker "p1": x is inf, expected'),
    "camera not there": ({"m__xml": METASHAPE.replace('id="7" sensor', 'id="8" sensor')}, "there is no such camera"),
    "reference": ({"m__xml": METASHAPE.replace("<reference><", "<reference>PROJCS[1]<")}, "is not a known CRS"),
}  # fmt: skip


@pytest.mark.parametrize(("files", "words"), FAULTS.values(), ids=FAULTS.keys())
def test_a_fault_is_one_sentence_with_its_place_and_a_remedy(tmp_path, files, words):
    with pytest.raises((ControlError, GeoError), match=words) as error:
        gathered(written(tmp_path, **files))
    assert ";" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_there_is_refused_by_name(tmp_path):
    with pytest.raises(ControlError, match=r"none\.csv does not exist; correct \[control\]"):
        read_control(tmp_path / "none.csv")
    with pytest.raises(ControlError, match="is a folder"):
        read_control(tmp_path)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_no_file_however_damaged_ends_in_another_error(tmp_path, data):
    """Texts of every format with pieces cut out, doubled or replaced, read as a file of every name."""
    whole = data.draw(st.sampled_from([odm(), table(), marks(), METASHAPE, odm().replace(" ", "\t")]))
    for _ in range(data.draw(st.integers(0, 3))):
        at = data.draw(st.integers(0, len(whole)))
        to = min(at + data.draw(st.integers(0, 30)), len(whole))
        whole = (
            whole[:at]
            + data.draw(st.sampled_from(["", whole[at:to] * 2, "\0", "nan", ";", "\t", '"', "<", "1e999", "é"]))
            + whole[to:]
        )
    path = tmp_path / data.draw(st.sampled_from(["gcp_list.txt", "a.csv", "a.xml", "a.txt"]))
    path.write_bytes(whole.encode(data.draw(st.sampled_from(["utf-8", "utf-16", "latin-1"]))))
    with contextlib.suppress(ControlError):
        merge_control([read_control(path)], SURVEY_CRS, SIZES)
