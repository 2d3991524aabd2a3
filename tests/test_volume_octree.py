"""The octree of fields: nodes, lookups and consistency against loops, growth, learning, storage."""

import math

import numpy as np
import pytest
import torch
from volume_models import check_interface, check_learning, positions, store_and_load
from volume_scenes import BOX

from fields.volume.octree import OctreeSettings, OctreeVolume
from fields.volume.paths import Box

SMALL = OctreeSettings(cells=4, features=4, hidden=8)
# Nodes of 4 x 4 cells and one or two layers.
FLAT = [Box(BOX.low, BOX.low + BOX.edge * np.array([1.0, 1.0, height])) for height in (0.2, 0.5)]


def grown(box: Box = BOX, depth: int = 3) -> OctreeVolume:
    """The root, its eight children, and the children of the first two."""
    torch.manual_seed(0)
    model = OctreeVolume(box, OctreeSettings(cells=4, depth=depth, features=4, hidden=8), appearance=3)
    model.split(torch.tensor([0]))
    model.split(torch.tensor([1, 2]))
    torch.nn.init.normal_(model.table)
    return model


def slow_node(model: OctreeVolume, u: np.ndarray, footprint: float) -> int:
    node, low, edge = 0, np.zeros(3), 1.0
    for level in range(model.settings.depth - 1):
        if BOX.edge / (model.settings.cells * 2**level) <= footprint:
            break
        edge /= 2.0
        side = (u >= low + edge).astype(int)
        below = int(model.child[node, side[0] + 2 * side[1] + 4 * side[2]])
        if below < 0:
            break
        node, low = below, low + edge * side
    return node


@pytest.mark.parametrize("footprint", [0.0, 0.3, 0.6])
def test_a_sample_goes_down_to_the_node_whose_cells_are_as_small_as_its_footprint(footprint):
    model = grown()
    u = torch.rand(200, 3)
    found = model.node_of(u, footprint)
    assert found.tolist() == [slow_node(model, v.numpy(), footprint) for v in u]
    # Cells of the root are 0.5 m, of its children 0.25 m.
    assert int(model.level[found].max()) == {0.0: 2, 0.3: 1, 0.6: 0}[footprint]


def test_features_are_linear_between_the_corners_of_a_node_s_cells():
    model = grown().double()
    u = torch.rand(50, 3, dtype=torch.float64)
    node = model.node_of(u, 0.0)
    found = model.features(u, node).detach().numpy()
    nx, ny, _ = model.counts
    for k in range(50):
        edge = 0.5 ** int(model.level[node[k]])
        x = (u[k].numpy() - model.low[node[k]].numpy()) / edge * np.array(model.counts)
        corner = np.minimum(x.astype(int), np.array(model.counts) - 1)
        expected = np.zeros(4)
        for dx, dy, dz in np.ndindex(2, 2, 2):
            i, j, m = corner[0] + dx, corner[1] + dy, corner[2] + dz
            weight = np.prod([s if d else 1.0 - s for s, d in zip(x - corner, (dx, dy, dz), strict=True)])
            expected += weight * model.table[node[k], i + (nx + 1) * (j + (ny + 1) * m)].detach().numpy()
        np.testing.assert_allclose(found[k], expected, rtol=1e-9, atol=1e-12)


def test_growing_changes_nothing_until_the_children_learn():
    torch.manual_seed(0)
    model = OctreeVolume(BOX, SMALL)
    torch.nn.init.normal_(model.table)
    x = positions(300)
    before = model.evaluate(x)
    for nodes in ([0], [1, 5, 8]):
        model.split(torch.tensor(nodes))
        for found, expected in zip(model.evaluate(x), before, strict=True):
            torch.testing.assert_close(found, expected, rtol=2e-5, atol=2e-6)  # float32, two interpolations
    assert len(model.child) == 1 + 8 + 24 == len(model.table)
    assert set(model.leaves().tolist()) == {2, 3, 4, 6, 7}
    torch.nn.init.constant_(model.table, 0.3)
    assert number(model.inconsistency(torch.tensor([0]), torch.tensor([1]))) < 1e-12


def number(value: torch.Tensor) -> float:
    return value.detach().item()


@pytest.mark.parametrize("box", [BOX, *FLAT])
def test_consistency_is_the_difference_of_what_a_parent_lets_pass_and_the_mean_about_it_in_its_child(box):
    model = grown(box).double()
    torch.manual_seed(0)
    drawn = torch.rand(1, 32, 3)
    torch.manual_seed(0)
    found = number(model.inconsistency(torch.tensor([1]), torch.tensor([int(model.child[1, 3])])))
    child, total = int(model.child[1, 3]), 0.0
    finest = 4 * 4

    def kept(u: np.ndarray, node: int) -> float:
        f = model.features(torch.from_numpy(u)[None], torch.tensor([node])).detach().numpy()[0]
        raw = float(model.density.weight.detach().numpy()[0] @ f) + math.log(math.expm1(1.0 / finest))
        return math.exp(-math.log1p(math.exp(raw)) * finest / box.edge * box.edge / 4 / 2)

    cell, inner = 1.0 / np.array(model.counts), np.array(model.counts) >= 3
    margin, axes = np.where(inner, cell, 0.0), np.flatnonzero(inner)
    for share in drawn[0].numpy().astype(float):
        at = model.low[child].numpy() + 0.25 * (margin + (1.0 - 2.0 * margin) * share)
        places = [at, *(at + side * 0.25 * cell[k] * np.eye(3)[k] for side in (1, -1) for k in axes)]
        total += (np.mean([kept(p, child) for p in places]) - kept(at, 1)) ** 2
    assert found == pytest.approx(total / 32, rel=1e-5)


def test_the_score_of_a_flat_node_is_the_change_of_opacity_from_face_to_face():
    model = OctreeVolume(FLAT[0], SMALL)
    torch.nn.init.zeros_(model.table)
    model.table.data[0, model._rows // 2 :] = 0.5  # the upper of the two layers of nodes
    model._look()
    density = model._density(model.features(torch.tensor([[0.5, 0.5, 0.0], [0.5, 0.5, 1.0]]), torch.zeros(2).long()))
    a = -torch.expm1(-density * FLAT[0].edge / 4)
    assert number(model.score[0]) == pytest.approx(0.2 * number(a[1] - a[0]), rel=1e-4)


def test_leaves_with_more_detail_than_the_mean_are_split_when_it_is_time():
    torch.manual_seed(0)
    model = OctreeVolume(BOX, OctreeSettings(cells=4, features=4, hidden=8, steps=10, refined_at=(0.2, 0.6)))
    torch.nn.init.zeros_(model.table)
    model.split(torch.tensor([0]))
    model.table.data[3].uniform_(-4.0, 4.0)  # detail in one of the eight
    changed = [model.observe([0.1] * step) for step in range(1, 11)]
    # At the second time all that is left is even.
    assert changed == [step == 2 for step in range(1, 11)]
    assert (model.child[3] >= 0).all()
    assert (model.child[[1, 2, 4, 5, 6, 7, 8]] < 0).all()


def test_it_does_what_every_model_does():
    check_interface(lambda appearance: OctreeVolume(BOX, SMALL, appearance=appearance))


def test_a_grown_tree_comes_back_bit_for_bit():
    model, other = grown(), OctreeVolume(BOX, SMALL, appearance=3)
    store_and_load(model, other)
    x = positions(40)
    assert all(torch.equal(a, b) for a, b in zip(other.evaluate(x), model.evaluate(x), strict=True))


def test_it_learns_a_bed_and_grows():
    def make(appearance: int) -> OctreeVolume:
        settings = OctreeSettings(cells=8, depth=2, features=4, hidden=32, steps=80, refined_at=(0.3,), degree=0)
        return OctreeVolume(BOX, settings, appearance=appearance)

    renderer = check_learning(make, steps=80, share=0.6)
    assert len(renderer.model.child) == 9
