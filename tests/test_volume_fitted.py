"""Appearance vectors touch colour alone and can be matched; visibility learns what lies before a wall."""

import math

import numpy as np
import pytest
import torch
from analytic_volume import BOX, AnalyticVolume, floor_at, looking_down, seen_by
from volume_scenes import Slab

from fields.device import choose_device
from fields.image_store import GAMMA
from fields.volume import fitted
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
    return VolumeRenderer(model, appearance=fitted.appearance_vectors(photographs, length))


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
    renderer = VolumeRenderer(floor_at(0.0), appearance=fitted.appearance_vectors(2, 3))
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
    vectors = fitted.match_appearance(renderer, photographs, CELLS, steps=100, rays=512)
    # The analytic volume brightens by exp of the mean of the vector; 2 % is one grey value of 100 in linear light.
    assert torch.exp(vectors.weight.detach().mean(dim=1)).tolist() == pytest.approx(gains, rel=0.02)
    assert renderer.appearance is own
    assert all(torch.equal(before[k], v) for k, v in renderer.state_dict().items())
    assert all(p.grad is None for p in renderer.parameters())


def test_a_volume_without_vectors_has_none_to_match():
    with pytest.raises(ValueError, match="no appearance vectors"):
        fitted.match_appearance(VolumeRenderer(floor_at(0.0)), exposed([1.0])[1], CELLS)


def slow_loss(network: fitted.Visibility, volume: AnalyticVolume, paths, samples) -> float:
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
    volume, network = floor_at(0.0, width=0.2, density=4.0), fitted.Visibility(BOX)
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
    network = fitted.train_visibility(renderer, Photographs(cameras, images, pixels), CELLS, steps=100, rays=64)
    places = torch.tensor([[0.0, 0.0, 0.4], [0.2, -0.1, -0.4]])
    down = torch.tensor([[0.0, 0.0, -1.0]]).expand(2, 3)
    before, behind = network(places, down).tolist()
    assert before > 0.9
    assert behind < 0.1


def test_a_view_beside_a_volume_sees_nothing_of_it_and_one_over_it_half_of_what_is_clear():
    network = fitted.Visibility(BOX)
    assert network.of_view(looking_down(40.0), None, CELLS) == 0.0
    camera = looking_down(size=64)
    share = float((fitted.coarse_paths(camera, None, BOX).far > 0.0).float().mean())
    torch.nn.init.zeros_(network.network[-1].weight)
    torch.nn.init.zeros_(network.network[-1].bias)
    # A network of zeros says a half everywhere.
    assert network.of_view(camera, None, CELLS) == pytest.approx(0.5 * share)


def test_empty_boxes_are_clear_to_their_floor():
    paths = seen_by(looking_down())
    rendered = VolumeRenderer(Slab(0.0, box=BOX)).render(paths, CELLS.samples(paths, 8, jitter=False))
    assert (fitted.transmittance(rendered.weights)[paths.far > paths.near] == 1.0).all()
