"""What of a cloud is drawn, and which point a click means: the octree, its selection and the ray through it."""

import math

import numpy as np
import pytest

from refract import PinholeCamera
from survey.viewer.tree import (
    CloudTree,
    build_tree,
    camera_of_screen,
    pick,
    point_sizes,
    seen_nodes,
    select_nodes,
    spacing_px,
)

# Straight down: x to the east, y of the image to the south.
DOWN = np.diag([1.0, -1.0, -1.0])
SPACING_M = 0.05


@pytest.fixture(scope="module")
def tree() -> CloudTree:
    """A gentle bed of 160,000 points over 20 by 20 m."""
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(400) * SPACING_M, np.arange(400) * SPACING_M)
    plan = np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-0.01, 0.01, (160_000, 2))
    return build_tree(np.column_stack([plan, 0.3 * np.sin(plan[:, 0])]))


def above(east: float, north: float, height: float, *, height_px: float = 800.0) -> PinholeCamera:
    return camera_of_screen(np.array([east, north, height]), DOWN, math.radians(60.0), 1.5, height_px)


def test_each_point_is_in_one_node_and_within_its_cube(tree):
    assert sorted(tree.order.tolist()) == list(range(len(tree.points)))
    assert len(tree) > 20
    for node in range(len(tree)):
        points = tree.points[tree.rows(node)]
        # A step of the octree is the extent by 2**30.
        assert (points >= tree.low[node] - 1e-6).all()
        assert (points <= tree.low[node] + tree.side[node] + 1e-6).all()


def test_a_node_lies_in_its_parent_which_comes_first(tree):
    assert tree.parent[0] == -1
    children = np.arange(1, len(tree))
    parents = tree.parent[1:]
    assert (parents < children).all()
    assert (parents >= 0).all()
    np.testing.assert_allclose(tree.side[children], 0.5 * tree.side[parents])
    assert (tree.low[children] >= tree.low[parents] - 1e-9).all()
    assert (tree.low[children] <= tree.low[parents] + 0.5 * tree.side[parents, None] + 1e-9).all()


def test_points_in_one_place_are_a_tree_too():
    tree = build_tree(np.full((5, 3), 2.0))
    assert len(tree) == 1
    assert sorted(tree.rows(0).tolist()) == [0, 1, 2, 3, 4]


def in_frame(view: PinholeCamera, points: np.ndarray) -> np.ndarray:
    pixels = view.project(points, None)
    return ((points - view.centre) @ view.cam_from_local[2] > 0.0) & view.sees(pixels)


@pytest.mark.parametrize("view", [above(10.0, 10.0, 30.0), above(3.0, 4.0, 2.0), above(40.0, 10.0, 3.0)])
def test_nodes_that_are_cut_off_have_no_point_in_the_frame(tree, view):
    seen = seen_nodes(tree, view)
    for node in np.flatnonzero(~seen):
        assert not in_frame(view, tree.points[tree.rows(node)]).any()
    # Looking past the bed, nothing is left.
    assert seen.any() == (view.centre[0] < 20.0)


@pytest.mark.parametrize("most", [20_000, 60_000, 10**9])
def test_selected_nodes_keep_within_the_limit_and_have_all_their_parents(tree, most):
    view = above(10.0, 10.0, 4.0)
    nodes = select_nodes(tree, view, most)
    assert tree.counts[nodes].sum() <= most
    chosen = set(nodes.tolist())
    assert 0 in chosen
    assert all(tree.parent[node] in chosen for node in chosen - {0})


def test_the_screen_decides_how_fine_the_bed_is_drawn(tree):
    near, far = select_nodes(tree, above(10.0, 10.0, 2.0)), select_nodes(tree, above(10.0, 10.0, 200.0))
    assert tree.side[near].min() < tree.side[far].min()
    # No node is drawn whose parent is fine enough, and none that is seen is missing where it is not.
    view = above(10.0, 10.0, 20.0)
    nodes = set(select_nodes(tree, view).tolist())
    coarse = spacing_px(tree, view)
    for node in range(1, len(tree)):
        assert (node in nodes) == bool(seen_nodes(tree, view)[node] and coarse[tree.parent[node]] > 1.0)


def test_points_are_as_large_as_the_gaps_that_finer_nodes_leave(tree):
    view = above(10.0, 10.0, 5.0)
    everything = np.arange(len(tree))
    np.testing.assert_allclose(point_sizes(tree, everything, view, SPACING_M), SPACING_M)
    alone = point_sizes(tree, np.array([0]), view, SPACING_M)
    assert alone[0] == pytest.approx(tree.spacing[0])


def test_a_ray_meets_the_point_that_a_search_through_all_finds(tree, rng):
    for _ in range(20):
        target = tree.points[rng.integers(len(tree.points))]
        origin = target + rng.uniform([-8.0, -8.0, 5.0], [8.0, 8.0, 15.0])
        row = pick(tree, origin, target - origin, angle=1e-3, least_m=0.5 * SPACING_M)
        along = (target - origin) / np.linalg.norm(target - origin)
        away = tree.points - origin
        t = away @ along
        off = np.linalg.norm(away - t[:, None] * along, axis=1)
        hit = off <= 0.5 * SPACING_M + 1e-3 * t
        near = hit & (t <= t[hit].min() + 2.0 * (0.5 * SPACING_M + 1e-3 * t[hit].min()))
        assert row == np.flatnonzero(near)[np.argmin(off[near])]


def test_a_ray_past_the_cloud_meets_nothing(tree):
    up = np.array([0.0, 0.0, 1.0])
    assert pick(tree, np.array([10.0, 10.0, 5.0]), up, angle=1e-3, least_m=0.05) is None
    assert pick(tree, np.array([-50.0, 10.0, 5.0]), -up, angle=1e-3, least_m=0.05) is None


def test_what_stands_before_the_bed_is_met_first():
    bed = np.column_stack([np.linspace(-1.0, 1.0, 201), np.zeros(201), np.zeros(201)])
    mast = np.column_stack([np.full(50, 0.3), np.zeros(50), np.linspace(0.5, 1.0, 50)])
    tree = build_tree(np.concatenate([bed, mast]))
    row = pick(tree, np.array([0.3, 0.0, 9.0]), np.array([0.0, 0.0, -2.0]), angle=0.0, least_m=0.01)
    assert row >= len(bed)
