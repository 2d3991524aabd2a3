"""Inputs of a comparison: points of tables, heights and depths; points that their file calls no bed take no part."""

import laspy
import numpy as np
import pytest
from compare_plane import FRAME, compared, grid, write_las, write_plane
from pyproj import CRS

from geo import read_reference, write_ply
from geo.errors import GeoError
from geo.las import WITHHELD_STD_M, write_cloud
from geo.shapes import NOT_GROUND, Cloud, excluded_points, used_as_ground
from survey.compare.inputs import InputPaths, load_inputs, read_shape
from survey.compare.measure import read_checkpoints
from survey.compare.options import CompareError
from survey.files.foreign_text import crs_of_comment
from survey.files.point_table import Units

LEVEL = 3.0  # local, over the plane of the bed at its middle
OFF_M = 0.05


@pytest.fixture(autouse=True)
def _fewer_samples(monkeypatch):
    monkeypatch.setattr("survey.compare.measure.NUM_SAMPLES", 2000)


def points() -> np.ndarray:
    """Soundings in crs, lower than the cloud by `OFF_M`."""
    return FRAME.crs_from_local(grid(0.5) - [0.0, 0.0, OFF_M])


def level() -> float:
    return float(FRAME.crs_from_local(np.array([[0.0, 0.0, LEVEL]]))[0, 2])


def write_table(path, header: str | None, rows: np.ndarray, separator: str = ","):
    lines = [separator.join(f"{value:.4f}" for value in row) for row in rows.tolist()]
    path.write_text("\n".join([*([] if header is None else [header]), *lines]) + "\n")
    return path


def residual(found: dict) -> float:
    """Mean of those that the cloud surrounds."""
    return float(np.mean([r for row in found["asprs"]["residuals"] if (r := row["residual_m"]) is not None]))


@pytest.mark.parametrize(
    ("name", "header", "separator"),
    [("a.xyz", None, " "), ("a.csv", "easting,northing,height", ","), ("a.txt", "X;Y;Z", ";"), ("a.pts", None, "\t")],
)
def test_points_alone_are_a_reference_and_check_points_as_well(tmp_path, name, header, separator):
    cloud = write_las(tmp_path / "c.las", FRAME.crs_from_local(grid(0.25)))
    found = compared(cloud, write_table(tmp_path / name, header, points(), separator))
    assert found["mean_m"] == pytest.approx(OFF_M, abs=0.002)
    assert residual(found) == pytest.approx(OFF_M, abs=0.002)


def test_depths_are_below_the_level_that_is_given(tmp_path):
    cloud, at = write_las(tmp_path / "c.las", FRAME.crs_from_local(grid(0.25))), points()
    depths = np.column_stack([at[:, :2], level() - at[:, 2]])
    path = write_table(tmp_path / "a.csv", "easting,northing,depth", depths)
    found = compared(cloud, path, water_level=level())
    assert found["mean_m"] == pytest.approx(OFF_M, abs=0.002)
    with pytest.raises(CompareError, match="has depths, expected heights in crs: give --water-level"):
        compared(cloud, path)
    # The same as check points beside another reference.
    reference = write_table(tmp_path / "b.xyz", None, at, " ")
    found = compared(cloud, reference, water_level=level(), checkpoints=path)
    assert residual(found) == pytest.approx(OFF_M, abs=0.002)


def test_a_table_of_other_columns_is_refused(tmp_path):
    cloud = write_las(tmp_path / "c.las", FRAME.crs_from_local(grid(0.25)))
    path = write_table(tmp_path / "a.csv", None, np.ones((3, 6)))
    with pytest.raises(CompareError, match="has 6 columns without names"):
        compared(cloud, path)


def test_check_points_have_the_crs_and_the_units_that_their_file_says(tmp_path):
    cloud = CRS("EPSG:25832+7837")
    path = tmp_path / "rods.csv"
    path.write_text("# CoordinateSystem: EPSG:25833\ne,n,h\n1,2,3\n")
    with pytest.raises(GeoError, match=r"rods\.csv are in different coordinate reference systems"):
        read_checkpoints(path, None, cloud, Units.of(cloud))
    path.write_text("# CoordinateSystem: EPSG:25832\ne,n,h_ft,std_cm\n1,2,3,4\n")
    assert read_checkpoints(path, None, cloud, Units.of(cloud)) == pytest.approx(np.array([[1, 2, 3 * 0.3048, 0.04]]))
    path.write_text("e,n,depth_ft\n1,2,3\n")
    assert read_checkpoints(path, 10.0, cloud, Units.of(cloud))[0, 2] == pytest.approx(10.0 - 3 * 0.3048)


FEET = CRS("EPSG:2264+6360")


@pytest.mark.parametrize(("header", "height"), [("e,n,height_ftUS", 1900.0), ("e,n,h_m", 1900.0 * 1200.0 / 3937.0)])
@pytest.mark.parametrize("said", ["EPSG:2264", "EPSG:2264+6360", None])
def test_heights_of_a_table_whose_crs_has_none_are_those_of_the_other_file(tmp_path, header, height, said):
    comment = "" if said is None else f"# CoordinateSystem: {said}\n"
    table = tmp_path / "t.csv"
    table.write_text(
        f"{comment}{header}\n1400000,600000,{height!r}\n1400010,600010,{height!r}\n1400010,600000,{height!r}\n"
    )
    assert read_shape(table, None, FEET).points[:, 2] == pytest.approx(1900.0, abs=1e-9)
    # As the cloud, before the other file is read.
    other = tmp_path / "r.csv"
    other.write_text(
        "# CoordinateSystem: EPSG:2264+6360\ne,n,h\n1400000,600000,1900\n1400010,600010,1900\n1400010,600000,1900\n"
    )
    assert load_inputs(InputPaths(table, other), None).cloud.points[:, 2] == pytest.approx(1900.0, abs=1e-9)


@pytest.mark.parametrize(
    ("cells", "classes", "note"),
    [
        (["rock", "2", ""], None, "the classes of t.csv are not those of LAS (rock): all its points count"),
        (["2", "sand", ""], None, "the classes of t.csv are not those of LAS (sand): all its points count"),
        (["2", "300", "7"], None, "the classes of t.csv are not those of LAS (300): all its points count"),
        (["", "7", "2"], [1, 7, 2], ""),
        (["2", "7", ""], [2, 7, 1], ""),
        (["", "", ""], None, ""),
    ],
)
def test_classes_of_a_table(tmp_path, cells, classes, note):
    path = tmp_path / "t.csv"
    path.write_text("e,n,h,class\n" + "".join(f"{i}.5,{i}.25,{i}.125,{cell}\n" for i, cell in enumerate(cells)))
    shape = read_shape(path, None)
    assert (None if shape.classification is None else shape.classification.tolist()) == classes
    assert shape.notes == ((note,) if note else ())


@pytest.mark.parametrize(
    ("comment", "code"),
    [("# EPSG:25833", 25833), ("#EPSG: 25833", 25833), ("// crs = EPSG:25833", 25833), ("# CRS EPSG:25833", 25833),
     ("# SRID=25833", 25833), ("# Coordinates in EPSG:25833", 25833), ("# epsg:25833", 25833),
     ("# CoordinateSystem: EPSG:25833", 25833), ("# converted from EPSG:25833 to EPSG:25832", None),
     ("# not EPSG:25833", None), ("# EPSG:7837", None), ("# points of May 2026", None)],
)  # fmt: skip
def test_a_comment_that_is_nothing_but_a_code_is_the_crs(tmp_path, comment, code):
    path = tmp_path / "points.csv"
    path.write_text(f"{comment}\ne,n,h\n1,2,3\n")
    found = crs_of_comment(path, CompareError)
    assert found is None if code is None else found == CRS.from_epsg(code)


# Of LAS 1.4 and its topo-bathy profile: what is ground, an object, or not said, and every other one.
KEPT = [code for code in range(256) if code not in {7, 9, 18, 41, 42, 45}]
RAISED_M = 1.5


def with_flags(path, *, classes=None, withheld=None):
    """A LAS file with other classes and flags."""
    las = laspy.read(path)
    if classes is not None:
        las.classification = classes
    if withheld is not None:
        las.withheld = withheld
    las.write(path)
    return path


def spoilt(tmp_path, name, *, code=None, withheld=False):
    """Points on the plane, and a quarter more, a metre and a half over it, of a class or flagged."""
    good, bad = grid(0.25), grid(0.5, RAISED_M)
    path = write_las(tmp_path / name, FRAME.crs_from_local(np.concatenate([good, bad])))
    is_bad = np.arange(len(good) + len(bad)) >= len(good)
    classes = None if code is None else np.where(is_bad, code, 40).astype(np.uint8)
    return with_flags(path, classes=classes, withheld=is_bad if withheld else None), int(is_bad.sum())


def test_exactly_noise_water_and_beds_not_found_are_left_out():
    assert set(range(256)) - set(KEPT) == set(NOT_GROUND)


@pytest.mark.parametrize("flag", [*NOT_GROUND, "withheld"])
def test_points_that_are_no_bed_are_left_out_of_the_cloud_and_counted(tmp_path, flag):
    what = {"withheld": True} if flag == "withheld" else {"code": flag}
    cloud, num_bad = spoilt(tmp_path, "c.las", **what)
    found = compared(cloud, write_plane(tmp_path / "r.ply"))
    assert found["n_points"] == len(grid(0.25))
    assert found["n_cropped"] == 0
    assert found["max_m"] < 0.01
    said = "flagged withheld" if flag == "withheld" else f"of class {flag} ({NOT_GROUND[flag]})"
    assert any(f"of c.las are not of the ground and left out: {num_bad} {said}" in note for note in found["notes"])


@pytest.mark.parametrize("flag", [*NOT_GROUND, "withheld"])
def test_points_that_are_no_bed_are_left_out_of_the_reference_and_of_what_is_visible(tmp_path, flag):
    what = {"withheld": True} if flag == "withheld" else {"code": flag}
    reference, num_bad = spoilt(tmp_path, "r.las", **what)
    cloud = write_las(tmp_path / "c.las", FRAME.crs_from_local(grid(0.25, 0.001)))
    found = compared(cloud, reference, visible=reference, c2c=True)
    assert found["completeness"] == found["completeness_visible"] == 1.0
    assert found["c2c"]["to_cloud"]["max_m"] < 0.01
    assert sum(f"{num_bad} of " in note for note in found["notes"]) == 1


@pytest.mark.parametrize("code", [0, 1, 2, 8, 12, 40, 43, 64, 255])
def test_other_classes_are_compared(tmp_path, code):
    cloud, num_bad = spoilt(tmp_path, "c.las", code=code)
    found = compared(cloud, write_plane(tmp_path / "r.ply"))
    assert found["n_points"] == len(grid(0.25)) + num_bad
    assert found["max_m"] == pytest.approx(RAISED_M, abs=0.01)
    assert not any("not of the ground" in note for note in found["notes"])


@pytest.mark.parametrize("point_format", range(11))
def test_flags_are_read_in_every_point_format(tmp_path, point_format):
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    las = laspy.LasData(header)
    las.x, las.y, las.z = grid(1.0)[:4].T
    las.classification, las.withheld = [2, 7, 9, 2], [False, False, False, True]
    las.write(tmp_path / "c.las")
    out, said = excluded_points(read_reference(tmp_path / "c.las"))
    assert out.tolist() == [False, True, True, True]
    assert said == "1 flagged withheld, 1 of class 7 (low noise), 1 of class 9 (water)"


def test_classes_that_cloudcompare_keeps_in_a_ply_count_too(tmp_path):
    at = grid(1.0)
    scalars = {"Classification": np.where(np.arange(len(at)) < 5, 7, 2)}
    write_ply(tmp_path / "c.ply", at, rgb=np.zeros((len(at), 3), np.uint8), scalars=scalars)
    assert excluded_points(read_reference(tmp_path / "c.ply"))[0].sum() == 5


def test_a_cloud_of_nothing_but_water_is_refused_with_what_it_holds(tmp_path):
    cloud = with_flags(
        write_las(tmp_path / "c.las", FRAME.crs_from_local(grid(1.0))), classes=np.full(121, 9, np.uint8)
    )
    with pytest.raises(CompareError, match=r"no point of .*c\.las is of the ground: it holds 121 of class 9 \(water\)"):
        compared(cloud, write_plane(tmp_path / "r.ply"))


def test_points_that_may_be_metres_off_are_withheld_and_others_not(tmp_path):
    std = np.array([0.01, WITHHELD_STD_M, 1.001, 30.0, np.nan])
    write_cloud(
        tmp_path / "c.laz", grid(1.0)[:5], CRS("EPSG:25832+5778"), rgb=np.zeros((5, 3), np.uint8), depth_m=np.ones(5),
        std_m=std, num_views=np.full(5, 3), incidence_deg=np.zeros(5), is_wet=np.ones(5, bool),
    )  # fmt: skip
    assert np.asarray(laspy.read(tmp_path / "c.laz").withheld).tolist() == [0, 0, 1, 1, 0]


@pytest.mark.parametrize("name", ["Withheld", "withheld_flag", "WithheldFlag"])
def test_a_flag_of_las_that_a_ply_keeps_counts_too(tmp_path, name):
    at = grid(1.0)
    scalars = {name: (np.arange(len(at)) < 5).astype(np.uint8)}
    write_ply(tmp_path / "c.ply", at, rgb=np.zeros((len(at), 3), np.uint8), scalars=scalars)
    assert excluded_points(read_reference(tmp_path / "c.ply"))[1] == "5 flagged withheld"


@pytest.mark.parametrize("name", ["classification", "Class", "Scalar_Classification"])
@pytest.mark.parametrize("code", [7, 9, 45])
def test_classes_of_a_table_count_too(tmp_path, name, code):
    lines = [f"{e},{n},{h},{code if i < 5 else 2}" for i, (e, n, h) in enumerate(grid(1.0).tolist())]
    (tmp_path / "c.xyz").write_text("\n".join([f"x,y,z,{name}", *lines]))
    assert excluded_points(read_shape(tmp_path / "c.xyz", None))[0].sum() == 5


@pytest.mark.parametrize("code", [3, 4, 5, 6, 12, 14, 17, 20])
def test_points_that_may_be_none_of_the_ground_count_and_are_named(code):
    points = np.zeros((5, 3))
    cloud = Cloud(points=points, classification=np.array([2, 40, code, code, 1], dtype=np.uint8))
    assert not excluded_points(cloud)[0].any()
    assert used_as_ground(cloud).startswith(f"2 of class {code} (")
    assert used_as_ground(Cloud(points=points)) == ""


def test_points_flagged_overlap_are_used_and_counted_and_synthetic_ones_are_those_of_photographs(tmp_path):
    path = write_las(tmp_path / "c.las", FRAME.crs_from_local(grid(0.5)))
    las = laspy.read(path)
    assert np.asarray(las.synthetic).all()
    las.overlap = np.arange(len(las.x)) % 3 == 0
    las.write(path)
    cloud = read_reference(path)
    assert not excluded_points(cloud)[0].any()
    assert used_as_ground(cloud) == f"{-(-len(cloud.points) // 3)} flagged overlap"
