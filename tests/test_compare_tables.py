"""A cloud against measured points alone: an echo sounder's and those by rod, heights and depths, in tables."""

from __future__ import annotations

import numpy as np
import pytest
from compare_plane import FRAME, compared, grid, write_las
from pyproj import CRS

from geo.errors import CRSMismatch
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
    with pytest.raises(CRSMismatch, match=r"rods\.csv are in different coordinate reference systems"):
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
