"""What the sweep keeps of many images in little memory: masks, images made when they are read, maps in an order."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from plane_survey import ring

from fields.image_store import GreyImages, LazyImages, Masks
from fields.sweep.kernels.arrays import host
from fields.sweep.kernels.stack import PackedImages, ViewStack
from fields.sweep.views import Footprint


def test_masks_come_back_as_they_were_and_take_more(rng):
    first, second = rng.random((2, 5, 7)) < 0.5
    masks = Masks([(5, 7), (5, 7)])
    assert not masks[0].any()
    masks[1] = first
    masks.add(1, second.ravel())
    np.testing.assert_array_equal(masks[1], first | second)
    copy = masks.copy()
    copy.add(0, np.ones((5, 7), dtype=bool))
    assert copy[0].all()
    assert not masks[0].any()
    assert len(list(masks)) == 2


def test_images_are_made_once_while_they_are_kept():
    made = []

    def make(number: int) -> np.ndarray:
        made.append(number)
        return np.full((2, 3), number, dtype=np.float32)

    images = LazyImages(make, 3, (2, 3), 2)
    assert [images[n][0, 0] for n in (0, 1, 0, 2, 0, 1)] == [0, 1, 0, 2, 0, 1]
    assert made == [0, 1, 2, 1]
    with pytest.raises(IndexError, match="3 images, got number 3"):
        images[3]


@pytest.mark.parametrize("step", [1.0, 0.3])
def test_a_part_of_a_grey_image_is_what_the_whole_has_there(rng, step):
    image = step * rng.integers(-100, 100, (9, 21)).astype(np.float32)
    image[rng.random(image.shape) < 0.3] = np.nan
    greys, part = GreyImages([image, image]), np.s_[2:7, 3:14]
    np.testing.assert_array_equal(greys.window(1, *part), image[part])
    np.testing.assert_array_equal(greys[1], image)


def test_greys_of_several_sizes_are_refused():
    with pytest.raises(ValueError, match="of one size"):
        GreyImages([np.zeros((2, 3)), np.zeros((3, 2))])


def test_footprints_that_have_no_ground_in_common_do_not_meet():
    here = Footprint(np.zeros(2), np.ones(2))
    assert here.meets(Footprint(np.full(2, 0.5), np.full(2, 2.0)))
    assert not here.meets(Footprint(np.array([0.0, 1.5]), np.array([1.0, 2.0])))
    assert here.meets(Footprint(np.full(2, -np.inf), np.full(2, np.inf)))


def test_a_stack_that_is_no_longer_used_gives_its_images_back_at_once(device):
    cameras = ring(2)
    shape = (cameras[0].height, cameras[0].width)
    stack = ViewStack.build(device, cameras, LazyImages(lambda _number: np.zeros(shape, np.float32), 3, shape), None)
    assert len(host(device, stack.pixels[1])) == shape[0] * shape[1]
    gone = weakref.ref(stack)
    gc.disable()
    try:
        del stack
        assert gone() is None
    finally:
        gc.enable()


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


def test_an_image_that_is_read_cannot_be_written_to(rng):
    with pytest.raises(ValueError, match="read-only"):
        GreyImages([levels(rng, masked=False, fractions=False)])[0][0, 0] = 1.0


def test_packed_images_are_the_same_when_they_are_made_again(device, rng):
    images = [levels(rng, masked=False, fractions=False) for _ in range(3)]
    packed = PackedImages.build(device, images, kept=1)
    first = np.asarray(packed.values[0])
    assert not np.array_equal(first, np.asarray(packed.values[1]))
    np.testing.assert_array_equal(np.asarray(packed.values[0]), first)
