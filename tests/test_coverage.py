"""Standard deviations are true: on a drawn survey, processed from its photographs, they cover its errors."""

import numpy as np
import pytest
from drawn_runs import drawn
from slow_cases import slow
from std_coverage import WALL_DEG, coverage_by_class, slope_below

from evaluation import vertical_difference
from geo import read_cloud
from survey.progress import Progress
from survey.run.process import process


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("coverage")


@pytest.fixture(scope="module", params=[slow("off"), slow("solver")])
def covered(request, folder):
    """A noisy survey with a bank, by the sweep alone and solved: coverage by class, and the std of all points."""
    run = drawn(folder, noise=4.0, shore=True, seed=7)
    with Progress(verbosity=-1):
        assert process(run.folder, field=request.param, poses="fixed") == 0
    cloud, frame = read_cloud(run.run.cloud_path), run.survey.frame
    points, vertices = frame.local_from_crs(cloud.points), frame.local_from_crs(run.reference.vertices)
    error = vertical_difference(points, vertices, run.reference.faces)
    slope = slope_below(points, vertices, run.reference.faces)
    known = np.isfinite(error) & (slope < WALL_DEG)
    std, views = cloud.extra["std"], cloud.extra["num_views"]
    wet = cloud.classification == 40
    return coverage_by_class(error[known], std[known], views[known], slope[known], wet[known]), cloud.extra


def test_two_standard_deviations_cover_the_errors_and_not_much_more(covered):
    """Half as large they would cover two thirds, twice as large all of them; docs/field.md has larger surveys."""
    shares, _ = covered
    assert 0.93 < shares["all"].share < 0.99


def test_every_class_is_covered(covered):
    shares, _ = covered
    large = {name: found.share for name, found in shares.items() if found.num > 1000}
    assert {"fifth 1", "fifth 5", "wet", "dry", "8 views and more"} <= set(large)
    assert all(share > 0.88 for share in large.values()), large
    assert all(large[f"fifth {number}"] < 0.998 for number in range(1, 6)), large


def test_no_point_is_exact(covered):
    _, extra = covered
    assert (extra["std"] > 0.0).all()
    assert (extra["std_common"] > 0.0).all()


def test_shares_are_those_of_the_errors_within():
    error, std = np.array([0.1, -0.3, 0.1, 0.5]), np.array([0.1, 0.1, 0.2, 0.3])
    found = coverage_by_class(error, std, np.array([2, 4, 6, 9]), np.array([0, 30, 0, 30.0]), std > 0.15)
    assert found["all"].share == 0.75
    assert found["slopes"].num == 2
    assert found["3 to 4 views"].share == 0.0
    assert found["dry"].num == 2


def test_the_slope_is_that_of_the_mesh_below():
    vertices = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 2.0], [0.0, 2.0, 0.0], [2.0, 2.0, 2.0]])
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    np.testing.assert_allclose(slope_below(np.array([[0.5, 0.7, 3.0]]), vertices, faces), 45.0)
