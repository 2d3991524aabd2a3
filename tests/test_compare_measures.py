"""What `compare` measures beside the distance: parts, intervals, vertical differences, check points and more."""

import re
from pathlib import Path

import numpy as np
import pytest
from compare_plane import (
    FRAME,
    HALF,
    LAS_M,
    NUM_SAMPLES,
    ORIGIN,
    UTM32,
    compared,
    grid,
    write_las,
    write_mesh,
    write_plane,
)
from pyproj import CRS

from geo import Cloud, LocalFrame, Mesh, write_ply
from survey.compare.comparison import CompareOptions, _edge_note, compare_files
from survey.compare.inputs import InputPaths, Inputs
from survey.compare.options import CompareError
from survey.compare.pictures import _tick
from survey.compare.tables import limits_label, sections_of
from survey.display.quantities import count


@pytest.fixture(autouse=True)
def _fewer_samples(monkeypatch):
    monkeypatch.setattr("survey.compare.measure.NUM_SAMPLES", NUM_SAMPLES)


@pytest.fixture
def plane(tmp_path):
    return write_plane(tmp_path / "reference.ply")


@pytest.fixture
def cloud(tmp_path):
    return write_las(tmp_path / "cloud.las", FRAME.crs_from_local(grid(0.1, 0.1)))


STATISTICS = [
    "n_points", "n_nan", "mean_m", "median_m", "std_m", "rms_m", "mean_inner90_m", "std_inner90_m", "nmad_m",
    "p95_abs_m", "min_m", "max_m",
]  # fmt: skip
INTERVALS = ["mean_ci95_m", "mean_inner90_ci95_m"]
SCORES = ["completeness", "accuracy_share", "f_score", "tolerance_m", "completeness_visible"]
CIRCUMSTANCES = [
    "outliers", "confidence", "water_level", "method", "sign", "crs", "bounds", "cloud", "reference", "visible",
    "n_samples", "seed", "notes",
]  # fmt: skip
BANDS = ["depth_bands", "incidence_bands", "views_bands", "slope_bands"]


def test_the_numbers_keep_their_names(tmp_path, plane):
    """Scripts read `--json` and report.json by these names."""
    local = np.concatenate([grid(0.2, 0.1), [[0.0, 0.0, 1.5]]])
    cloud = write_las(
        tmp_path / "c.las", FRAME.crs_from_local(local), num_views=3, incidence_deg=20.5, depth=1.0 - local[:, 2]
    )
    table = tmp_path / "points.csv"
    table.write_text(",".join(f"{v:.4f}" for v in FRAME.crs_from_local(np.zeros(3))))
    numbers = compared(cloud, plane, visible=plane, checkpoints=table, c2c=True, water_level=ORIGIN[2] + 1.0)
    at_the_top = {*STATISTICS, "n_cropped", *INTERVALS, *SCORES}
    below = {"tolerances", "wet", "dry", *BANDS, "completeness_by_slope", "vertical", "iho_s44", "asprs", "c2c"}
    assert set(numbers) == (at_the_top | below | {*CIRCUMSTANCES}) - {"dry"}
    part = [*STATISTICS, *INTERVALS]
    assert list(numbers["wet"]) == part
    for key, unit in zip(BANDS, ("m", "deg", "views", "deg"), strict=True):
        assert list(numbers[key][0]) == [f"from_{unit}", f"to_{unit}", *part]
    assert list(numbers["completeness_by_slope"][0]) == ["from_deg", "to_deg", "n_samples", "completeness"]
    assert list(numbers["tolerances"][0]) == SCORES
    assert list(numbers["vertical"]) == [*part, "n_holes", "wet", "depth_bands"]
    assert {name: list(found) for name, found in numbers["c2c"].items()} == {
        "to_reference": STATISTICS, "to_cloud": STATISTICS,
    }  # fmt: skip
    iho = numbers["iho_s44"]
    assert list(iho) == ["points", "error_95_m", "orders", "note", "error"]
    judged = ["share_within", "meets_tvu", "meets_tvu_at_all_depths", "undecided"]
    order = ["order", "tvu_at_median_depth_m", *judged, "depth_bands"]
    assert list(iho["orders"][0]) == order
    assert list(iho["orders"][0]["depth_bands"][0]) == ["from_m", "to_m", "n_points", "share_within"]
    rmse = ["rmse_fit_m", "rmse_checkpoints_m", "rmse_v_m"]
    counts = ["n_checkpoints", "n_not_covered", "is_enough"]
    assert list(numbers["asprs"]) == [*counts, "mean_m", "std_m", "min_m", "max_m", *rmse, "residuals"]
    assert list(numbers["asprs"]["residuals"][0]) == ["easting", "northing", "height", "residual_m"]
    confidence = ["level", "method", "block_m", "correlation_length_m", "widening", "draws", "seed"]
    assert list(numbers["confidence"]) == confidence
    assert numbers["asprs"]["std_m"] is None  # of one check point


def test_what_was_not_asked_for_or_cannot_be_known_is_not_there(cloud, plane):
    names = set(compared(cloud, plane))
    assert not names & {"completeness_visible", "wet", "dry", "depth_bands", "iho_s44", "asprs", "c2c", "m3c2"}


def test_several_tolerances_stand_beside_each_other_and_the_first_is_at_the_top(cloud, plane):
    numbers = compared(cloud, plane, tolerances_m=(0.2, 0.05))
    wide, narrow = numbers["tolerances"]
    assert {name: numbers[name] for name in wide} == wide
    assert (wide["tolerance_m"], wide["completeness"], wide["accuracy_share"]) == (0.2, 1.0, 1.0)
    assert (narrow["tolerance_m"], narrow["completeness"], narrow["f_score"]) == (0.05, 0.0, 0.0)


def test_bias_and_spread_are_told_by_depth_incidence_and_views(tmp_path, plane):
    """West: two views, 12 degrees, 1.2 m deep, 0.1 m too high; east: five, 33 degrees, 2.5 m deep, 0.2 m too low."""
    local = grid(0.1)
    west = local[:, 0] < 0.0
    local[:, 2] = np.where(west, 0.1, -0.2)
    cloud = write_las(
        tmp_path / "c.las", FRAME.crs_from_local(local), num_views=np.where(west, 2, 5),
        incidence_deg=np.where(west, 12.0, 33.0), depth=np.where(west, 1.2, 2.5) - local[:, 2],
    )  # fmt: skip
    numbers = compared(cloud, plane)
    for key, unit, limits in (
        ("depth_bands", "m", [(1.0, 2.0), (2.0, 3.0)]),
        ("incidence_bands", "deg", [(10.0, 15.0), (30.0, 35.0)]),
        ("views_bands", "views", [(2, 3), (4, 6)]),
    ):
        bands = numbers[key]
        assert [(b[f"from_{unit}"], b[f"to_{unit}"]) for b in bands] == limits
        assert [b["mean_m"] for b in bands] == pytest.approx([0.1, -0.2], abs=LAS_M / 10)
        assert all(b["std_m"] < LAS_M for b in bands)
        assert sum(b["n_points"] for b in bands) == len(local)


def test_a_water_level_gives_depths_to_a_cloud_that_has_none(tmp_path, plane):
    points = FRAME.crs_from_local(grid(0.5, 0.1))
    write_ply(tmp_path / "cloud.ply", points, rgb=np.zeros(points.shape, np.uint8), scalars={})
    numbers = compared(tmp_path / "cloud.ply", plane, water_level=ORIGIN[2] + 2.4)
    assert [(b["from_m"], b["to_m"]) for b in numbers["depth_bands"]] == [(2.0, 3.0)]
    assert numbers["iho_s44"]["points"] == len(points)


def test_the_interval_of_a_mean_holds_it_and_is_that_of_independent_errors(tmp_path, plane, rng):
    local = grid(0.1)
    local[:, 2] = rng.normal(0.03, 0.02, len(local))
    cloud = write_las(tmp_path / "c.las", FRAME.crs_from_local(local))
    numbers = compared(cloud, plane)
    low, high = numbers["mean_ci95_m"]
    assert low < numbers["mean_m"] < high
    # The standard error from its 150 blocks is known to 6 %; the quantiles of 1000 draws add 4 %; three of both.
    assert high - low == pytest.approx(2 * 1.96 * 0.02 / 101, rel=0.22)
    assert numbers["confidence"]["correlation_length_m"] == 0.0


def test_vertical_differences_are_longer_than_distances_and_holes_are_counted(tmp_path):
    """A plane that rises 3 in 4: the distance is 0.8 of the vertical difference."""
    corners = np.array([[-1, -1, -0.75], [1, -1, 0.75], [1, 1, 0.75], [-1, 1, -0.75]]) * HALF
    plane = write_mesh(tmp_path / "m.ply", FRAME.crs_from_local(corners), [[0, 1, 2], [0, 2, 3]])
    local = grid(0.5, half=4.0)
    local[:, 2] = 0.75 * local[:, 0] + 0.1
    beyond = np.array([[HALF + 1.0, 0.0, 3.75]])
    cloud = write_las(tmp_path / "c.las", FRAME.crs_from_local(np.concatenate([local, beyond])))
    numbers = compared(cloud, plane)
    assert numbers["vertical"]["mean_m"] == pytest.approx(0.1, abs=LAS_M)
    assert (numbers["vertical"]["n_points"], numbers["vertical"]["n_holes"]) == (len(local), 1)
    assert numbers["median_m"] == pytest.approx(0.08, abs=LAS_M)
    assert "iho_s44" not in numbers


def test_s44_judges_the_vertical_difference_under_water(tmp_path, plane):
    local = grid(0.1, 0.3)
    cloud = write_las(tmp_path / "c.las", FRAME.crs_from_local(local), depth=1.0 - local[:, 2])
    iho = compared(cloud, plane)["iho_s44"]
    assert iho["error"].startswith("vertical difference to the reference")
    assert [o["meets_tvu"] for o in iho["orders"]] == [False, False, True, True]


def test_check_points_are_compared_with_the_cloud_under_them(tmp_path, cloud, plane):
    """The cloud lies 0.1 m high; of four places one is off it."""
    local = np.array([[0.03, 0.02, 0.0], [1.01, -2.0, 0.1], [-3.0, 2.0, 0.2], [40.0, 0.0, 0.0]])
    lines = [f"{e:.6f}, {n:.6f}, {h:.6f}, 0.02" for e, n, h in FRAME.crs_from_local(local)]
    table = tmp_path / "points.csv"
    table.write_text("\n".join(["easting,northing,height,sigma", "# surveyed by level", *lines]) + "\n")
    numbers = compared(cloud, plane, checkpoints=table)
    asprs = numbers["asprs"]
    residuals = [row["residual_m"] for row in asprs["residuals"]]
    assert residuals[:3] == pytest.approx([0.1, 0.0, -0.1], abs=LAS_M)
    assert residuals[3] is None
    assert (asprs["n_checkpoints"], asprs["n_not_covered"]) == (3, 1)
    assert asprs["rmse_v_m"] == pytest.approx(np.sqrt(0.02 / 3 + 0.02**2), abs=LAS_M)
    assert any(
        "3 check points of points.csv lie on the cloud: ASPRS (Edition 2) requires at least 30" in n
        for n in numbers["notes"]
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("e,n,h\n1,2\n", r"points.csv, line 2: 2 values were found, expected 3"),
        ("1,2,3,-1\n", r"has 4 columns without names"),
        ("e,n,h,std\n1,2,3,-1\n", r"line 2: std is -1, expected .* not negative"),
        ("1,2,3\ne,n,h\n", r"line 2: easting is e, expected a finite number"),
        ("e,n,h\n", r"has no check points"),
    ],
)
def test_a_table_of_check_points_that_cannot_be_read_is_refused_by_line(tmp_path, cloud, plane, text, message):
    (tmp_path / "points.csv").write_text(text)
    with pytest.raises(CompareError, match=message):
        compared(cloud, plane, checkpoints=tmp_path / "points.csv")


def test_outliers_are_left_out_only_when_asked_for_and_said_so(tmp_path, plane):
    local = grid(0.1, 0.0)
    local[::1000, 2] = 3.0
    cloud = write_las(tmp_path / "c.las", FRAME.crs_from_local(local))
    as_it_is = compared(cloud, plane)
    assert (as_it_is["outliers"], as_it_is["n_points"], as_it_is["max_m"]) == (None, len(local), pytest.approx(3.0))
    numbers = compared(cloud, plane, outliers="sor:6,2.0")
    lost = len(local[::1000])
    assert (numbers["n_points"], numbers["n_cropped"], numbers["outliers"]) == (len(local) - lost, 0, "sor:6,2.0")
    assert numbers["max_m"] < LAS_M
    assert any(f"{lost} of {len(local)} points were left out as outliers (sor:6,2.0" in n for n in numbers["notes"])


def test_walls_have_their_own_completeness_and_spread(tmp_path):
    """A level square of 100 m² and an upright wall of 20 m² at its edge, of which the cloud has the lower half."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [1, -1, 2], [1, 1, 2]]) * [HALF, HALF, 1.0]
    faces = [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]]
    reference = write_mesh(tmp_path / "step.ply", FRAME.crs_from_local(corners), faces)
    wall = grid(0.05)[:, [2, 1, 0]] * [0, 1, 0.2] + [HALF - 0.02, 0, 0]
    wall = wall[(wall[:, 2] > 0.05) & (wall[:, 2] < 1.0)]
    floor = grid(0.05, 0.01)
    floor = floor[floor[:, 0] < HALF - 0.03]
    cloud = write_las(tmp_path / "c.las", FRAME.crs_from_local(np.concatenate([floor, wall])))
    numbers = compared(cloud, reference, tolerances_m=(0.2, 0.1))
    level, upright = numbers["completeness_by_slope"]
    assert (level["from_deg"], level["to_deg"], upright["from_deg"], upright["to_deg"]) == (0.0, 20.0, 66.4, None)
    assert level["completeness"] == [1.0, 1.0]
    # A tolerance reaches beyond the end of the points, less the 2 cm beside the wall.
    assert upright["completeness"] == pytest.approx([0.6, 0.55], abs=0.02)
    assert upright["n_samples"] == pytest.approx(NUM_SAMPLES / 6, rel=0.05)
    beside = numbers["slope_bands"][1]
    assert (beside["n_points"], beside["from_deg"]) == (len(wall), 66.4)
    assert abs(beside["mean_m"]) == pytest.approx(0.02, abs=LAS_M)


def test_cloud_to_cloud_is_measured_both_ways(tmp_path, cloud, plane):
    """The cloud covers the western half only: from it all is near, from the reference half is far."""
    e, n, _ = ORIGIN
    c2c = compared(cloud, plane, c2c=True, bounds=(e - 20.0, n - 20.0, e + 0.01, n + 20.0))["c2c"]
    assert c2c["to_reference"]["min_m"] >= 0.1 - 2 * LAS_M
    assert c2c["to_reference"]["max_m"] < 0.2
    assert c2c["to_cloud"]["max_m"] == pytest.approx(np.hypot(5.0, 0.1), abs=0.02)


def test_m3c2_is_measured_where_py4dgeo_is_there_and_asked_for_by_name_where_not(monkeypatch, cloud, plane):
    with monkeypatch.context() as without:
        without.setattr("importlib.util.find_spec", lambda name: None)
        with pytest.raises(CompareError, match=r"--m3c2 needs py4dgeo, .* pip install 'bathynerf\[m3c2\]'"):
            compared(cloud, plane, m3c2_radius_m=0.5)
    pytest.importorskip("py4dgeo", reason="py4dgeo is not installed: pip install 'bathynerf[m3c2]'")
    monkeypatch.setattr("survey.compare.measure._CORE_POINTS", 300)
    numbers = compared(cloud, plane, m3c2_radius_m=0.5)["m3c2"]
    assert numbers["mean_m"] == pytest.approx(0.1, abs=LAS_M / 5)
    assert numbers["significant_share"] == 1.0


def test_everything_that_was_measured_reaches_the_terminal(tmp_path, plane):
    local = grid(0.1, 0.1)
    cloud = write_las(tmp_path / "c.las", FRAME.crs_from_local(local), num_views=3, incidence_deg=20.5, depth=1.5)
    options = CompareOptions(tolerances_m=(0.2, 0.05), c2c=True, bounds=None)
    _, distances, *_ = sections_of(compare_files(cloud, plane, options=options))
    rows, *blocks = distances.blocks
    assert dict(rows.rows) | {"points compared": count(len(local)), "lowest": "100.0\u00a0mm"} == dict(rows.rows)
    *tables, notes = blocks
    assert notes.sentences[0].startswith("reference.ply does not say its CRS:")
    found = {table.heading: table for table in tables}
    by = ("depth", "incidence", "views that agree", "slope of the reference")
    others = {"Completeness", "Bias and spread", "Completeness by slope"}
    assert found.keys() == others | {f"By {name}" for name in by}
    assert found["Completeness"].rows == [("0.2", "100.0", "100.0", "100.0"), ("0.05", "0.0", "0.0", "0.0")]
    parts = [row[0] for row in found["Bias and spread"].rows]
    assert parts == ["all points", "vertical difference", "wet points", "cloud to cloud, to the reference",
                     "cloud to cloud, to the cloud"]  # fmt: skip
    assert found["By incidence"].rows[0][0] == "20 to 25°"
    assert found["By views that agree"].rows[0][0] == "3 views"
    assert found["By depth"].rows[0][2] == "100.0"
    assert found["Completeness by slope"].rows == [("0 to 20°", count(NUM_SAMPLES), "100.0", "0.0")]


def test_check_points_reach_the_terminal_without_what_one_alone_cannot_tell(tmp_path, cloud, plane):
    """The cloud lies 0.1 m high; one residual has no standard deviation."""
    table = tmp_path / "points.csv"
    table.write_text(",".join(f"{v:.6f}" for v in FRAME.crs_from_local(np.zeros(3))) + ", 0.02\n")
    options = CompareOptions(checkpoints=table)
    sections = {section.title: section.blocks for section in sections_of(compare_files(cloud, plane, options=options))}
    shown = dict(sections["Check points (ASPRS, Edition 2)"][0].rows)
    assert list(shown) == [
        "check points", "mean", "lowest", "highest", "RMSE of the cloud", "RMSE of the check points", "vertical RMSE"
    ]  # fmt: skip
    assert shown["check points"] == "1 on the cloud, 0 beside it: too few for a test"
    assert shown["RMSE of the check points"] == "20.0\u00a0mm"
    assert float(shown["mean"].removesuffix("\u00a0mm")) == pytest.approx(100.0, abs=1e3 * LAS_M)


@pytest.mark.parametrize(
    ("low", "high", "unit", "label", "tick"),
    [
        (2.0, 3.0, "m", "2 to 3 m", "2–3"),
        (30.0, np.inf, "m", "30 m and more", "30+"),
        (20.0, 25.0, "deg", "20 to 25°", "20–25"),
        (3, 4, "views", "3 views", "3"),
        (4, 6, "views", "4 to 5 views", "4–5"),
        (24, np.inf, "views", "24 views and more", "24+"),
    ],
)
def test_a_band_is_named_by_its_limits(low, high, unit, label, tick):
    assert limits_label(low, high, unit) == label
    assert _tick(label) == tick


@pytest.mark.parametrize("crs", [UTM32, CRS("EPSG:4326+5773")])
def test_points_beside_a_mesh_are_left_out_by_bounds_that_hold_it_and_those_in_its_holes_are_not(crs):
    unit = 1.0 if crs is UTM32 else 1e-5
    at = np.array([*ORIGIN[:2], 0.0]) if crs is UTM32 else np.array([11.36123456, 46.9, 0.0])
    corners = at + np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [5 * unit, 5 * unit, 1.0]
    mesh = Mesh(vertices=corners, faces=np.array([[0, 2, 1], [0, 3, 2]]), crs=crs)
    points = at + np.column_stack([np.linspace(-9, 9, 50), np.zeros(50), np.zeros(50)]) * [unit, unit, 1.0]
    frame = LocalFrame(crs, tuple(at.tolist()))
    paths = InputPaths(Path("c.las"), Path("r.ply"))
    inputs = Inputs(paths, Cloud(points=points, crs=crs), np.ones(50, bool), 0, mesh, None, crs, frame, ())
    is_off = np.abs(points[:, 0] - at[0]) > 5 * unit
    (note,) = _edge_note(inputs, np.where(is_off, np.nan, 0.0))
    bounds = tuple(float(word) for word in re.findall(r"--bounds (.*?),", note)[0].split())
    (west, _), (east, _) = corners[0, :2], corners[1, :2]
    assert (bounds[0], bounds[2]) == pytest.approx((west, east), abs=0.001 * unit, rel=0.0)
    (note,) = _edge_note(inputs, np.where(is_off, 0.0, np.nan))
    assert "they are in holes of r.ply" in note
