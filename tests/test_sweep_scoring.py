"""Scores of warped images and the best height among hypotheses, in Dr.Jit and in torch, against slow references."""

from dataclasses import replace

import numpy as np
import pytest
from plane_survey import buffers_of, held_in, windows_of

from fields.sweep.kernels import drjit_kernels
from fields.sweep.kernels.arrays import ALIGNED_BYTES, Buffer, floats, host
from fields.sweep.matching import kernels

EPS32 = np.finfo(np.float32).eps
# Sums of up to 49 products of grey levels in float32, less the product of their means; measured 2.5e-7.
SCORE = 1e-6
NOWHERE = -1.0


def slow_ncc(reference: np.ndarray, image: np.ndarray, radius: int) -> np.ndarray:
    """NCC over windows by loops in float64, with the noise floor; -1 in the halo and where NaN is in the window."""
    result = np.full(image.shape, NOWHERE)
    for row in range(radius, image.shape[0] - radius):
        for column in range(radius, image.shape[1] - radius):
            window = np.s_[row - radius : row + radius + 1, column - radius : column + radius + 1]
            i, w = reference[window].astype(np.float64), image[window].astype(np.float64)
            if np.isfinite(i).all() and np.isfinite(w).all():
                scale = max(i.var(), 1.0) * max(w.var(), 1.0)
                result[row, column] = max(((i - i.mean()) * (w - w.mean())).mean() / np.sqrt(scale), -0.999)
    return result


def ncc_of(device, reference: np.ndarray, images: np.ndarray, radius: int, least_known: float = 1.0) -> np.ndarray:
    """NCC of images (count, height, width); `NOWHERE` before the first whole window and after the last."""
    windows = windows_of(device, reference, [images], reference.shape[1], radius)
    (score,) = kernels(device).ncc(windows, radius, least_known)
    lost = radius * (reference.shape[1] + 1)
    return np.pad(host(device, score), lost, constant_values=NOWHERE).reshape(images.shape)


@pytest.mark.parametrize("device", ["cpu"], indirect=True)
@pytest.mark.parametrize("size", [1, 15, 16, 4096, 70_001])
def test_behind_a_room_there_is_memory_for_the_last_vector_of_a_view(device, size):
    room = Buffer.of(device, size)
    # The last vector of a view that ends where the room does begins at its last number at the latest.
    assert room.memory.nbytes >= 4 * (size - 1) + ALIGNED_BYTES
    (copy,) = buffers_of(device, [np.arange(size, dtype=np.float32)])
    # Waits for the kernel that fills it.
    assert (held_in(device, copy, size) == np.arange(size)).all()
    assert (copy.memory[:size] == np.arange(size)).all()


@pytest.mark.parametrize("device", ["cpu"], indirect=True)
@pytest.mark.parametrize("radius", [1, 3])
def test_windows_that_cuda_gathers_are_those_that_a_processor_reads_in_its_memory(device, rng, radius):
    reference, *images = rng.normal(0.0, 40.0, (3, 14, 17)).astype(np.float32)
    as_cuda = replace(device, name="cuda")
    assert Buffer.of(as_cuda, 4).memory is None
    found = [ncc_of(each, reference, np.stack(images), radius) for each in (device, as_cuda)]
    np.testing.assert_allclose(*found, atol=SCORE)


@pytest.mark.parametrize("radius", [1, 2, 3, 5])
def test_ncc_agrees_with_a_slow_twin_where_windows_are_whole(device, rng, radius):
    reference = rng.normal(0.0, 40.0, (14, 17)).astype(np.float32)
    noise = rng.normal(0.0, 40.0, (3, *reference.shape))
    images = np.float32(
        [reference + noise[0], -0.5 * reference + noise[1], np.where(noise[2] > 70.0, np.nan, noise[2])]
    )
    found = ncc_of(device, reference, images, radius)
    inner = np.s_[:, radius:-radius, radius:-radius]
    slow = np.stack([slow_ncc(reference, image, radius) for image in images])
    assert (slow[2][inner[1:]] == NOWHERE).any()
    np.testing.assert_allclose(found[inner], slow[inner], atol=SCORE)
    np.testing.assert_array_equal(found[inner] == NOWHERE, slow[inner] == NOWHERE)


def test_windows_of_which_enough_is_known_are_compared_over_what_both_have(device, rng):
    reference, image = rng.normal(0.0, 40.0, (2, 14, 17)).astype(np.float32)
    image += reference
    for each in (reference, image):
        each[rng.random(each.shape) < 0.25] = np.nan
    found, compared = ncc_of(device, reference, image[None], 2, 0.5)[0], 0
    for row in range(2, 12):
        for column in range(2, 15):
            window = np.s_[row - 2 : row + 3, column - 2 : column + 3]
            known = np.isfinite(reference[window]) & np.isfinite(image[window])
            if known.sum() < 12.5:
                assert found[row, column] == NOWHERE
                continue
            i, w = (each[window][known].astype(np.float64) for each in (reference, image))
            assert abs(found[row, column] - np.corrcoef(i, w)[0, 1]) < 3 * SCORE
            compared += 1
    assert 0 < compared < 130


def test_ncc_does_not_see_gain_and_offset_and_marks_windows_with_masked_pixels(device, rng):
    reference = rng.normal(0.0, 40.0, (9, 11)).astype(np.float32)
    inner = np.s_[1:-1, 1:-1]
    found = ncc_of(device, reference, np.float32([0.4 * reference + 30.0, -2.0 * reference]), 1)
    # A mean of 30 in the image adds its rounding; measured 1.5e-6.
    np.testing.assert_allclose(found[0][inner], 1.0, atol=3 * SCORE)
    np.testing.assert_allclose(found[1][inner], -0.999, atol=3 * SCORE)
    masked = reference.copy()
    masked[4, 5] = np.nan
    found = ncc_of(device, masked, reference[None], 1)[0][inner]
    expected = np.zeros(found.shape, dtype=bool)
    expected[2:5, 3:6] = True
    np.testing.assert_array_equal(found == NOWHERE, expected)


def test_windows_without_texture_score_near_zero(device, rng):
    grey = np.full((12, 13), 97.0, np.float32)
    images = np.float32([grey, grey + rng.normal(0.0, 0.1, grey.shape), rng.normal(0.0, 40.0, grey.shape)])
    # The mean of 25 squares of 97 rounds by 1e-3 grey levels squared in float32, against a floor of 1.
    assert np.abs(ncc_of(device, grey, images, 2)[:, 2:-2, 2:-2]).max() < 2e-3


def slow_best_half(score: np.ndarray) -> np.ndarray:
    """Mean over the better half (rounded up, at least two) of the scores above -1, by sorting each column."""
    means = []
    for column in score.T:
        seen = sorted((s for s in column if s > NOWHERE), reverse=True)
        half = seen[: max((len(seen) + 1) // 2, min(len(seen), 2))]
        means.append(np.mean(half) if half else NOWHERE)
    return np.array(means)


@pytest.mark.parametrize("neighbours", [1, 2, 3, 4, 7, 8])
def test_best_half_agrees_with_a_slow_twin_whoever_sees_the_window(device, rng, neighbours):
    score = rng.uniform(-0.999, 1.0, (neighbours, 400)).astype(np.float32)
    score[rng.uniform(size=score.shape) < rng.uniform(0.0, 1.2, 400)] = NOWHERE
    assert (score == NOWHERE).all(axis=0).any()
    assert (score > NOWHERE).all(axis=0).any()
    found = host(device, kernels(device).best_half(device, [floats(device, s) for s in score]))
    np.testing.assert_allclose(found, slow_best_half(score), atol=4 * EPS32)


def best_heights(device, hypotheses: np.ndarray, start: np.ndarray, step: float):
    found = kernels(device).best_height(
        device, floats(device, hypotheses), floats(device, start), step, len(hypotheses)
    )
    return [host(device, array) for array in found]


def test_best_height_finds_the_top_of_a_parabola(device, rng):
    step, bend, start = 0.1, 3.0, rng.uniform(-3.0, 3.0, 200)
    top = start + rng.uniform(1.1, 6.9, 200) * step  # on a hypotheses of nine, away from its ends
    heights = start + step * np.arange(9)[:, None]
    height, best, curvature = best_heights(device, 0.9 - bend * (heights - top) ** 2, start, step)
    # The scores round by EPS32; their second difference is 0.06.
    np.testing.assert_allclose(height, top, atol=8 * EPS32 / 0.06)
    np.testing.assert_allclose(curvature, 2.0 * bend, rtol=16 * EPS32 / 0.06)
    np.testing.assert_allclose(best, 0.9 - bend * (np.round((top - start) / step) * step + start - top) ** 2, atol=1e-6)


def test_no_best_height_is_trusted_at_the_end_of_the_range(device):
    hypotheses = np.array([[0.1, 0.9, NOWHERE], [0.2, 0.5, NOWHERE], [0.6, 0.2, NOWHERE], [0.8, 0.1, NOWHERE]])
    height, best, curvature = best_heights(device, hypotheses, np.zeros(3), 0.5)
    np.testing.assert_allclose(height, [1.5, 0.0, 0.0])
    np.testing.assert_allclose(best, [0.8, 0.9, NOWHERE], rtol=EPS32)
    np.testing.assert_array_equal(curvature, 0.0)


def test_the_first_of_equal_scores_is_taken_and_left_by_half_a_step_at_most(device):
    hypotheses = np.array([[0.0, NOWHERE], [0.7, 0.5], [0.7, 0.6], [0.0, 0.59]])
    height, _, _ = best_heights(device, hypotheses, np.zeros(2), 1.0)
    assert height[0] == 1.5
    assert 1.5 <= height[1] <= 2.5


@pytest.mark.parametrize("device", ["cpu"], indirect=True)
@pytest.mark.parametrize("radius", [1, 2])
@pytest.mark.parametrize("least_known", [1.0, 0.5])
def test_sums_by_rows_are_those_of_whole_windows(device, rng, monkeypatch, radius, least_known):
    reference, *images = rng.normal(0.0, 40.0, (3, 14, 17)).astype(np.float32)
    images[0][rng.random(reference.shape) < 0.05] = np.nan
    at_once = ncc_of(device, reference, np.array(images), radius, least_known)
    monkeypatch.setattr(drjit_kernels, "_WIDEST_AT_ONCE", 0)
    by_rows = ncc_of(device, reference, np.array(images), radius, least_known)
    if least_known == 1.0:
        # The same additions in the same order.
        assert (at_once == by_rows).all()
    else:
        np.testing.assert_allclose(at_once, by_rows, atol=SCORE)
