"""Samples along paths: where the mass is, evenly in what is occupied, and what each of them stands for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from test_volume_paths import whole
from volume_scenes import BOX, WATER, looking_down

from fields.volume.paths import Box
from fields.volume.sampling import BINS, Cells, inverse_cdf, samples_by_mass


def test_the_inverse_of_the_accumulated_mass_is_that_of_numpy():
    rng = np.random.default_rng(0)
    edges = np.cumsum(rng.uniform(0.1, 1.0, (5, 9)), axis=1)
    mass = rng.uniform(0.0, 1.0, (5, 8)) * (rng.random((5, 8)) > 0.3)
    levels = np.sort(rng.random((5, 40)), axis=1)
    found = inverse_cdf(*(torch.as_tensor(v) for v in (edges, mass, levels))).numpy()
    for row in range(5):
        total = np.r_[0.0, np.cumsum(mass[row])] / mass[row].sum()
        filled = np.r_[True, mass[row] > 0]  # np.interp wants a rising function
        start = np.where(mass[row] > 0, edges[row, :-1], np.nan)
        for level, value in zip(levels[row], found[row], strict=True):
            k = np.searchsorted(total[1:], level, side="right")
            share = (level - total[k]) / (total[k + 1] - total[k])
            assert value == pytest.approx(start[k] + share * (edges[row, k + 1] - edges[row, k]), abs=1e-12)
        assert filled[0]


@pytest.mark.parametrize("jitter", [False, True])
def test_samples_lie_in_the_bins_with_mass_and_share_their_length(jitter):
    edges = torch.linspace(0.0, 8.0, 9).expand(3, -1).contiguous()
    mass = torch.tensor([[0.0, 1, 1, 0, 0, 1, 0, 0], [1.0] * 8, [0.0] * 8])
    samples = samples_by_mass(edges, mass, 12, jitter, dense=False)
    bins = samples.s.floor().long().clamp(max=7)
    assert (mass[0][bins[0]] == 1.0).all()
    torch.testing.assert_close(samples.length.sum(dim=1), torch.tensor([3.0, 8.0, 8.0]))
    assert (samples.s.diff(dim=1) > 0.0).all()
    assert (samples.edges[:, :-1] <= samples.s + 1e-6).all()
    assert (samples.s <= samples.edges[:, 1:] + 1e-6).all()
    # Over many draws a jittered sample is anywhere in its piece; without jitter it is the middle.
    if not jitter:
        torch.testing.assert_close(samples.s[1], samples.edges[1].unfold(0, 2, 1).mean(dim=1))


def test_dense_samples_stand_for_what_lies_between_their_edges():
    edges = torch.linspace(0.0, 4.0, 5)[None]
    samples = samples_by_mass(edges, torch.tensor([[1.0, 3.0, 0.0, 4.0]]), 8, False, dense=True)
    expected = torch.tensor([[0.0, 1.0, 4 / 3, 5 / 3, 2.0, 3.25, 3.5, 3.75, 4.0]])
    torch.testing.assert_close(samples.edges[:, [0, 1, 2, 3, 5, 6, 7, 8]], expected[:, [0, 1, 2, 3, 5, 6, 7, 8]])
    torch.testing.assert_close(samples.length.sum(dim=1), torch.tensor([4.0]))


def test_cells_hold_what_they_are_said_to():
    box = Box(np.array([0.0, 0.0, 0.0]), np.array([4.0, 2.0, 1.0]))
    cells = Cells.everywhere(box, 8)
    assert cells.occupied.shape == (8, 4, 2)
    cells.occupied.zero_()
    cells.occupied[5, 1, 0] = True
    x = torch.tensor([[2.6, 0.6, 0.2], [2.4, 0.6, 0.2], [2.6, 0.6, 0.6], [2.6, 0.6, -0.1], [9.0, 0.6, 0.2]])
    assert cells.holds(x).tolist() == [True, False, False, False, False]
    centre = cells.centres().view(8, 4, 2, 3)[5, 1, 0]
    torch.testing.assert_close(centre, torch.tensor([2.75, 0.75, 0.25]))


def cells_about(box: Box, num: int, points: np.ndarray, margin: float) -> Cells:
    """Cells that a field with mass at points (N, 3) has left."""
    every = Cells.everywhere(box, num)
    opacity = torch.zeros(every.occupied.shape)
    index = np.floor((points - box.low) / box.size * np.array(opacity.shape)).astype(int)
    index = index[(index < opacity.shape).all(axis=1)]
    opacity[tuple(index.T)] = 1.0
    return every.refined(opacity.view(-1), 0.5, margin)


def test_cells_with_mass_are_thickened_by_the_margin_within_the_box():
    box = Box(np.zeros(3), np.array([4.0, 4.0, 2.0]))
    occupied = cells_about(box, 20, np.array([[2.1, 2.1, 1.1], [0.01, 0.01, 0.01]]), margin=0.4).occupied.numpy()
    expected = np.zeros_like(occupied)
    expected[8:13, 8:13, 3:8] = True
    expected[:3, :3, :3] = True
    np.testing.assert_array_equal(occupied, expected)


def test_samples_lie_in_occupied_cells_and_all_over_a_path_that_misses_them():
    paths = whole(looking_down(tilt=0.2), WATER)
    points = np.stack(np.meshgrid(np.linspace(-1, 0, 60), np.linspace(-1, 1, 60), [-1.5]), axis=-1).reshape(-1, 3)
    cells = cells_about(BOX, 40, points, margin=0.04)
    samples = cells.samples(paths, 16, jitter=True)
    held = cells.holds(paths.at(samples.s))
    share = paths.near[:, None] + (torch.arange(BINS) + 0.5) / BINS * (paths.far - paths.near)[:, None]
    crosses = cells.holds(paths.at(share)).any(dim=1)
    assert 0.2 < crosses.float().mean() < 0.9
    # The cells are asked at the middles of 128 bins of some 12 mm: a sample may stand half a bin beside.
    assert held[crosses].float().mean() > 0.9
    torch.testing.assert_close(samples.length[~crosses].sum(dim=1), (paths.far - paths.near)[~crosses])
    step = ((paths.far - paths.near) / BINS)[crosses]
    count = samples.length.sum(dim=1)[crosses] / step
    torch.testing.assert_close(count, count.round(), rtol=0, atol=1e-2)
