"""A small survey in tiles: the same bed as in one piece, nothing twice, and a run that goes on."""

import json

import numpy as np
import pytest
from drawn_runs import GSD, drawn, inner90
from scipy.spatial import cKDTree

from evaluation import distance_to_mesh
from geo import read_cloud
from survey.progress import Progress
from survey.run.folder import RunDir
from survey.run.process import process

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", params=["off", "solver"])
def runs(request, tmp_path_factory):
    """The survey, the run in one piece, that in two tiles, and the lines of its log."""
    folder = tmp_path_factory.mktemp("tiled")
    survey = drawn(folder / "survey", num_views=12)
    made = []
    for tiles in (1, 2):
        with Progress(verbosity=-1):
            assert process(survey.folder, folder / f"run{tiles}", field=request.param, tiles=tiles) == 0
        made.append(RunDir(folder / f"run{tiles}"))
    return survey, *made


def errors(survey, run) -> np.ndarray:
    """Signed distances [m] of the points of a run within the bounds."""
    frame, points = survey.survey.frame, read_cloud(run.cloud_path).points
    e0, n0, e1, n1 = survey.survey.bounds
    points = points[(points[:, 0] >= e0) & (points[:, 0] <= e1) & (points[:, 1] >= n0) & (points[:, 1] <= n1)]
    reference = survey.reference
    return distance_to_mesh(
        frame.local_from_crs(points), frame.local_from_crs(reference.vertices), reference.faces
    ).signed


def test_the_bed_is_as_good_as_in_one_piece(runs):
    survey, one, two = runs
    of_one, of_two = errors(survey, one), errors(survey, two)
    assert len(of_two) == pytest.approx(len(of_one), rel=3e-3)
    (mean, std), (mean_in_tiles, std_in_tiles) = inner90(of_one), inner90(of_two)
    assert mean_in_tiles == pytest.approx(mean, abs=0.3e-3)
    assert std_in_tiles == pytest.approx(std, rel=0.05)


def test_no_point_is_there_twice(runs):
    points = read_cloud(runs[2].cloud_path).points
    apart = cKDTree(points).query(points, k=2)[0][:, 1]
    # Two views may put a point each on either side of the line.
    assert (apart < 0.2 * GSD).mean() < 5e-4


def test_the_run_says_its_tiles_and_leaves_what_exports_read(runs):
    _, one, two = runs
    said = {each["name"]: each for each in json.loads(two.plan_path.read_text())["decisions"]}
    assert (said["tiles"]["choice"], said["tiles"]["reason"][:15]) == ("2", "set by --tiles,")
    names = set(two.result()["stages"])
    assert {"range", "sweep_tile1", "sweep_tile2", "sweep", "points_tile2", "bed"} <= names
    assert set(one.result()["stages"]) - {"points"} <= names
    assert not list(two.path.glob(".*.part"))


def test_a_run_that_was_stopped_goes_on_at_its_tile(runs, tmp_path):
    import shutil

    survey, _, two = runs
    folder = tmp_path / "again"
    shutil.copytree(two.path, folder)
    run = RunDir(folder)
    before = run.cloud_path.read_bytes()
    for name in ("bed", "points_tile2", "sweep"):
        shutil.rmtree(run.load_stage(name))
    kept = {path.name: path.stat().st_mtime_ns for path in run.stages_path.iterdir()}
    field = "solver" if "solver" in two.result()["stages"] else "off"
    with Progress(verbosity=-1):
        assert process(survey.folder, folder, field=field, tiles=2) == 0
    assert run.cloud_path.read_bytes() == before
    assert {path.name: path.stat().st_mtime_ns for path in run.stages_path.iterdir()}.items() >= kept.items()
