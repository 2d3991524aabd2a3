"""Parts of a block that share no points: which views are of which, and how well one is known against another."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from survey.adjust.result.adjustment import Adjustment, Residuals
from survey.adjust.result.parts import parts_of_adjustment, parts_warning
from survey.display.quantities import length
from survey.photos.poses import connected_parts
from tests.block_survey import drawn_adjustment


@given(st.lists(st.integers(-1, 4), min_size=1, max_size=30), st.integers(0, 2**32 - 1))
def test_views_are_of_one_part_where_points_lead_from_one_to_the_other(groups, seed):
    rng = np.random.default_rng(seed)
    point, view, num_points = [], [], 0
    for group in range(5):
        mine = rng.permutation([number for number, each in enumerate(groups) if each == group])
        # A chain holds a group together.
        for pair in zip(mine, mine[1:] if len(mine) > 1 else mine, strict=False):
            view += pair
            point += [num_points] * 2
            num_points += 1
    part = connected_parts(len(groups), np.array(point, dtype=np.int64), np.array(view, dtype=np.int64))
    sizes = [int((part == number).sum()) for number in range(int(part.max()) + 1)]
    assert sizes == sorted(sizes, reverse=True)
    for a, of_a in enumerate(groups):
        assert (part[a] == -1) == (of_a == -1)
        for b, of_b in enumerate(groups):
            assert (part[a] == part[b]) == (of_a == of_b)


def cut(found: Adjustment) -> tuple[Adjustment, np.ndarray]:
    """A block whose photographs west and east of its middle see their own side alone; which are east (V,) bool."""
    middle = np.median(found.poses.centres[:, 0])
    east = found.poses.centres[:, 0] > middle
    is_tie = found.residuals.point < len(found.points) - len(found.control)
    keep = is_tie & ((found.points[found.residuals.point, 0] > middle) == east[found.residuals.view])
    keep &= (np.bincount(found.residuals.point[keep], minlength=len(found.points)) >= 3)[found.residuals.point]
    kept, point = np.unique(found.residuals.point[keep], return_inverse=True)
    left = found.residuals
    residuals = Residuals(left.view[keep], left.px[keep], left.at_px[keep], point)
    return replace(found, points=found.points[kept], residuals=residuals, control=()), east


def test_a_whole_block_has_no_parts():
    block, found = drawn_adjustment(num_views=20, dry_share=0.3, nadir_only=True)
    assert parts_of_adjustment(found, block.plane) == ()
    assert parts_warning(found, block.plane) == []


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_a_part_that_rises_is_so_much_less_known_against_the_other(seed):
    block, found = drawn_adjustment(seed, num_views=24, dry_share=1.0, nadir_only=True, num_points=1500)
    found, east = cut(found)
    # Nothing is uncertain but the height of all cameras in the east.
    rise = np.zeros(len(found.covariance.matrix))
    first = len(rise) - 6 * len(east)
    rise[first + 2 :: 6] = 0.05 * east
    found = replace(found, covariance=replace(found.covariance, matrix=np.outer(rise, rise)))
    parts = parts_of_adjustment(found, block.plane)
    assert len(parts) == 2
    assert sorted(name for part in parts for name in part.names) == sorted(found.poses.names)
    is_east = [set(part.names) <= {n for n, e in zip(found.poses.names, east, strict=True) if e} for part in parts]
    assert sorted(is_east) == [False, True]
    for part, moves in zip(parts, is_east, strict=True):
        # Along rays that lean by a few degrees, a place rises as its cameras do.
        assert part.height_std_m == pytest.approx(0.05 * moves, abs=1e-3)
    assert parts[0].to_first_std_m is None
    assert parts[1].to_first_std_m == pytest.approx(0.05, abs=1e-3)
    (warning,) = parts_warning(found, block.plane)
    assert f"fall into 2 parts without common points, of {len(parts[0].names)} (" in warning
    assert f"to {length(parts[1].to_first_std_m)} (1 sigma)" in warning


def test_neighbours_are_named_as_runs():
    block, found = drawn_adjustment(num_views=16, dry_share=1.0, nadir_only=True, num_points=1500)
    found, _ = cut(found)
    for part in parts_of_adjustment(found, block.plane):
        runs = [run.split(" to ") for run in part.listed.split(", ")]
        numbers = [n for run in runs for n in range(int(run[0][:4]), int(run[-1][:4]) + 1)]
        assert [f"{n:04d}.jpg" for n in numbers] == list(part.names)
