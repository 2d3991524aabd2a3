"""Grey images in little memory come back as they were, and what is made anew is the same."""

from __future__ import annotations

import numpy as np
import pytest

from fields.image_store import GreyImages
from fields.sweep.kernels.stack import PackedImages


def levels(rng, *, masked: bool, fractions: bool) -> np.ndarray:
    image = rng.integers(-128, 128, (7, 9)).astype(np.float32)
    image += 0.25 if fractions else 0.0
    if masked:
        image[2:4, 3] = np.nan
    return image


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("fractions", [False, True])
def test_images_come_back_as_they_were(rng, masked, fractions):
    images = [levels(rng, masked=masked, fractions=fractions) for _ in range(30)]
    greys = GreyImages(iter(images))
    assert len(greys) == 30
    for found, image in zip(greys, images, strict=True):
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, image)
    np.testing.assert_array_equal(greys[0], images[0])  # read again after more than are kept
    assert greys.are_unmasked is not masked


def test_whole_levels_take_a_byte_each(rng):
    greys = GreyImages([levels(rng, masked=True, fractions=False)])
    assert greys._kept[0].levels.nbytes == 7 * 9


def test_an_image_that_is_read_cannot_be_written_to(rng):
    with pytest.raises(ValueError, match="read-only"):
        GreyImages([levels(rng, masked=False, fractions=False)])[0][0, 0] = 1.0


def test_packed_images_are_the_same_when_they_are_made_again(device, rng):
    images = [levels(rng, masked=False, fractions=False) for _ in range(3)]
    packed = PackedImages.build(device, images, kept=1)
    first = np.asarray(packed.values[0])
    assert not np.array_equal(first, np.asarray(packed.values[1]))
    np.testing.assert_array_equal(np.asarray(packed.values[0]), first)
