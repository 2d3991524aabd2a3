"""Points deleted and classified by hand: undone, kept beside the cloud, and followed by everything made of it."""

import laspy
import numpy as np
import pytest
import rasterio
from command_line import bathynerf
from small_survey import small_survey
from stored_run import plane_stored, run_of

import bathynerf as public
from geo.las import read_cloud
from survey.display.quantities import count
from survey.errors import SurveyError
from survey.export.export import cloud_of
from survey.folder.survey import load_survey
from survey.run.edits import DELETED, edits_of_others
from survey.run.flight import save_flight
from survey.run.folder import RunDir
from survey.run.products import write_bed_las


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    stored = plane_stored(tmp_path_factory.mktemp("plane") / "s")
    return stored[np.abs(stored.bed.xyz[:, :2]).max(axis=1) < 2.0]


@pytest.fixture
def run(stored, tmp_path):
    path = run_of(stored, tmp_path / "run")
    write_bed_las(path / "cloud.las", stored)
    save_flight(path, load_survey(small_survey(tmp_path / "s")))
    return path


def square(stored, half_m=0.5):
    """Corners, in crs, of a square about the middle of the cloud, and a mask of the points in it."""
    low, high = stored.points_crs[:, :2].min(axis=0), stored.points_crs[:, :2].max(axis=0)
    middle = 0.5 * (low + high)
    corners = middle + half_m * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return corners, (np.abs(stored.points_crs[:, :2] - middle) < half_m).all(axis=1)


def test_points_in_a_polygon_are_found_deleted_and_brought_back(run, stored):
    corners, is_inside = square(stored)
    before = (run / "cloud.las").read_bytes()
    edits = public.edit(run)
    rows = edits.inside(corners)
    assert rows.tolist() == np.flatnonzero(is_inside).tolist()
    edits.delete(rows)
    assert len(edits.inside(corners)) == 0
    edits.classify(~is_inside, 7)
    again = public.edit(run)
    np.testing.assert_array_equal(again.classes, np.where(is_inside, DELETED, 7))
    np.testing.assert_array_equal(again.undo(), np.flatnonzero(~is_inside))
    np.testing.assert_array_equal(again.undo(), rows)
    assert len(again.undo()) == 0
    np.testing.assert_array_equal(public.edit(run).classes, np.where(stored.bed.wet, 40, 2))
    assert list((run / "edits").iterdir()) == []
    assert (run / "cloud.las").read_bytes() == before


def test_a_deleted_point_gets_no_class_and_a_step_that_changes_nothing_is_none(run):
    edits = public.edit(run)
    edits.delete(np.array([1, 2]))
    edits.classify(np.array([1, 2, 3]), 41)
    assert edits.classes[:4].tolist() == [edits.classes[0], DELETED, DELETED, 41]
    edits.classify(np.array([3]), 41)
    edits.undo()
    assert edits.classes[3] == edits.classes[0]
    assert str(edits) == f"2 deleted of {count(len(edits.classes))} points"


def test_an_exported_cloud_has_the_edits_and_keeps_all_dimensions(run, stored, tmp_path):
    corners, is_inside = square(stored)
    edits = public.edit(run)
    edits.delete(edits.inside(corners))
    noise = np.flatnonzero(~is_inside)[:5]
    edits.classify(noise, 7)
    assert bathynerf("export", run, "--las", tmp_path / "a.las", "--as-computed").exit_code == 0
    assert bathynerf("export", run, "--las", tmp_path / "b.las", "--ply", tmp_path / "b.ply").exit_code == 0
    plain, edited = laspy.read(tmp_path / "a.las"), laspy.read(tmp_path / "b.las")
    assert list(edited.point_format.dimension_names) == list(plain.point_format.dimension_names)
    assert edited.header.parse_crs() == plain.header.parse_crs()
    for name in ("X", "Y", "Z", "red", "std", "depth", "num_views", "user_data"):
        # Offsets of LAS follow the extent, which has not changed.
        np.testing.assert_array_equal(edited[name], plain[name][~is_inside])
    expected = np.where(stored.bed.wet, 40, 2)
    expected[noise] = 7
    np.testing.assert_array_equal(edited.classification, expected[~is_inside])
    # A format without classes has the bed alone.
    ply = public.read_reference(tmp_path / "b.ply")
    assert len(ply.points) == np.count_nonzero(~is_inside) - 5


def test_a_raster_has_no_height_where_the_points_are_deleted_or_not_of_the_bed(run, stored, tmp_path):
    corners, is_inside = square(stored, 0.9)
    known = []
    edits = public.edit(run)
    for change in (lambda: None, lambda: edits.delete(edits.inside(corners)), lambda: edits.classify(is_inside, 41)):
        change()
        said = bathynerf("export", run, "--dem", tmp_path / "d.tif", "--resolution", 0.2)
        assert said.exit_code == 0, said.output
        with rasterio.open(tmp_path / "d.tif") as raster:
            known.append(raster.read(1, masked=True).count())
        if known[1:]:
            edits.undo()
    # 1.8 m in cells of 0.2 m, of which those on the edge keep points.
    assert 49 <= known[0] - known[1] <= 81
    assert known[1] == known[2]


def test_what_is_made_of_the_cloud_file_has_the_edits(run, stored):
    corners, is_inside = square(stored)
    assert cloud_of(run) == run / "cloud.las"
    edits = public.edit(run)
    edits.delete(edits.inside(corners))
    assert cloud_of(run) == run / "edits" / "cloud.las"
    assert cloud_of(run / "cloud.las") == run / "cloud.las"
    handle = public.Run.open(run)
    assert len(handle.cloud.points) == np.count_nonzero(~is_inside)
    middle = corners.mean(axis=0)
    profile = handle.profile(middle + np.array([[-1.5, 0.0], [1.5, 0.0]]), step_m=0.05)
    assert (profile.num_points[np.abs(profile.distance - 1.5) < 0.3] == 0).all()
    assert (profile.num_points[np.abs(profile.distance - 1.5) > 0.7] > 0).all()


def test_edits_stay_with_their_cloud_and_are_said_to_be_of_another(run, stored, tmp_path):
    public.edit(run).delete(np.array([0]))
    assert edits_of_others(RunDir(run)) is None
    run_of(stored[1:], run, quality="other")
    assert "are kept in edits/bed-" in edits_of_others(RunDir(run))
    assert DELETED not in public.edit(run).classes
    run_of(stored, run)
    assert edits_of_others(RunDir(run)) is None
    assert public.edit(run).classes[0] == DELETED


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda edits: edits.classify(np.array([0]), 9), r"40 \(bathymetric point\)"),
        (lambda edits: edits.delete(np.array([10**9])), "expected 0 to"),
        (lambda edits: edits.delete(np.array([-1])), "expected 0 to"),
        (lambda edits: edits.inside([[0.0, 1.0], [1.0, 0.0]]), "three corners or more"),
        (lambda edits: edits.inside([[0.0, 1.0], [1.0, 0.0], [np.nan, 0.0]]), "three corners or more"),
    ],
)
def test_an_edit_that_cannot_be_is_refused(run, change, words):
    edits = public.edit(run)
    with pytest.raises(SurveyError, match=words):
        change(edits)
    assert not edits.path.exists()


def test_edits_by_two_at_once_do_not_get_lost(run):
    first, second = public.edit(run), public.edit(run)
    first.delete(np.array([3]))
    with pytest.raises(SurveyError, match="changed by somebody else"):
        second.delete(np.array([4]))
    assert np.flatnonzero(public.edit(run).classes == DELETED).tolist() == [3]


def test_a_damaged_file_of_edits_is_refused(run):
    edits = public.edit(run)
    edits.delete(np.array([3]))
    np.savez(edits.path, rows=np.array([10**9]), counts=np.array([1]), kinds=np.array([0], np.uint8))
    with pytest.raises(SurveyError, match="holds no edits of this cloud"):
        public.edit(run)
    edits.path.write_bytes(b"PK")
    with pytest.raises(SurveyError, match="cannot be read"):
        public.edit(run)


def test_a_folder_that_is_no_run_has_no_edits(tmp_path):
    with pytest.raises(SurveyError, match="is no run folder"):
        public.edit(tmp_path)


def test_compare_takes_a_run_with_its_edits(run, stored, tmp_path):
    edits = public.edit(run)
    edits.classify(np.arange(3), 7)
    said = bathynerf("compare", run, run / "cloud.las")
    assert said.exit_code == 0, said.output
    assert "3 of class 7" in " ".join(said.output.split())
    assert len(read_cloud(run / "edits" / "cloud.las").points) == len(stored.bed)
