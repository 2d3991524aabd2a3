"""Visibility: its loss as printed, what the network learns of a wall, and what a view sees of a volume."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from analytic_volume import BOX, AnalyticVolume, floor_at, looking_down, seen_by
from volume_scenes import Slab

from fields.volume.fitted import Visibility, coarse_paths, train_visibility, transmittance
from fields.volume.photographs import Photographs
from fields.volume.renderer import VolumeRenderer
from fields.volume.sampling import Cells

CELLS = Cells.everywhere(BOX, 16)


def slow_loss(network: Visibility, volume: AnalyticVolume, paths, samples) -> float:
    """Equation (1) transcribed: path by path, sample by sample, with T_i = exp(-sum_{j<i} sigma_j l_j)."""
    errors = []
    for n in range(len(paths)):
        if not paths.far[n] > paths.near[n]:
            continue
        x, d = paths.at(samples.s)[n], paths.direction(samples.s)[n]
        passed = 0.0
        for i in range(samples.s.shape[1]):
            said = network(x[i][None], d[i][None])[0].item()
            errors.append((said - math.exp(-passed)) ** 2)
            passed += (volume.evaluate(x[i][None])[0][0] * samples.length[n, i]).item()
    return float(np.mean(errors))


def test_the_loss_is_that_of_the_equation_and_leaves_the_density_alone():
    torch.manual_seed(1)
    volume, network = floor_at(0.0, width=0.2, density=4.0), Visibility(BOX)
    # The outer paths pass the box by.
    paths = seen_by(looking_down(0.8, size=8))
    samples = CELLS.samples(paths, 6, jitter=False)
    loss = network.loss(paths, VolumeRenderer(volume).render(paths, samples))
    assert 0 < int((paths.far > paths.near).sum()) < len(paths)
    # Six roundings of weights in single precision.
    assert loss.item() == pytest.approx(slow_loss(network, volume, paths, samples), rel=1e-4)
    loss.backward()
    assert volume.scale.grad is None
    assert all(parameter.grad is not None for parameter in network.parameters())


def test_it_learns_what_lies_before_and_behind_an_opaque_floor():
    renderer = VolumeRenderer(floor_at(0.0))
    cameras = [looking_down(0.2 * k) for k in range(3)]
    pixels = [np.arange(camera.width * camera.height) for camera in cameras]
    images = [np.zeros((24, 24, 3), dtype=np.uint8)] * 3
    network = train_visibility(renderer, Photographs(cameras, images, pixels), CELLS, steps=100, rays=64)
    places = torch.tensor([[0.0, 0.0, 0.4], [0.2, -0.1, -0.4]])
    down = torch.tensor([[0.0, 0.0, -1.0]]).expand(2, 3)
    before, behind = network(places, down).tolist()
    assert before > 0.9
    assert behind < 0.1


def test_a_view_beside_a_volume_sees_nothing_of_it_and_one_over_it_half_of_what_is_clear():
    network = Visibility(BOX)
    assert network.of_view(looking_down(40.0), None, CELLS) == 0.0
    camera = looking_down(size=64)
    share = float((coarse_paths(camera, None, BOX).far > 0.0).float().mean())
    torch.nn.init.zeros_(network.network[-1].weight)
    torch.nn.init.zeros_(network.network[-1].bias)
    # A network of zeros says a half everywhere.
    assert network.of_view(camera, None, CELLS) == pytest.approx(0.5 * share)


def test_empty_boxes_are_clear_to_their_floor():
    paths = seen_by(looking_down())
    rendered = VolumeRenderer(Slab(0.0, box=BOX)).render(paths, CELLS.samples(paths, 8, jitter=False))
    assert (transmittance(rendered.weights)[paths.far > paths.near] == 1.0).all()
