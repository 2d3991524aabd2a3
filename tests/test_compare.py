"""`compare` on small files: what it measures, what it refuses and what it writes."""

import json
import re

import laspy
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
from PIL import Image
from pyproj import CRS

from geo import LocalFrame, write_ply
from geo.errors import GeoError, PlaceMismatch, UnreadableFile
from survey.compare.comparison import CompareOptions, compare_files
from survey.compare.options import CompareError
from survey.compare.pictures import completeness_map, error_map, histogram
from survey.compare.tables import sections_of
from survey.errors import OutputError, SurveyError

# Six standard deviations of a share of that many samples.
SAMPLING = 6 * 0.5 / NUM_SAMPLES**0.5


@pytest.fixture(autouse=True)
def _fewer_samples(monkeypatch):
    monkeypatch.setattr("survey.compare.measure.NUM_SAMPLES", NUM_SAMPLES)


@pytest.fixture
def plane(tmp_path):
    return write_plane(tmp_path / "reference.ply")


@pytest.fixture
def cloud(tmp_path):
    return write_las(tmp_path / "cloud.las", FRAME.crs_from_local(grid(0.1, 0.1)))


def test_a_cloud_above_the_reference_is_found_at_its_height(cloud, plane):
    numbers = compared(cloud, plane)
    assert numbers["method"] == "cloud to mesh"
    assert numbers["n_points"] == 101**2
    assert numbers["mean_m"] == pytest.approx(0.1, abs=LAS_M / 10)
    assert numbers["std_m"] < LAS_M
    assert (numbers["completeness"], numbers["accuracy_share"], numbers["f_score"]) == (1.0, 1.0, 1.0)
    assert (numbers["n_cropped"], numbers["bounds"]) == (0, None)
    assert "completeness_visible" not in numbers
    assert "cloud.las" in numbers["notes"][0]
    assert "reference.ply does not say its CRS" in numbers["notes"][0]


def test_winding_decides_where_it_is_asked_to(cloud, plane):
    numbers = compared(cloud, plane, sign="winding")
    assert numbers["mean_m"] == pytest.approx(-0.1, abs=LAS_M / 10)
    assert numbers["sign"] == "winding"
    assert not any("opposite winding" in note for note in numbers["notes"])


def test_points_beside_the_reference_are_noted_with_the_bounds_that_leave_them_out(tmp_path, plane, cloud):
    wide = write_las(tmp_path / "wide.las", FRAME.crs_from_local(grid(0.1, 0.1, half=1.5 * HALF)))
    (note,) = [note for note in compared(wide, plane)["notes"] if "--bounds" in note and "above or below" in note]
    bounds = [float(word.rstrip(",")) for word in note.split("--bounds")[1].split()[:4]]
    cropped = compared(wide, plane, bounds=tuple(bounds))
    assert not any("above or below" in note for note in cropped["notes"])
    assert cropped["mean_m"] == pytest.approx(0.1, abs=LAS_M / 10)
    assert not any("above or below" in note for note in compared(cloud, plane)["notes"])


def test_triangles_that_are_wound_against_each_other_are_noted_where_winding_counts(tmp_path, cloud):
    corners = FRAME.crs_from_local(np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [HALF, HALF, 1.0])
    twice = [[0, 2, 1], [0, 3, 2], [0, 1, 2], [0, 2, 3]]
    for faces, turned in (([[0, 2, 1], [0, 2, 3]], 1), (twice, 2), ([[0, 1, 2], [0, 2, 3]], 0)):
        mesh = write_mesh(tmp_path / "mesh.ply", corners, faces)
        for sign in ("up", "winding") if turned == 1 else ("winding",):
            said = [note for note in compared(cloud, mesh, sign=sign)["notes"] if "opposite winding" in note]
            assert len(said) == (sign == "winding" and turned > 0)
            assert all(f"along {turned} edges" in note for note in said)


def test_distances_are_metres_on_the_ground_and_not_of_the_map_grid(tmp_path, plane):
    """100 m beyond the rim at 2,105 m height: UTM counts 0.9996 * 0.99967 of it, 99.93 m."""
    points = FRAME.crs_from_local(np.array([[0.0, 0.0, 0.0], [HALF + 100.0, 0.0, 0.0]]))
    assert np.linalg.norm(points[1, :2] - points[0, :2]) < 105.0 - 0.07
    cloud = write_las(tmp_path / "far.las", points)
    assert compared(cloud, plane)["max_m"] == pytest.approx(100.0, abs=2 * LAS_M)


def test_bounds_crop_the_cloud_first_and_completeness_sees_a_tolerance_more(tmp_path, cloud, plane):
    """Bounds over x up to 0.01 m: the points up to 0.31 m count for completeness and reach 0.3 m around."""
    e, n, _ = ORIGIN
    numbers = compared(cloud, plane, tolerances_m=(0.3,), bounds=(e - 20.0, n - 20.0, e + 0.01, n + 20.0))
    assert (numbers["n_points"], numbers["n_cropped"]) == (51 * 101, 50 * 101)
    # The last column of them stands at 0.3 m, 0.1 m above the plane, and reaches sqrt(0.3² - 0.1²) further.
    assert numbers["completeness"] == pytest.approx((5.0 + 0.3 + np.sqrt(0.08)) / 10.0, abs=SAMPLING)
    assert any("lies outside the bounds" in note for note in numbers["notes"])


def test_completeness_over_visible_points_counts_all_of_them(tmp_path, cloud, plane):
    local = np.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, -0.2], [3.0, 0, 0.05]])
    visible = tmp_path / "visible.ply"
    points = FRAME.crs_from_local(local)
    write_ply(visible, points, rgb=np.zeros((4, 3), np.uint8), scalars={})
    numbers = compared(cloud, plane, tolerances_m=(0.2,), visible=visible)
    assert numbers["completeness_visible"] == 0.75
    assert numbers["completeness"] == 1.0
    assert not any("--visible" in note for note in numbers["notes"])
    notes = [note for note in compared(cloud, plane)["notes"] if "--visible" in note]
    assert [note.split(",")[0] for note in notes] == ["completeness counts all of reference.ply"]


def test_all_options_and_small_files_are_looked_at_before_a_cloud_is_read(tmp_path, monkeypatch, cloud, plane):
    def too_late(*_args):
        raise AssertionError("a cloud was read")

    monkeypatch.setattr("survey.compare.comparison.load_inputs", too_late)
    (tmp_path / "points.csv").write_text("easting,northing\n")
    for wrong, said in (
        ({"visible": tmp_path / "no.ply"}, "no.ply does not exist"),
        ({"checkpoints": tmp_path / "no.csv"}, "no.csv does not exist"),
        ({"checkpoints": tmp_path / "points.csv"}, "points.csv"),
        ({"json_path": tmp_path / "no" / "n.json"}, "whose folder does not exist"),
        ({"outliers": "all"}, "--outliers"),
    ):
        with pytest.raises((GeoError, CompareError, OutputError), match=said):
            compare_files(cloud, plane, options=CompareOptions(**wrong))


@pytest.mark.parametrize("step", [0.1, 0.5, 1.5])
def test_over_a_reference_of_points_heights_do_not_depend_on_their_spacing(tmp_path, step):
    local = grid(0.2, 0.1, half=3.0)
    reference = write_las(tmp_path / "reference.las", FRAME.crs_from_local(grid(step)))
    numbers = compared(
        write_las(tmp_path / "c.las", FRAME.crs_from_local(local), depth=1.0), reference, tolerances_m=(0.2,)
    )
    assert (numbers["method"], numbers["sign"], numbers["seed"]) == ("cloud to local planes of a cloud", "up", None)
    assert numbers["n_points"] == len(local)
    assert (numbers["min_m"], numbers["max_m"]) == (
        pytest.approx(0.1, abs=2 * LAS_M),
        pytest.approx(0.1, abs=2 * LAS_M),
    )
    assert numbers["reference_surface"]["spacing_m"] == pytest.approx(step, rel=0.1)
    assert numbers["reference_surface"]["std_95_m"] < 2 * LAS_M
    assert numbers["iho_s44"]["orders"][0]["meets_tvu_at_all_depths"] is True
    assert any(f"about {step:.2g} m apart" in note or "m apart" in note for note in numbers["notes"])
    assert numbers["n_samples"] == len(grid(step))


def test_an_order_that_a_sparse_reference_cannot_tell_is_undecided(tmp_path):
    local = grid(0.1, half=3.0)
    local[:, 2] = 0.2 * np.sin(2.0 * np.pi * local[:, 0] / 1.6)
    reference = grid(0.8)
    reference[:, 2] = 0.2 * np.sin(2.0 * np.pi * (reference[:, 0] + 0.3) / 1.6)
    cloud = write_las(tmp_path / "c.las", FRAME.crs_from_local(local), depth=1.0 - local[:, 2])
    figures = compare_files(cloud, write_las(tmp_path / "r.las", FRAME.crs_from_local(reference)))
    exclusive = figures.uncertainty.iho.orders[0]
    assert exclusive.is_undecided
    assert exclusive.share_within < 0.95 <= exclusive.share_possible
    said = str(sections_of(figures))
    assert "undecided, by heights between the points of the reference" in said
    assert re.search(r"'points of the reference', '0\.[78]\d*\S*m apart, heights ± ", said)


def test_without_any_crs_coordinates_are_metres_and_the_notes_say_so(tmp_path, plane):
    points = FRAME.crs_from_local(grid(0.5, 0.1))
    write_ply(tmp_path / "cloud.ply", points, rgb=np.zeros(points.shape, np.uint8), scalars={})
    numbers = compared(tmp_path / "cloud.ply", plane)
    assert numbers["crs"] is None
    assert "neither cloud.ply nor reference.ply has a CRS" in numbers["notes"][0]
    # A level square of 10 m bends by (5 m)² / 2 R = 2 µm.
    assert numbers["mean_m"] == pytest.approx(0.1, abs=5e-6)


def test_geographic_coordinates_give_the_same_distances(tmp_path):
    frame = LocalFrame(CRS("EPSG:4979"), (10.2, 46.9, 400.0))
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [HALF, HALF, 1.0]
    plane = write_mesh(tmp_path / "m.ply", frame.crs_from_local(corners), [[0, 1, 2], [0, 2, 3]])
    cloud = write_las(tmp_path / "c.las", frame.crs_from_local(grid(0.1, -0.1)), CRS("EPSG:4979"))
    east, north = frame.crs_from_local(np.array([0.01, 0.0, 0.0]))[:2]
    numbers = compared(cloud, plane, tolerances_m=(0.3,), bounds=(east - 1, north - 1, east, north + 1))
    assert numbers["mean_m"] == pytest.approx(-0.1, abs=LAS_M / 10)
    # As in the grid: the tolerance in degrees is another one to the east than to the north.
    assert numbers["completeness"] == pytest.approx((5.0 + 0.3 + np.sqrt(0.08)) / 10.0, abs=SAMPLING)


def test_depths_in_the_cloud_split_the_numbers_by_the_true_depth(tmp_path, plane):
    """Water 0.08 m above the reference; a cloud 0.1 m too high calls itself dry and is counted as wet."""
    local = grid(0.5, 0.1)
    cloud = write_las(tmp_path / "c.las", FRAME.crs_from_local(local), depth=0.08 - local[:, 2])
    numbers = compared(cloud, plane)
    assert "dry" not in numbers
    assert numbers["wet"]["n_points"] == len(local)
    assert [band["to_m"] for band in numbers["depth_bands"]] == [0.5]


@pytest.mark.slow
def test_a_million_samples_of_the_reference_are_asked_for(monkeypatch, cloud, plane):
    monkeypatch.undo()
    assert compared(cloud, plane)["n_samples"] == 1_000_000


def test_the_same_files_give_the_same_numbers(tmp_path, cloud, plane):
    first, second = (compared(cloud, plane, tolerances_m=(0.11,)) for _ in range(2))
    assert first == second
    assert 0.0 < first["completeness"] < 1.0


def test_json_is_written_whole(tmp_path, cloud, plane):
    (tmp_path / "new").mkdir()
    path = tmp_path / "new" / "numbers.json"
    numbers = compared(cloud, plane, json_path=path, visible=plane)
    assert json.loads(path.read_text()) == numbers
    assert [p.name for p in path.parent.iterdir()] == ["numbers.json"]


def test_the_report_has_four_pictures(tmp_path, cloud, plane):
    folder = tmp_path / "report"
    compared(cloud, plane, report_dir=folder)
    assert sorted(p.stem for p in folder.iterdir()) == ["bands", "completeness", "histogram", "map"]
    for path in folder.iterdir():
        with Image.open(path) as image:
            assert min(image.size) > 400
            assert len(set(image.convert("L").resize((64, 64)).tobytes())) > 3


@pytest.mark.parametrize("count", [0, 1, 2])
def test_pictures_of_hardly_any_points_are_drawn_all_the_same(tmp_path, count):
    points = np.array([[589012.0, 5194736.0, 1.0], [589013.0, 5194736.0, 1.0]])[:count]
    error_map(points, np.full(count, 0.1), tmp_path / "map.png", crs=UTM32)
    histogram(np.full(count, np.nan), tmp_path / "histogram.png", tolerance_m=0.2)
    completeness_map(points, np.zeros(count, bool), tmp_path / "completeness.png")
    assert len(list(tmp_path.iterdir())) == 3


# What is refused ------------------------------------------------------------------------------------------


def las_of(local, crs=UTM32, name="other.las"):
    return lambda folder: write_las(folder / name, FRAME.crs_from_local(local), crs)


def mesh_of(local, faces, name="other.ply"):
    return lambda folder: write_mesh(folder / name, FRAME.crs_from_local(local), faces)


def far_points(folder):
    write_ply(folder / "visible.ply", np.zeros((3, 3)), rgb=np.zeros((3, 3), np.uint8), scalars={})
    return folder / "visible.ply"


def half_a_file(folder):
    path = write_las(folder / "cut.las", FRAME.crs_from_local(grid(1.0)))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


CORNERS = np.array([[-5.0, -5.0, 0.0], [5.0, -5.0, 0.0], [0.0, 5.0, 0.0]])


@pytest.mark.parametrize(
    ("which", "make", "error", "message"),
    [
        ("reference", las_of(grid(1.0), CRS("EPSG:25833+5778")), GeoError,
         r"cloud.las and .*other.las are in different .* 32N against .* 33N"),
        ("reference", las_of(grid(1.0), CRS("EPSG:25832+7837")), GeoError, "heights"),
        ("reference", mesh_of(grid(10.0) + np.array([5000.0, 0.0, 0.0]), [[0, 1, 2], [1, 3, 2]]), PlaceMismatch,
         r"easting 499995.* and .*other.ply .*easting 504991.* do not overlap"),
        ("visible", far_points, PlaceMismatch, "visible.ply"),
        ("reference", las_of(CORNERS), CompareError, "needs four of them around it"),
        ("reference", mesh_of(grid(10.0), [[0, 0, 3], [0, 3, 3]]), CompareError,
         "none of the 2 triangles of .*other.ply has an area"),
        ("cloud", las_of(np.empty((0, 3))), UnreadableFile, "other.las has no points"),
        ("cloud", half_a_file, GeoError, "cut.las"),
        ("bounds", lambda _: (0.0, 0.0, 1.0, 1.0), CompareError,
         r"none of the 10201 points of .*cloud.las lies within .* 0 0 1 1; it"),
    ],
)  # fmt: skip
def test_what_cannot_be_compared_is_refused_by_name(tmp_path, cloud, plane, which, make, error, message):
    given = {"cloud": cloud, "reference": plane, which: make(tmp_path)}
    with pytest.raises(error, match=message):
        compared(given.pop("cloud"), given.pop("reference"), **given)


def test_heights_of_another_datum_are_noted_and_absurd_ones_refused(tmp_path, plane):
    low = write_las(tmp_path / "low.las", FRAME.crs_from_local(grid(1.0)) - [0, 0, 47.0])
    numbers = compared(low, plane)
    assert numbers["mean_m"] == pytest.approx(-47.0, abs=0.01)
    assert any("do not meet: check that both count from the same vertical datum" in n for n in numbers["notes"])
    depths = write_las(tmp_path / "depths.las", FRAME.crs_from_local(grid(1.0)) * [1, 1, 0])
    with pytest.raises(CompareError, match=r"do not meet; check .* same vertical datum, and in the same unit"):
        compared(depths, plane)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bounds": (2.0, 0.0, 1.0, 1.0)}, "E0 below E1"),
        ({"bounds": (0.0, 0.0, float("nan"), 1.0)}, "four finite numbers"),
        ({"tolerances_m": (0.2, 0.0)}, r"--tolerance is \[0.2, 0.0\], expected metres above zero"),
        ({"tolerances_m": (float("nan"),)}, r"--tolerance is \[nan\]"),
        ({"sign": "down"}, "expected one of up, winding"),
        ({"tolerances_m": ()}, "--tolerance has no value"),
        ({"outliers": "sor:0,2"}, "expected sor:K,S"),
        ({"outliers": "iqr:6,2"}, "expected sor:K,S"),
        ({"outliers": "sor:6"}, "expected sor:K,S"),
        ({"m3c2_radius_m": 0.0}, "--m3c2 is 0, expected metres above zero"),
        ({"water_level": float("nan")}, "--water-level is nan"),
    ],
)
def test_options_without_meaning_are_refused_before_anything_is_read(tmp_path, options, message):
    with pytest.raises(SurveyError, match=message):
        compared(tmp_path / "none.las", tmp_path / "none.ply", **options)


@pytest.mark.parametrize("which", ["cloud", "reference", "visible"])
def test_a_path_that_does_not_exist_is_named(tmp_path, cloud, plane, which):
    paths = {"cloud": cloud, "reference": plane, "visible": plane} | {which: tmp_path / "nowhere.ply"}
    with pytest.raises(UnreadableFile, match=r"nowhere.ply does not exist"):
        compared(paths["cloud"], paths["reference"], visible=paths["visible"])


def test_a_place_for_results_that_cannot_be_is_refused_before_anything_is_computed(tmp_path, cloud, plane):
    before = cloud.read_bytes()
    for options, words in (
        ({"report_dir": cloud}, "which is a file; name another folder"),
        ({"json_path": cloud / "numbers.json"}, "whose folder is a file"),
        ({"json_path": tmp_path / "no" / "deep" / "numbers.json"}, "whose folder does not exist"),
        ({"json_path": cloud}, "would overwrite the input"),
        ({"json_path": plane}, "would overwrite the input"),
        ({"json_path": tmp_path / "visible.ply", "visible": tmp_path / "visible.ply"}, "would overwrite"),
        ({"json_path": tmp_path / "k.csv", "checkpoints": tmp_path / "k.csv"}, "would overwrite the input"),
    ):
        for name in ("visible", "checkpoints"):
            if name in options:
                options[name].touch()
        with pytest.raises(OutputError, match=words):
            compared(cloud, plane, **options)
    assert cloud.read_bytes() == before


def test_a_cloud_whose_crs_has_no_heights_is_compared_and_noted(tmp_path, plane):
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(ORIGIN)
    header.add_crs(CRS("EPSG:25832"))
    las = laspy.LasData(header)
    las.x, las.y, las.z = FRAME.crs_from_local(grid(0.5, 0.1)).T
    las.write(tmp_path / "flat.las")
    numbers = compared(tmp_path / "flat.las", plane)
    assert numbers["mean_m"] == pytest.approx(0.1, abs=LAS_M / 5)
    assert any("does not say what heights count from" in note for note in numbers["notes"])


def test_the_terminal_has_words_for_what_the_json_has_keys_for(cloud, plane):
    inputs, distances, *_ = sections_of(compare_files(cloud, plane))
    rows = dict(distances.blocks[0].rows)
    assert {"points compared", "median", "rms", "NMAD", "95 % of |distance|", "lowest", "highest"} <= rows.keys()
    assert dict(inputs.blocks[0].rows)["sign"] == "up"
