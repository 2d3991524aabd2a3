"""Distances against those of CloudCompare itself, where it is installed; no part of it is used otherwise."""

import bench_compare as bench
import numpy as np
import pytest

from evaluation import distance_to_mesh
from geo import read_reference

# Both compute the same in float64 from coordinates in float32; CloudCompare writes its distances in float32.
AGREES_M = 1e-5


@pytest.mark.slow
def test_distances_are_those_of_cloudcompare_and_so_are_their_signs_but_for_ties(tmp_path):
    program = bench.cloudcompare()
    if program is None:
        pytest.skip("CloudCompare is not installed (Debian: apt-get install cloudcompare)")
    cloud, mesh = bench.draw(tmp_path, 200_000, 40_000)
    theirs, _ = bench.run_cloudcompare(program, tmp_path, cloud, mesh)
    points, reference = read_reference(cloud).points, read_reference(mesh)
    ours = distance_to_mesh(points, reference.vertices, reference.faces, sign="winding").signed
    np.testing.assert_allclose(np.abs(ours), np.abs(theirs), atol=AGREES_M)
    other = np.flatnonzero(np.sign(ours) * np.sign(theirs) < 0)
    assert len(other) < 20
    assert bench.num_tied(points[other], np.abs(ours[other]), mesh) == len(other)
