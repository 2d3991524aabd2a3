"""Measures of images: against another library, their definitions, and on masks."""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from evaluation import image_quality, psnr, ssim
from evaluation.images import largest_rectangle

# Sums of 1e5 terms in another order.
ROUNDING = 1e-12
# SSIM of the pair by piq 0.8.
PIQ_SSIM = 0.7470858759967814


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray]:
    """An image (H, W, 3), 0 to 1, of waves and edges, and the same blurred, noisy and faded."""
    height, width = 256, 320
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    waves = [np.sin(x / p + y / q) for p, q in ((7.0, 23.0), (31.0, -11.0), (3.0, 5.0))]
    disc = (np.hypot(x - 0.4 * width, y - 0.55 * height) < 0.2 * height).astype(np.float64)
    bars = ((x // 24) % 2) * (y > 0.7 * height)
    layers = [0.5 + 0.16 * waves[i] + 0.14 * waves[(i + 1) % 3] * disc + 0.12 * (i - 1) * disc for i in range(3)]
    image = np.clip(np.stack(layers, axis=-1) + 0.15 * bars[..., None], 0.0, 1.0)
    # Noise from whole numbers, equal to the last bit everywhere.
    noise = ((x * 73 + y * 179 + x * y * 31) % 256 / 255.0 - 0.5)[..., None] * np.array([0.10, 0.08, 0.12])
    blurred = ndimage.gaussian_filter(image, (1.2, 1.2, 0.0))
    return image, np.clip(0.9 * blurred + 0.03 + noise, 0.0, 1.0)


def test_psnr_is_that_of_its_definition():
    a = np.full((8, 8), 0.5)
    assert psnr(a, a + 0.1) == pytest.approx(20.0)


@pytest.mark.filterwarnings("ignore")
def test_psnr_and_ssim_are_those_of_other_libraries(pair):
    """The mean of torchmetrics is over windows beyond the rim too, where it mirrors the image: the rim is cut off."""
    assert ssim(*pair) == pytest.approx(PIQ_SSIM, abs=ROUNDING)
    torchmetrics = pytest.importorskip("torchmetrics.functional.image", reason="torchmetrics is not installed")
    tensors = [torch.from_numpy(v.transpose(2, 0, 1).copy())[None] for v in pair]
    # Its sum is of float32 squares.
    assert psnr(*pair) == pytest.approx(float(torchmetrics.peak_signal_noise_ratio(*tensors, data_range=1.0)), abs=3e-6)
    _, similarity = torchmetrics.structural_similarity_index_measure(*tensors, data_range=1.0, return_full_image=True)
    assert ssim(*pair) == pytest.approx(float(similarity[..., 5:-5, 5:-5].mean()), abs=ROUNDING)


def test_equal_images_are_alike_order_does_not_matter_and_more_noise_is_worse(pair, rng):
    image = pair[0]
    assert image_quality(image, image) == pytest.approx({"psnr_db": math.inf, "ssim": 1.0}, abs=ROUNDING)
    noise = rng.uniform(-1.0, 1.0, image.shape)
    little, much = (np.clip(image + s * noise, 0.0, 1.0) for s in (0.02, 0.2))
    for measure in (ssim, psnr):
        assert measure(image, much) == pytest.approx(measure(much, image), rel=1e-9)
        assert measure(image, little) > measure(image, much)


def test_ssim_of_two_flat_images_is_its_luminance():
    a, b = np.full((20, 20), 0.3), np.full((20, 20), 0.6)
    assert ssim(a, b) == pytest.approx((2 * 0.18 + 1e-4) / (0.45 + 1e-4), abs=ROUNDING)


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
    assert found["ssim"] == ssim(pair[0][rows, columns], pair[1][rows, columns])
    errors = (pair[0] - pair[1])[mask]
    assert found["psnr_db"] == pytest.approx(-10.0 * np.log10(np.mean(errors**2)), abs=ROUNDING)
    narrow = np.zeros_like(mask)
    narrow[:, :10] = True
    assert image_quality(*pair, mask=narrow).keys() == {"psnr_db"}
    with pytest.raises(ValueError, match=r"expected a mask \(256, 320\) with pixels, got \(256, 320\) with 0"):
        image_quality(*pair, mask=np.zeros_like(mask))
    with pytest.raises(ValueError, match=r"expected a mask \(256, 320\) with pixels, got \(3, 3\)"):
        psnr(*pair, np.ones((3, 3), dtype=bool))
