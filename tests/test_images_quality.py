"""Measures of images: against other libraries, definitions, and formulas of learned networks."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from image_pair import image_pair

from evaluation import fsim, gmsd, image_quality, ms_gmsd, ms_ssim, psnr, ssim, vsi
from evaluation.images.inputs import largest_rectangle
from evaluation.images.learned_similarity import dists, lpips

# Sums of 1e5 terms in another order.
ROUNDING = 1e-12
# torch takes the lower of the two middle values as the median, which sets the noise of phase congruency.
MEDIAN = 3e-6
# Other digits of the matrix and white point of CIELAB, computed in float32 here.
LAB = 1e-4
PIQ = {
    "ssim": (0.7470858759967814, ROUNDING),
    "ms_ssim": (0.9625407766562782, ROUNDING),
    "gmsd": (0.04050062682935582, ROUNDING),
    "ms_gmsd": (0.04897435713027294, ROUNDING),
    "fsim": (0.8364157953304584, MEDIAN),
    "vsi": (0.9755926071636889, LAB),
}


@pytest.fixture(scope="module")
def pair():
    return image_pair()


def test_measures_are_those_of_another_library(pair):
    found = image_quality(*pair)
    for name, (expected, tolerance) in PIQ.items():
        assert found[name] == pytest.approx(expected, abs=tolerance), name


def test_psnr_is_that_of_its_definition():
    a = np.full((8, 8), 0.5)
    assert psnr(a, a + 0.1) == pytest.approx(20.0)


@pytest.mark.filterwarnings("ignore")
def test_psnr_and_ssim_are_those_of_torchmetrics_inside_the_image(pair):
    """Its mean is over windows beyond the rim too, where it mirrors the image: the rim is cut off its map here."""
    torchmetrics = pytest.importorskip("torchmetrics.functional.image", reason="torchmetrics is not installed")
    tensors = [torch.from_numpy(v.transpose(2, 0, 1).copy())[None] for v in pair]
    # Its sum is of float32 squares.
    assert psnr(*pair) == pytest.approx(float(torchmetrics.peak_signal_noise_ratio(*tensors, data_range=1.0)), abs=3e-6)
    _, similarity = torchmetrics.structural_similarity_index_measure(*tensors, data_range=1.0, return_full_image=True)
    assert ssim(*pair) == pytest.approx(float(similarity[..., 5:-5, 5:-5].mean()), abs=ROUNDING)


def test_large_images_are_pooled_and_grey_ones_have_no_colour():
    a, b = image_pair("large")
    assert fsim(a, b) == pytest.approx(0.9647184319708539, abs=MEDIAN)
    grey = [v @ np.array([0.299, 0.587, 0.114]) for v in (a, b)]
    assert fsim(*grey) == pytest.approx(0.9651068670578986, abs=MEDIAN)
    assert "vsi" not in image_quality(*grey)


def test_equal_images_are_alike(pair):
    image = pair[0]
    best = {"psnr_db": math.inf, "ssim": 1.0, "ms_ssim": 1.0, "gmsd": 0.0, "ms_gmsd": 0.0, "fsim": 1.0, "vsi": 1.0}
    assert image_quality(image, image) == pytest.approx(best, abs=ROUNDING)


@pytest.mark.parametrize("measure", [ssim, ms_ssim, fsim, vsi, psnr, gmsd, ms_gmsd])
def test_order_does_not_matter_and_more_noise_is_worse(pair, measure, rng):
    image = pair[0]
    noise = rng.uniform(-1.0, 1.0, image.shape)
    little, much = (np.clip(image + s * noise, 0.0, 1.0) for s in (0.02, 0.2))
    assert measure(image, much) == pytest.approx(measure(much, image), rel=1e-9)
    falls = measure(image, little) > measure(image, much)
    assert falls != (measure in (gmsd, ms_gmsd))


def test_ssim_of_two_flat_images_is_its_luminance():
    a, b = np.full((20, 20), 0.3), np.full((20, 20), 0.6)
    assert ssim(a, b) == pytest.approx((2 * 0.18 + 1e-4) / (0.45 + 1e-4), abs=ROUNDING)


def test_the_smallest_image_of_five_scales_holds_a_window_at_each():
    a, b = (v[:176, :176] for v in image_pair())
    assert 0.0 < ms_ssim(a, b) < 1.0
    with pytest.raises(ValueError, match="at least 176 x 176 pixels, got 176 x 175"):
        ms_ssim(a[:175], b[:175])


def test_images_without_features_or_saliency_are_alike():
    flat = np.full((32, 32, 3), 0.5)
    assert fsim(flat, flat) == 1.0
    assert vsi(flat, flat) == 1.0


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        (np.zeros((32, 32)), np.zeros((32, 33)), r"one shape .* got \(32, 32\) and \(32, 33\)"),
        (np.zeros((32, 32, 4)), np.zeros((32, 32, 4)), r"\(H, W\) or \(H, W, 3\)"),
        (np.zeros((9, 32)), np.zeros((9, 32)), r"at least 11 x 11 pixels, got 32 x 9"),
        (np.zeros((32, 32)), np.full((32, 32), 255.0), r"from 0 to 1, got 255 to 255; divide by 255\?"),
        (np.zeros((32, 32)), np.full((32, 32), np.nan), "expected finite values, got 1024 that are NaN"),
    ],
)
def test_pairs_that_cannot_be_compared_are_refused(a, b, message):
    with pytest.raises(ValueError, match=message):
        ssim(a, b)


@pytest.mark.parametrize("density", [0.5, 0.8, 0.95])
def test_the_largest_rectangle_is_that_of_trying_all(rng, density):
    for _ in range(20):
        mask = rng.random((7, 9)) < density
        rows, columns = largest_rectangle(mask)
        assert mask[rows, columns].all()
        sides = [(r, s, c, d) for r in range(7) for s in range(r, 8) for c in range(9) for d in range(c, 10)]
        most = max((s - r) * (d - c) for r, s, c, d in sides if mask[r:s, c:d].all())
        assert (rows.stop - rows.start) * (columns.stop - columns.start) == most


def test_only_pixels_in_the_mask_count(pair):
    mask = np.zeros(pair[0].shape[:2], dtype=bool)
    mask[10:230, 20:300] = True
    mask[10:20, 20:30] = False
    spoilt = pair[1].copy()
    spoilt[~mask] = 0.0
    found = image_quality(pair[0], spoilt, mask=mask)
    rows, columns = largest_rectangle(mask)
    cut = image_quality(pair[0][rows, columns], pair[1][rows, columns])
    assert found == {**cut, "psnr_db": psnr(pair[0], pair[1], mask)}
    errors = (pair[0] - pair[1])[mask]
    assert found["psnr_db"] == pytest.approx(-10.0 * np.log10(np.mean(errors**2)), abs=ROUNDING)
    with pytest.raises(ValueError, match=r"expected a mask \(256, 320\) with pixels, got \(256, 320\) with 0"):
        image_quality(*pair, mask=np.zeros_like(mask))
    with pytest.raises(ValueError, match=r"expected a mask \(256, 320\) with pixels, got \(3, 3\)"):
        psnr(*pair, np.ones((3, 3), dtype=bool))


def test_vsi_of_grey_images_is_refused_with_what_does_it_instead():
    with pytest.raises(ValueError, match="VSI needs colour images, got grey ones; use fsim or gmsd"):
        vsi(np.zeros((32, 32)), np.zeros((32, 32)))


# Sums of some thousand float32 products in another order.
LEARNED_ROUNDING = 2e-5
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
def small_pair():
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


def lpips_twin(small_pair, layers, weights) -> float:
    shift, scale = np.array([[-0.030, -0.088, -0.188], [0.458, 0.448, 0.450]])[:, :, None, None]
    features = [layers((2.0 * v.transpose(2, 0, 1) - 1.0 - shift) / scale, weights) for v in small_pair]
    total = 0.0
    for number, (a, b) in enumerate(zip(*features, strict=True)):
        a, b = (v / (np.linalg.norm(v, axis=0) + 1e-10) for v in (a, b))
        total += np.mean(np.tensordot(weights[f"lin{number}.model.1.weight"].numpy().ravel(), (a - b) ** 2, 1))
    return float(total)


def dists_twin(small_pair, weights) -> float:
    mean, std = np.array([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])[:, :, None, None]
    images = [v.transpose(2, 0, 1) for v in small_pair]

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


def test_lpips_is_its_formula_with_either_network(small_pair, vgg, alexnet):
    expected = lpips_twin(small_pair, lambda x, w: vgg_layers(x, w, pooled), vgg)
    assert lpips(*small_pair, vgg) == pytest.approx(expected, rel=LEARNED_ROUNDING)
    assert lpips(*small_pair, alexnet) == pytest.approx(
        lpips_twin(small_pair, alexnet_layers, alexnet), rel=LEARNED_ROUNDING
    )


def test_dists_is_its_formula(small_pair, vgg):
    assert dists(*small_pair, vgg) == pytest.approx(dists_twin(small_pair, vgg), abs=LEARNED_ROUNDING)


def test_equal_images_are_not_apart_order_does_not_matter_and_more_noise_is_worse(small_pair, vgg, alexnet, rng):
    image = small_pair[0]
    noise = rng.uniform(-1.0, 1.0, image.shape)
    little, much = (np.clip(image + s * noise, 0.0, 1.0) for s in (0.02, 0.3))
    for measure, weights in ((lpips, vgg), (lpips, alexnet), (dists, vgg)):
        assert measure(image, image, weights) == pytest.approx(0.0, abs=LEARNED_ROUNDING)
        assert measure(image, much, weights) == pytest.approx(measure(much, image, weights), rel=1e-4)
        assert 0.0 < measure(image, little, weights) < measure(image, much, weights)


def test_weights_that_lack_something_are_refused_with_what_to_give(small_pair, vgg):
    without = {name: value for name, value in vgg.items() if name != "lin3.model.1.weight"}
    with pytest.raises(ValueError, match=r"lack lin3\.model\.1\.weight \(they have 32 arrays.* to lin4 for LPIPS"):
        lpips(*small_pair, without)
    with pytest.raises(ValueError, match=r"lack features\.0\.weight"):
        dists(*small_pair, {})
    with pytest.raises(ValueError, match="need colour images, got grey ones; use ssim or gmsd"):
        dists(*(v[..., 0] for v in small_pair), vgg)


def test_learned_measures_are_among_the_others_where_their_weights_are(vgg, alexnet):
    a, b = (v[:176, :176] for v in image_pair())
    found = image_quality(a, b, lpips_weights=alexnet, dists_weights=vgg)
    assert found["lpips"] == lpips(a, b, alexnet)
    assert found["dists"] == dists(a, b, vgg)
    assert not {"lpips", "dists"} & image_quality(a, b).keys()
