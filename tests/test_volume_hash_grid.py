"""The hash grid: rows and features against a slow reference, gradients, collisions, and learning."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from volume_models import check_interface, check_learning, positions
from volume_scenes import BOX

from fields.factors import geometric_scales
from fields.volume.nerfacto import HashGrid, HashSettings, HashVolume
from fields.volume.paths import Box

SMALL = HashSettings(levels=5, log2_table=10, n_min=6, n_max=48, hidden=16, geometry=7)
CUBE = Box(np.zeros(3), np.full(3, 2.0))


def grid(box: Box = BOX, *, seed: int = 0, **changes) -> HashGrid:
    """A small grid, its table of order 1, in float64."""
    torch.manual_seed(seed)
    sizes = {"levels": 5, "log2_table": 10, "n_min": 6, "n_max": 48} | changes
    made = HashGrid(box, **sizes).double()
    torch.nn.init.normal_(made.table)
    return made


def slow_rows(box: Box, n: float, log2_table: int) -> tuple[list[int], dict]:
    """Cells of one level along each axis, and the row of each node, as the module's equation (2) says."""
    cells = [max(round(round(n) * float(size) / box.edge), 2) for size in box.size]
    rows = {}
    is_dense = math.prod(c + 1 for c in cells) <= 2**log2_table
    for node in itertools.product(*(range(c + 1) for c in cells)):
        x, y, z = node
        dense = x + (cells[0] + 1) * (y + (cells[1] + 1) * z)
        rows[node] = dense if is_dense else (x ^ 2654435761 * y ^ 805459861 * z) % 2**log2_table
    return cells, rows


def slow_features(made: HashGrid, box: Box, x: np.ndarray, scales: list[float], log2_table: int) -> list[float]:
    """Features at one position [m], corner by corner."""
    table, features, first = made.table.detach().numpy(), [], 0
    for n in scales:
        cells, rows = slow_rows(box, n, log2_table)
        place = [float((x[k] - box.low[k]) / box.size[k]) * cells[k] for k in range(3)]
        low = [min(int(p), c - 1) for p, c in zip(place, cells, strict=True)]
        total = np.zeros(2)
        for corner in itertools.product((0, 1), repeat=3):
            shares = [p - i if c else 1.0 - (p - i) for p, i, c in zip(place, low, corner, strict=True)]
            node = tuple(i + c for i, c in zip(low, corner, strict=True))
            total = total + math.prod(shares) * table[first + rows[node]]
        features += total.tolist()
        first += max(rows.values()) + 1 if len(rows) <= 2**log2_table else 2**log2_table
    assert first == len(table)
    return features


@pytest.mark.parametrize("box", [BOX, CUBE], ids=["flat", "cube"])
def test_features_are_those_of_a_walk_over_levels_and_corners(box, rng):
    made = grid(box, n_max=24)
    scales = geometric_scales(6, 24, 5)
    assert 0 < made.num_dense < 5
    x = rng.uniform(box.low, box.high, (20, 3))
    x[0], x[1] = box.low, box.high
    found = made(box.unit(torch.from_numpy(x))).detach().numpy()
    for value, one in zip(found, x, strict=True):
        np.testing.assert_allclose(value, slow_features(made, box, one, scales, 10), rtol=1e-10, atol=1e-13)


def test_the_gradient_of_the_table_is_that_of_finite_differences(rng):
    made = grid(levels=2, log2_table=5, n_min=2, n_max=6)
    assert made.num_dense == 1
    u = torch.from_numpy(rng.uniform(0.0, 1.0, (6, 3)))

    def features(table):
        return torch.func.functional_call(made, {"table": table}, u)

    assert torch.autograd.gradcheck(features, made.table.detach().clone().requires_grad_(True))


def test_outside_the_box_it_is_as_at_its_border():
    made = grid()
    u = torch.tensor([[-0.3, 0.4, 0.5], [1.3, 0.4, 0.5]], dtype=torch.float64)
    assert torch.equal(made(u), made(u.clamp(0.0, 1.0)))


def test_the_gradient_is_the_same_bit_for_bit_on_any_number_of_threads(rng):
    made = grid().float()
    u = torch.from_numpy(rng.uniform(0.0, 1.0, (20_000, 3))).float()
    threads, gradients = torch.get_num_threads(), []
    try:
        for num in (1, 2, 2):
            torch.set_num_threads(num)
            (gradient,) = torch.autograd.grad(made(u).square().sum(), made.table)
            gradients.append(gradient)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(gradients[0], gradients[1])
    assert torch.equal(gradients[1], gradients[2])


def test_the_defaults_are_those_of_nerfacto():
    made = HashGrid(CUBE, 16, 19, 16, 2048)
    assert made.cells[:, 0].tolist() == [16, 16, 16]
    assert made.cells[:, -1].tolist() == [2048, 2048, 2048]
    growth = (made.cells[0, 1:] / made.cells[0, :-1]).tolist()
    assert growth == pytest.approx([128.0 ** (1 / 15)] * 15, rel=0.03)  # resolutions are whole cells
    assert made.num_dense == 5  # 16, 22, 31, 42 and 58 cells: 59^3 is less than 2^19
    assert len(made.table) == sum((n + 1) ** 3 for n in (16, 22, 31, 42, 58)) + 11 * 2**19
    defaults = HashSettings()
    assert (defaults.levels, defaults.log2_table, defaults.n_min, defaults.n_max) == (16, 19, 16, 2048)
    assert (defaults.hidden, defaults.geometry) == (64, 15)


def test_an_untrained_box_lets_about_one_by_e_through():
    torch.manual_seed(0)
    density, _ = HashVolume(BOX, HashSettings(log2_table=12)).evaluate(positions(100))
    # The drawn layers put about +-0.2 on the raw numbers.
    assert (torch.exp(-density * BOX.edge) - math.exp(-1.0)).abs().max() < 0.1


def test_it_is_a_volume_model():
    check_interface(lambda appearance: HashVolume(BOX, SMALL, appearance=appearance))


def test_it_learns_a_bed_under_water():
    check_learning(lambda appearance: HashVolume(BOX, SMALL, appearance=appearance), steps=40, share=0.5)
