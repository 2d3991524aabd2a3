"""Appearance vectors: they touch colour alone, and can be matched with all else left as it is."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from analytic_volume import BOX, floor_at, looking_down, seen_by

from fields.device import choose_device
from fields.image_store import GAMMA
from fields.volume.fitted import appearance_vectors, match_appearance
from fields.volume.photographs import Photographs
from fields.volume.renderer import VolumeRenderer
from fields.volume.sampling import Cells
from fields.volume.tensor import TensorSettings, TensorVolume

CELLS = Cells.everywhere(BOX, 16)


def tensor_renderer(photographs: int = 3, length: int = 4) -> VolumeRenderer:
    torch.manual_seed(0)
    settings = TensorSettings(scales=2, n_min=4, n_max=8)
    model = TensorVolume(BOX, settings, choose_device("torch"), appearance=length)
    torch.nn.init.normal_(model.regression.coarse.weight)
    return VolumeRenderer(model, appearance=appearance_vectors(photographs, length))


def test_another_vector_changes_colour_and_not_a_bit_of_density_or_depth():
    renderer, paths = tensor_renderer(), seen_by(looking_down(), view=1)
    samples = CELLS.samples(paths, 16, jitter=False)
    before = renderer.render(paths, samples)
    renderer.appearance.weight.data[1] += 1.0
    after = renderer.render(paths, samples)
    assert torch.equal(before.weights, after.weights)
    assert torch.equal(before.depth, after.depth)
    assert (before.rgb - after.rgb).abs().max().item() > 1e-3


def test_no_gradient_of_density_reaches_the_vectors_and_none_of_colour_those_of_other_views():
    renderer, paths = tensor_renderer(), seen_by(looking_down(), view=1)
    rendered = renderer.render(paths, CELLS.samples(paths, 16, jitter=False))
    (none,) = torch.autograd.grad(
        rendered.weights.sum(), [renderer.appearance.weight], allow_unused=True, retain_graph=True
    )
    assert none is None
    (some,) = torch.autograd.grad(rendered.rgb.sum(), [renderer.appearance.weight])
    assert some[1].abs().sum() > 0.0
    assert not some[[0, 2]].any()


def exposed(gains: list[float]) -> tuple[VolumeRenderer, Photographs]:
    """A floor whose look is known, and photographs of it with gains in linear light."""
    renderer = VolumeRenderer(floor_at(0.0), appearance=appearance_vectors(2, 3))
    cameras = [looking_down(0.1 * k) for k in range(len(gains))]
    images = []
    for camera, gain in zip(cameras, gains, strict=True):
        paths = seen_by(camera)
        with torch.no_grad():
            plain = renderer.render(paths, CELLS.samples(paths, 128, jitter=False)).rgb
        stored = (gain ** (1.0 / GAMMA) * plain).clamp(0.0, 1.0).view(camera.height, camera.width, 3)
        images.append((255.0 * stored).round().to(torch.uint8).numpy())
    pixels = [np.arange(camera.width * camera.height) for camera in cameras]
    return renderer, Photographs(cameras, images, pixels)


def test_matching_finds_the_exposure_of_new_photographs_and_leaves_the_volume_alone():
    gains = [0.5, 0.8, 1.0]
    renderer, photographs = exposed(gains)
    own, before = renderer.appearance, {k: v.clone() for k, v in renderer.state_dict().items()}
    vectors = match_appearance(renderer, photographs, CELLS, steps=100, rays=512)
    # The analytic volume brightens by exp of the mean of the vector; 2 % is one grey value of 100 in linear light.
    assert torch.exp(vectors.weight.detach().mean(dim=1)).tolist() == pytest.approx(gains, rel=0.02)
    assert renderer.appearance is own
    assert all(torch.equal(before[k], v) for k, v in renderer.state_dict().items())
    assert all(p.grad is None for p in renderer.parameters())


def test_a_volume_without_vectors_has_none_to_match():
    with pytest.raises(ValueError, match="no appearance vectors"):
        match_appearance(VolumeRenderer(floor_at(0.0)), exposed([1.0])[1], CELLS)
