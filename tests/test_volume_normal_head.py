"""Normals from features: against a loop, held to monocular ones, stored; and Huber's loss of colours."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from analytic_volume import BOX, floor_at, looking_down, seen_by

from fields.volume.prior_losses import predicted_normals
from fields.volume.renderer import NormalHead, VolumeRenderer
from fields.volume.sampling import Cells
from fields.volume.train import _of_colours


def test_a_normal_is_the_weighted_mean_of_those_of_the_samples():
    head = NormalHead(3, 5).double()
    weights, features = torch.rand(2, 4, dtype=torch.float64), torch.randn(8, 3, dtype=torch.float64)
    found = head.along(weights, features).detach().numpy()
    (w1, b1), (w2, b2) = (
        (layer.weight.detach().numpy(), layer.bias.detach().numpy()) for layer in (head.hidden, head.last)
    )
    for path in range(2):
        total = np.zeros(3)
        for k in range(4):
            n = w2 @ np.maximum(w1 @ features[4 * path + k].numpy() + b1, 0.0) + b2
            total += weights[path, k].item() * n / np.linalg.norm(n)
        np.testing.assert_allclose(found[path], total / np.linalg.norm(total), rtol=1e-12)


def test_a_renderer_with_a_head_says_normals_and_learns_it_once():
    renderer = VolumeRenderer(floor_at(0.0), normals=NormalHead(floor_at(0.0).num_features))
    paths, cells = seen_by(looking_down(size=6)), Cells.everywhere(BOX, 8)
    rendered = renderer.render(paths, cells.samples(paths, 16, jitter=False))
    torch.testing.assert_close(predicted_normals(rendered).norm(dim=1), torch.ones(len(paths)))
    learning = [p for group in renderer.rates() for p in group.parameters]
    assert {id(p) for p in learning} == {id(p) for p in renderer.parameters()}
    without = VolumeRenderer(floor_at(0.0)).render(paths, cells.samples(paths, 16, jitter=False))
    with pytest.raises(ValueError, match="no head of normals; give it one"):
        predicted_normals(without)


def test_huber_is_half_the_square_below_its_limit_and_linear_above():
    rendered, seen = torch.tensor([[0.05, 0.5, 0.0]]), torch.zeros(1, 3)
    expected = (0.5 * 0.05**2 + 0.1 * (0.5 - 0.05)) / 3.0
    assert _of_colours(rendered, seen, 0.1).item() == pytest.approx(expected)
    assert _of_colours(rendered, seen, 0.0).item() == pytest.approx((0.05**2 + 0.25) / 3.0)
