"""Patches: drawn whole, and their losses against loops, closed forms and finite differences; and virtual views."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from analytic_volume import BOX, WATER, floor_at, looking_down, seen_by

from fields.volume.losses import (
    C1,
    C2,
    NOISE,
    as_patches,
    masked_ncc,
    ncc_loss,
    paths_through,
    ssim_loss,
    virtual_patch_loss,
    virtual_view,
)
from fields.volume.photographs import Photographs
from fields.volume.renderer import VolumeRenderer
from fields.volume.sampling import Cells


def two_patches(seed: int) -> torch.Tensor:
    return torch.rand(2, 5, 5, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_correlation_is_that_of_a_loop_and_blind_to_gain_and_offset():
    x, y = two_patches(0), two_patches(1)
    total = 0.0
    for patch in range(2):
        for channel in range(3):
            a, b = (v[patch, :, :, channel].numpy().ravel() for v in (x, y))
            cov = np.mean((a - a.mean()) * (b - b.mean()))
            total += 1.0 - (cov + NOISE) / math.sqrt((a.var() + NOISE) * (b.var() + NOISE))
    assert ncc_loss(x, y).item() == pytest.approx(total / 6.0, rel=1e-12)
    assert ncc_loss(x, x).item() == pytest.approx(0.0, abs=1e-15)
    # Blind but for the variance of one grey value against that of the patch, 1/12.
    assert ncc_loss(0.5 * x + 0.2, x).item() == pytest.approx(0.0, abs=12.0 * 4.0 * NOISE)
    assert ncc_loss(-x, x).item() == pytest.approx(2.0, rel=1e-3)


def test_patches_without_texture_count_as_alike():
    flat = torch.full((1, 4, 4, 3), 0.3)
    assert ncc_loss(flat, flat + 0.2).item() == pytest.approx(0.0, abs=1e-6)  # float32


def test_structural_similarity_is_that_of_a_loop_over_windows():
    x, y = two_patches(0), two_patches(1)
    values = []
    for patch in range(2):
        for channel in range(3):
            for row in range(3):
                for column in range(3):
                    window = (slice(row, row + 3), slice(column, column + 3), channel)
                    a, b = (v[patch][window].numpy().ravel() for v in (x, y))
                    cov = np.mean((a - a.mean()) * (b - b.mean()))
                    light = (2.0 * a.mean() * b.mean() + C1) / (a.mean() ** 2 + b.mean() ** 2 + C1)
                    values.append(light * (2.0 * cov + C2) / (a.var() + b.var() + C2))
    assert ssim_loss(x, y).item() == pytest.approx(0.5 * (1.0 - np.mean(values)), rel=1e-10)
    assert ssim_loss(x, x).item() == pytest.approx(0.0, abs=1e-14)


def test_hidden_pixels_count_neither_in_correlation_nor_in_similarity():
    x, y = two_patches(0), two_patches(1)
    shown = torch.ones(2, 5, 5, dtype=torch.float64)
    assert masked_ncc(x, y, shown).item() == pytest.approx(1.0 - ncc_loss(x, y).item())
    assert ssim_loss(x, y, shown).item() == pytest.approx(ssim_loss(x, y).item())
    shown[0, :, 3:], shown[1, 0] = 0.0, 0.0
    total, windows = 0.0, []
    for patch in range(2):
        kept = shown[patch].numpy().astype(bool)
        for channel in range(3):
            a, b = (v[patch, :, :, channel].numpy() for v in (x, y))
            cov = np.mean((a[kept] - a[kept].mean()) * (b[kept] - b[kept].mean()))
            spread = math.sqrt((a[kept].var() + NOISE) * (b[kept].var() + NOISE))
            total += kept.sum() * (cov + NOISE) / spread / 3.0
            for row in range(3):
                for column in range(3):
                    if kept[row : row + 3, column : column + 3].all():
                        window = (slice(patch, patch + 1), slice(row, row + 3), slice(column, column + 3))
                        windows.append(ssim_loss(*(v[window][..., channel : channel + 1] for v in (x, y))).item())
    assert masked_ncc(x, y, shown).item() == pytest.approx(total / shown.sum().item(), rel=1e-12)
    assert ssim_loss(x, y, shown).item() == pytest.approx(np.mean(windows), rel=1e-10)
    assert ssim_loss(x, y, torch.zeros(2, 5, 5)).item() == 0.0


def test_half_a_patch_is_refused():
    with pytest.raises(ValueError, match="whole patches of 4 x 4 px"):
        as_patches(torch.zeros(24, 3), 4)


def photographs() -> Photographs:
    """Two photographs whose colours tell row, column and view, and the left part of each shows the scene."""
    cameras = [looking_down(), looking_down(0.2)]
    rows, columns = np.mgrid[:24, :24].astype(np.uint8)
    images = [np.stack([rows, columns, np.full_like(rows, view)], axis=-1) for view in range(2)]
    return Photographs(cameras, images, [np.flatnonzero(columns < 11)] * 2)


@pytest.mark.parametrize("size", [1, 3, 4])
def test_patches_are_squares_of_neighbours_row_by_row_inside_what_shows_the_scene(size):
    paths = photographs().draw(300, BOX, np.random.default_rng(0), size)
    seen = torch.round(255.0 * paths.rgb).long().view(300, size, size, 3)
    first = seen[:, :1, :1]
    steps = torch.stack(torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij"), dim=-1)
    assert torch.equal(seen[..., :2] - first[..., :2], steps.expand(300, -1, -1, -1))
    assert torch.equal(seen[..., 2], paths.view.view(300, size, size))
    corners = {tuple(c) for c in first[:, 0, 0, :2].tolist()}
    # All corners that fit, from the first to the last, and none beyond.
    assert {r for r, _ in corners} == set(range(24 - size + 1))
    assert {c for _, c in corners} == set(range(11 - size + 1))


def test_patches_larger_than_what_shows_the_scene_are_refused():
    with pytest.raises(ValueError, match="12 x 12 px; draw smaller patches"):
        photographs().draw(1, BOX, np.random.default_rng(0), 12)


@pytest.mark.parametrize("water", [None, WATER])
def test_virtual_paths_pass_their_points_at_their_lengths_and_bend_as_a_camera_there_sees_them(water):
    camera = looking_down(0.7, 0.2)
    points = torch.from_numpy(np.random.default_rng(0).uniform(-0.9, 0.9, (576, 3)).astype(np.float32))
    centres = torch.from_numpy(camera.centre.astype(np.float32)).expand(576, 3)
    moved, length = paths_through(centres, points, water, seen_by(looking_down(), water), BOX)
    torch.testing.assert_close(moved.at(length[:, None])[:, 0], points, rtol=0.0, atol=5e-6)  # float32, 6 m
    pixels = camera.project(points.double().numpy(), water)
    np.testing.assert_allclose(moved.air.numpy(), camera.directions(pixels), atol=5e-6)
    assert ((moved.near <= length) & (length <= moved.far)).all()


def test_virtual_patches_of_a_floor_look_like_those_photographed_and_of_other_texture_they_do_not():
    floor = VolumeRenderer(floor_at(-0.2, width=0.002, density=1000.0))
    paths, cells = seen_by(looking_down(), WATER), Cells.everywhere(BOX, 16)
    rendered = floor.render(paths, cells.samples(paths, 256, jitter=False))
    losses = []
    for seen in (rendered.rgb.detach(), 0.5 * rendered.rgb.detach() + 0.2, torch.rand(len(paths), 3)):
        torch.manual_seed(0)
        paths.rgb = seen
        losses.append(virtual_patch_loss(floor, paths, rendered, cells, WATER, 4).item())
    # Correlation is blind to gain and offset, similarity is not; noise has next to none of either: (1 - 0)^2 + 1.
    assert losses[0] < 0.1
    assert losses[0] < losses[1] < 0.7
    assert losses[2] > 1.5


def test_points_that_a_virtual_view_cannot_see_are_left_out():
    paths, cells = seen_by(looking_down(), None), Cells.everywhere(BOX, 16)
    renderer = VolumeRenderer(floor_at(0.0))
    rendered = renderer.render(paths, cells.samples(paths, 64, jitter=False))
    assert virtual_view(renderer, paths, rendered, cells, None)[1].float().mean() > 0.9
    # Weights moved 0.6 m below the floor: every virtual view stops at the floor before it.
    rendered.samples.edges += 0.6
    assert not virtual_view(renderer, paths, rendered, cells, None)[1].any()
    rendered.weights.data.zero_()
    assert not virtual_view(renderer, paths, rendered, cells, None)[1].any()
