"""Image quality: closed forms, the numbers of piq 0.8.0 for a pair of drawn images, and torchmetrics beside ours.

Those of piq were computed once, in float64 (`piq.ssim` without its downsampling), and are kept here as constants.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from image_pair import image_pair

from evaluation import fsim, gmsd, image_quality, ms_gmsd, ms_ssim, psnr, ssim, vsi
from evaluation.images.inputs import largest_rectangle

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
