"""LPIPS and DISTS with weights drawn by chance: their formulas in numpy, and what any weights have to give."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from image_pair import image_pair

from evaluation.images.learned_similarity import dists, lpips
from evaluation.images.quality import image_quality

# Sums of some thousand float32 products in another order.
ROUNDING = 2e-5
VGG = ((0, 3, 64), (2, 64, 64), (5, 64, 128), (7, 128, 128), (10, 128, 256), (12, 256, 256), (14, 256, 256),
       (17, 256, 512), (19, 512, 512), (21, 512, 512), (24, 512, 512), (26, 512, 512), (28, 512, 512))  # fmt: skip
ALEX = ((0, 3, 64, 11), (3, 64, 192, 5), (6, 192, 384, 3), (8, 384, 256, 3), (10, 256, 256, 3))


def drawn_weights(layers, heads) -> dict[str, torch.Tensor]:
    """Weights of a network whose activations neither grow nor vanish."""
    generator = torch.Generator().manual_seed(0)
    found = {}
    for index, channels, out, *size in layers:
        side = size[0] if size else 3
        spread = (2.0 / (channels * side * side)) ** 0.5
        found[f"features.{index}.weight"] = spread * torch.randn(out, channels, side, side, generator=generator)
        found[f"features.{index}.bias"] = 0.1 * torch.randn(out, generator=generator)
    for number, width in enumerate(heads):
        found[f"lin{number}.model.1.weight"] = torch.rand(1, width, 1, 1, generator=generator) / width
    for name in ("alpha", "beta"):
        found[name] = torch.rand(1, 3 + sum(heads), 1, 1, generator=generator)
    return found


@pytest.fixture(scope="module")
def vgg():
    return drawn_weights(VGG, (64, 128, 256, 512, 512))


@pytest.fixture(scope="module")
def alexnet():
    return drawn_weights(ALEX, (64, 192, 384, 256, 256))


@pytest.fixture(scope="module")
def pair():
    return [v[:48, :40] for v in image_pair()]


def convolved(x, weights, index, stride=1, padding=1):
    """relu(convolution) of (C, H, W), by windows and a matrix product."""
    kernel, bias = (weights[f"features.{index}.{part}"].numpy() for part in ("weight", "bias"))
    x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    windows = np.lib.stride_tricks.sliding_window_view(x, kernel.shape[2:], axis=(1, 2))[:, ::stride, ::stride]
    out = np.einsum("chwij,ocij->ohw", windows, kernel, optimize=True) + bias[:, None, None]
    return np.maximum(out, 0.0)


def pooled(x, side=2, reduce=np.max, padding=0):
    x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    windows = np.lib.stride_tricks.sliding_window_view(x, (side, side), axis=(1, 2))[:, ::2, ::2]
    return reduce(windows, axis=(3, 4))


def hann(windows, axis):
    taps = np.array([0.25, 0.5, 0.25])
    return np.sqrt(np.einsum("chwij,i,j->chw", windows**2, taps, taps) + 1e-12)


def vgg_layers(x, weights, pool):
    layers = []
    for number, group in enumerate(((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))):
        x = pool(x) if number else x
        for index in group:
            x = convolved(x, weights, index)
        layers.append(x)
    return layers


def alexnet_layers(x, weights):
    layers = [convolved(x, weights, 0, 4, 2)]
    layers.append(convolved(pooled(layers[-1], 3), weights, 3, 1, 2))
    layers.append(convolved(pooled(layers[-1], 3), weights, 6))
    layers.append(convolved(layers[-1], weights, 8))
    layers.append(convolved(layers[-1], weights, 10))
    return layers


def lpips_twin(pair, layers, weights) -> float:
    shift, scale = np.array([[-0.030, -0.088, -0.188], [0.458, 0.448, 0.450]])[:, :, None, None]
    features = [layers((2.0 * v.transpose(2, 0, 1) - 1.0 - shift) / scale, weights) for v in pair]
    total = 0.0
    for number, (a, b) in enumerate(zip(*features, strict=True)):
        a, b = (v / (np.linalg.norm(v, axis=0) + 1e-10) for v in (a, b))
        total += np.mean(np.tensordot(weights[f"lin{number}.model.1.weight"].numpy().ravel(), (a - b) ** 2, 1))
    return float(total)


def dists_twin(pair, weights) -> float:
    mean, std = np.array([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])[:, :, None, None]
    images = [v.transpose(2, 0, 1) for v in pair]

    def pool(x):
        return pooled(x, 3, hann, 1)

    features = [[v, *vgg_layers((v - mean) / std, weights, pool)] for v in images]
    alpha, beta = (weights[name].numpy().ravel() for name in ("alpha", "beta"))
    like = []
    for a, b in zip(*features, strict=True):
        a, b = a.reshape(len(a), -1), b.reshape(len(b), -1)
        ma, mb = a.mean(axis=1), b.mean(axis=1)
        cov = (a * b).mean(axis=1) - ma * mb
        texture = (2 * ma * mb + 1e-6) / (ma**2 + mb**2 + 1e-6)
        like.append((texture, (2 * cov + 1e-6) / (a.var(axis=1) + b.var(axis=1) + 1e-6)))
    texture, structure = (np.concatenate(v) for v in zip(*like, strict=True))
    return float(1.0 - (alpha @ texture + beta @ structure) / (alpha + beta).sum())


def test_lpips_is_its_formula_with_either_network(pair, vgg, alexnet):
    expected = lpips_twin(pair, lambda x, w: vgg_layers(x, w, pooled), vgg)
    assert lpips(*pair, vgg) == pytest.approx(expected, rel=ROUNDING)
    assert lpips(*pair, alexnet) == pytest.approx(lpips_twin(pair, alexnet_layers, alexnet), rel=ROUNDING)


def test_dists_is_its_formula(pair, vgg):
    assert dists(*pair, vgg) == pytest.approx(dists_twin(pair, vgg), abs=ROUNDING)


def test_equal_images_are_not_apart_order_does_not_matter_and_more_noise_is_worse(pair, vgg, alexnet, rng):
    image = pair[0]
    noise = rng.uniform(-1.0, 1.0, image.shape)
    little, much = (np.clip(image + s * noise, 0.0, 1.0) for s in (0.02, 0.3))
    for measure, weights in ((lpips, vgg), (lpips, alexnet), (dists, vgg)):
        assert measure(image, image, weights) == pytest.approx(0.0, abs=ROUNDING)
        assert measure(image, much, weights) == pytest.approx(measure(much, image, weights), rel=1e-4)
        assert 0.0 < measure(image, little, weights) < measure(image, much, weights)


def test_weights_that_lack_something_are_refused_with_what_to_give(pair, vgg):
    without = {name: value for name, value in vgg.items() if name != "lin3.model.1.weight"}
    with pytest.raises(ValueError, match=r"lack lin3\.model\.1\.weight \(they have 32 arrays.* to lin4 for LPIPS"):
        lpips(*pair, without)
    with pytest.raises(ValueError, match=r"lack features\.0\.weight"):
        dists(*pair, {})
    with pytest.raises(ValueError, match="need colour images, got grey ones; use ssim or gmsd"):
        dists(*(v[..., 0] for v in pair), vgg)


def test_learned_measures_are_among_the_others_where_their_weights_are(vgg, alexnet):
    a, b = (v[:176, :176] for v in image_pair())
    found = image_quality(a, b, lpips_weights=alexnet, dists_weights=vgg)
    assert found["lpips"] == lpips(a, b, alexnet)
    assert found["dists"] == dists(a, b, vgg)
    assert not {"lpips", "dists"} & image_quality(a, b).keys()
