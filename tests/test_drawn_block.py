"""The random blocks that adjustments are tested on: what they state is consistent with what is true."""

import numpy as np
import pytest

from refract.lens import undistorted
from tests.drawn_block import draw_block


@pytest.mark.parametrize("seed", range(4))
def test_rays_of_the_observations_pass_their_points_within_the_noise(seed):
    block = draw_block(seed, pixel_std=0.2)
    water, miss = block.plane, []
    for view, camera in enumerate(block.cameras):
        of_view = block.view == view
        plane = undistorted(block.lens, block.pixel[of_view])
        pixel = plane * block.lens.focal + (block.lens["cx"], block.lens["cy"])
        miss.append(pixel - camera.project(block.points[block.point[of_view]], water))
    miss = np.concatenate(miss)
    # Distortion stretches a pixel by a few per cent; thousands of numbers know their spread to two.
    assert np.std(miss) == pytest.approx(0.2, rel=0.1)
    assert np.abs(np.mean(miss)) < 0.01


def test_a_seed_draws_one_block_whose_points_are_seen_three_times():
    first, again, other = draw_block(5), draw_block(5), draw_block(6)
    np.testing.assert_array_equal(first.pixel, again.pixel)
    assert first.lens != other.lens
    for block in (first, other):
        assert np.bincount(block.point, minlength=len(block.points)).min() >= 3
        assert (np.diff(block.point) >= 0).all()
        assert len(block.start) == len(block.points)


@pytest.mark.parametrize(("dry_share", "number"), [(0.4, 6), (0.0, 0)])
def test_control_points_are_dry_and_known_to_a_centimetre(dry_share, number):
    block = draw_block(3, dry_share=dry_share, num_control=6)
    true = block.points[block.control]
    assert len(true) == number
    assert (true[:, 2] > block.plane.height(*true.T[:2])).all()
    assert (np.abs(block.control_points - true) < 0.05).all()
    assert (block.points[:, 2] < block.plane.height(*block.points.T[:2])).all() == (dry_share == 0.0)
