"""Features of photographs: where pycolmap finds them, in pixels of the stored photograph, the largest first."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial import cKDTree

from survey.errors import ImageError
from survey.sfm.features import features_of, mutual_matches


def texture(path: Path, rng: np.random.Generator, size: tuple[int, int] = (240, 320)) -> np.ndarray:
    """Noise of several scales, as a PNG."""
    layers = [cv2.GaussianBlur(rng.normal(0.0, 1.0, size), (0, 0), sigma) * sigma for sigma in (1.2, 3.0, 8.0)]
    pixels = np.clip(128.0 + 40.0 * sum(layers), 0.0, 255.0).astype(np.uint8)
    cv2.imwrite(str(path), pixels)
    return pixels


def test_features_lie_where_pycolmap_finds_them_and_look_alike(tmp_path, rng):
    pixels = texture(tmp_path / "a.png", rng)
    ours, descriptors = features_of(tmp_path / "a.png", 4096)
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, 1
    pycolmap.logging.minloglevel = 2
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    found, _ = extractor.extract_from_float32_array(pixels.astype(np.float32) / 255.0)
    theirs = np.array([[each.x, each.y] for each in found])
    away, nearest = cKDTree(theirs).query(ours[:, :2])
    same = away < 0.5
    assert same.mean() > 0.9
    np.testing.assert_allclose(np.median((ours[:, :2] - theirs[nearest])[same], axis=0), 0.0, atol=0.02)
    lengths = np.linalg.norm(descriptors.astype(np.float64), axis=1)
    # Roots of shares that sum to one, in steps of a 512th.
    np.testing.assert_allclose(lengths, 512.0, atol=8.0)


def test_the_largest_features_are_kept_and_come_first(tmp_path, rng):
    texture(tmp_path / "a.png", rng)
    every, _ = features_of(tmp_path / "a.png", 60)
    few, descriptors = features_of(tmp_path / "a.png", 50)
    assert len(few) == len(descriptors) == 50
    assert (np.diff(every[:, 2]) <= 0.0).all()
    np.testing.assert_array_equal(few, every[:50])


def test_a_photograph_with_too_few_features_at_half_its_size_is_searched_whole(tmp_path, rng):
    texture(tmp_path / "a.png", rng)
    (few, _), (every, _) = (features_of(tmp_path / "a.png", most) for most in (50, 4096))
    # The smallest feature has a radius of 1.6 px times the square root of 1.6 of the doubled image.
    assert every[:, 2].min() < 1.2
    assert len(every) > 300
    assert few[:, 2].min() > every[:, 2].min()


def test_features_of_a_large_photograph_are_in_its_own_pixels(tmp_path):
    # Its height, reduced, is no whole number of pixels: 203 * 0.8 = 162.4.
    rows, columns = np.mgrid[0:203, 0:4000]
    places = np.array([[300.0, 60.0], [1700.0, 120.0], [3500.0, 165.0]])
    spots = sum(np.exp(-((columns + 0.5 - x) ** 2 + (rows + 0.5 - y) ** 2) / (2 * 9.0**2)) for x, y in places)
    cv2.imwrite(str(tmp_path / "wide.png"), (40.0 + 160.0 * spots).astype(np.uint8))
    found, _ = features_of(tmp_path / "wide.png", 100)
    away, _ = cKDTree(found[:, :2]).query(places)
    assert away.max() < 0.2


def test_a_photograph_without_texture_has_no_features(tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((60, 80), 120, np.uint8))
    keypoints, descriptors = features_of(tmp_path / "grey.png", 100)
    assert keypoints.shape == (0, 4)
    assert descriptors.shape == (0, 128)


def test_what_is_no_image_is_refused(tmp_path):
    (tmp_path / "a.jpg").write_text("no image")
    with pytest.raises(ImageError, match=r"a\.jpg"):
        features_of(tmp_path / "a.jpg", 100)


def descriptors_of(rng, num: int) -> np.ndarray:
    """Descriptors (num, 128) uint8 of length 512."""
    return of_length(rng.gamma(0.4, size=(num, 128)))


def of_length(values: np.ndarray) -> np.ndarray:
    """Descriptors of any length as bytes, their length 512."""
    values = np.maximum(values, 0.0)
    return np.rint(512.0 * values / np.linalg.norm(values, axis=1, keepdims=True)).clip(0, 255).astype(np.uint8)


def test_matches_are_nearest_to_each_other_and_clearly_nearer_than_any_second(rng):
    one = descriptors_of(rng, 40)
    # Feature 3 has two that are as near, so that none is clear.
    same = of_length(one[[3, 3]] + rng.normal(0.0, 15.0, (2, 128)))
    other = np.concatenate([one[[7]], same[:1], one[[21]], same[1:], descriptors_of(rng, 30)])
    assert mutual_matches(one, other).tolist() == [[7, 0], [21, 2]]
    assert mutual_matches(other, one).tolist() == [[0, 7], [2, 21]]
    assert mutual_matches(one[:0], other).shape == mutual_matches(one, other[:0]).shape == (0, 2)


def test_matches_are_those_of_every_angle_written_out(rng):
    one = descriptors_of(rng, 200)
    other = of_length(one[rng.permutation(200)[:150]] + rng.normal(0.0, rng.uniform(2.0, 80.0, (150, 1)), (150, 128)))
    angles = np.arccos(np.minimum(one.astype(np.float64) @ other.T / 512.0**2, 1.0))
    expected = []
    for i, row in enumerate(angles):
        j = int(row.argmin())
        column = angles[:, j]
        seconds = np.partition(row, 1)[1], np.partition(column, 1)[1]
        if column.argmin() == i and row[j] <= 0.7 and row[j] < 0.8 * min(seconds):
            expected.append([i, j])
    assert 50 < len(expected) < 150
    assert mutual_matches(one, other).tolist() == expected
