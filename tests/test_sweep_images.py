"""Masks, grey images and footprints, and the images of a device against those of the host."""

from __future__ import annotations

import gc
import math
import weakref

import numpy as np
import pytest
from plane_survey import ring
from scipy import ndimage

from fields.image_store import GreyImages, LazyImages, Masks
from fields.sweep import images_device, images_host
from fields.sweep.kernels.arrays import as_numpy, flatten, floats, host
from fields.sweep.kernels.stack import PackedImages, ViewStack
from fields.sweep.maps import HeightMap
from fields.sweep.tiles import ImageTiles
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


SHAPE = (45, 70)
# Of heights of some metres in float32.
ROUNDING = 2e-6


@pytest.fixture
def height(rng) -> np.ndarray:
    """A rough bed with a step."""
    rough = ndimage.gaussian_filter(rng.normal(0.0, 0.4, SHAPE), 2.0) + rng.normal(0.0, 0.02, SHAPE)
    return (rough - 3.0 - 1.5 * (np.arange(SHAPE[1]) > 40)).astype(np.float32)


@pytest.fixture
def mask(rng) -> np.ndarray:
    """Most of the pixels, with a large hole."""
    mask = rng.random(SHAPE) < 0.7
    mask[10:30, 15:45] = False
    return mask


def there(device, image: np.ndarray):
    """An image on a device."""
    return images_device.to_device(device, image)


def test_medians_are_those_of_numpy(apart, height):
    for image in (height, height[:, 1:], height[:1, :2], -height):
        assert images_device.median(there(apart, image)) == images_host.median(image)
    assert images_device.median_above(there(apart, height), -3.0) == images_host.median_above(height, -3.0)
    for images, image in ((images_device, there(apart, height)), (images_host, height)):
        assert images.median_above(image, 100.0) is None


def test_nothing_is_known_of_an_image_of_nan(apart, height, mask):
    holes, nothing = np.where(mask, height, np.float32(np.nan)), np.full(SHAPE, np.nan, np.float32)
    assert images_device.min_max(there(apart, holes)) == images_host.min_max(holes)
    assert images_device.median_above(there(apart, holes), -math.inf) == images_host.median_above(holes, -math.inf)
    assert images_device.min_max(there(apart, nothing)) is images_host.min_max(nothing) is None


# Places among 70 pixels are good to 4e-6 px in float32, and the step has 1.5 m; filters take values that are there.
FILTERS = [
    *(("median_blur", side, 0.0) for side in (3, 5)),
    *(("local_min_max", radius, 0.0) for radius in (3, 5)),
    *(("upsample", shape, 1e-5) for shape in (SHAPE, (90, 140), (91, 139))),
    *(("masked_means", shape, 1e-5) for shape in ((11, 17), (12, 18), (15, 35))),
]


@pytest.mark.parametrize(("name", "option", "tolerance"), FILTERS)
def test_filters_are_those_of_opencv(apart, height, mask, name, option, tolerance):
    images = [height, mask] if name == "masked_means" else [height]
    found = getattr(images_device, name)(*(there(apart, each) for each in images), option)
    expected = getattr(images_host, name)(*images, option)
    pairs = zip(found, expected, strict=True) if isinstance(found, tuple) else [(found, expected)]
    for mine, other in pairs:
        np.testing.assert_allclose(as_numpy(mine), other, rtol=1e-7 if tolerance else 0.0, atol=tolerance)


def test_unknown_heights_become_those_of_the_same_pixels_as_by_opencv(apart, rng):
    for shape, share in ((SHAPE, 0.7), ((130, 60), 0.02), ((20, 300), 0.3)):
        mask = rng.random(shape) < share
        mask[shape[0] // 4 : shape[0] // 2, 10:40] = False
        # Heights that tell their pixel.
        number = np.arange(mask.size, dtype=np.float32).reshape(shape)
        found = as_numpy(images_device.fill_nearest(there(apart, number), there(apart, mask)))
        np.testing.assert_array_equal(found, images_host.fill_nearest(number, mask))


@pytest.mark.parametrize("known", [True, False])
def test_where_all_or_nothing_is_known_heights_stay(apart, height, known):
    everywhere = np.full(SHAPE, known)
    for images, image in ((images_device, there(apart, height)), (images_host, height)):
        which = there(apart, everywhere) if images is images_device else everywhere
        for found in (images.fill_nearest(image, which), images.extrapolate_planes(image, which, 0.1)):
            np.testing.assert_array_equal(as_numpy(found) if images is images_device else found, height)


def test_planes_go_on_alike(apart, mask, rng):
    rows, columns = np.indices(SHAPE)
    slope = (-2.0 - 0.03 * rows + 0.01 * columns + rng.normal(0.0, 0.01, SHAPE)).astype(np.float32)
    slope[:, 50:] += 1.0
    found = as_numpy(images_device.extrapolate_planes(there(apart, slope), there(apart, mask), 0.05))
    expected = images_host.extrapolate_planes(slope, mask, 0.05)
    assert np.count_nonzero(expected != slope) > 200
    # About as far off as the tolerance rounding decides.
    assert np.mean(np.abs(found - expected) > 2e-5) < 2e-3


@pytest.mark.parametrize("size", [8, 16])
def test_tiles_have_the_same_heights_and_ways(apart, height, mask, size):
    low, high = images_host.local_min_max(height, 3)
    arrays = [there(apart, each) for each in (mask, low, high)]
    for mine, other in zip(
        images_device.tile_extents(*arrays, size), images_host.tile_extents(mask, low, high, size), strict=True
    ):
        np.testing.assert_array_equal(mine, other)
    found = images_device.tile_gradients(there(apart, height), arrays[0], size)
    np.testing.assert_allclose(found, images_host.tile_gradients(height, mask, size), atol=2e-3)


def test_tiles_have_the_same_pixels(apart, height, mask, rng):
    low, high = images_host.local_min_max(height, 3)
    bounds = images_host.tile_extents(mask, low, high, 8)
    slope = rng.normal(0.0, 0.1, (*bounds[0].shape, 2))
    tiles = ImageTiles.of(mask, bounds, 0.1, 8, 2, slope)
    on_device = ImageTiles.of(there(apart, mask), bounds, 0.1, 8, 2, slope)
    lost = 2 * (tiles.side + 1)
    for part in (slice(0, 3), slice(5, len(tiles.counts))):
        pixels, others = (
            images.tile_indices(apart, each, part)
            for images, each in ((images_host, tiles), (images_device, on_device))
        )
        np.testing.assert_array_equal(as_numpy(others), pixels)
        np.testing.assert_array_equal(as_numpy(images_device.trim_halo(others, lost)), pixels[lost:-lost])
        starts = as_numpy(images_device.tile_starts(apart, on_device, part))
        np.testing.assert_allclose(starts, images_host.tile_starts(apart, tiles, part), atol=ROUNDING)
        own = as_numpy(images_device.own_pixels(apart, on_device, part, others, lost))
        np.testing.assert_array_equal(own, images_host.own_pixels(apart, tiles, part, pixels, lost))


def test_strips_and_pixels_are_put_where_they_belong(apart, height, rng):
    rows, columns, strip, radius = slice(7, 20), slice(12, 50), slice(10, 58), 2
    lost = radius * (strip.stop - strip.start + 1)
    result = rng.random((rows.stop - rows.start + 2 * radius) * 48 - 2 * lost).astype(np.float32)
    host, device = images_host.flat_copy(height), images_device.flat_copy(there(apart, height))
    images_host.put_strip(host, SHAPE[1], result, (rows, columns), strip, radius)
    images_device.put_strip(device, SHAPE[1], floats(apart, result), (rows, columns), strip, radius)
    np.testing.assert_array_equal(as_numpy(device), host)
    part = rows, columns
    np.testing.assert_array_equal(as_numpy(images_device.crop(there(apart, height), part)), height[part].ravel())
    places = images_device.strip_indices(apart, part, SHAPE[1])
    np.testing.assert_array_equal(as_numpy(places), images_host.strip_indices(apart, part, SHAPE[1]))
    wanted = height[part].ravel() > -3.0
    values = np.ones(wanted.size, dtype=np.float32)
    images_host.put(host, images_host.strip_indices(apart, part, SHAPE[1]), values, wanted)
    images_device.put(device, places, floats(apart, values), flatten(there(apart, wanted)))
    np.testing.assert_array_equal(as_numpy(device), host)


def test_what_is_copied_is_written_to_alone(apart, height):
    image = there(apart, height)
    flat = images_device.flat_copy(image)
    images_device.put(flat, images_device.indices_of(image < -3.0), flatten(images_device.full(apart, (1, 1), 9.0)))
    assert (as_numpy(flat).reshape(SHAPE) == np.where(height < -3.0, 9.0, height)).all()
    np.testing.assert_array_equal(as_numpy(image), height)


def test_heights_that_agree_are_averaged_alike(apart, rng):
    own, total = (rng.normal(0.0, 0.1, SHAPE).astype(np.float32) for _ in range(2))
    count = rng.integers(0, 5, SHAPE).astype(np.float32)
    sums = [count, total, total * total + 0.01]
    expected = images_host.agreement_statistics(own, sums, SHAPE)
    found = images_device.agreement_statistics(*(floats(apart, own), [floats(apart, each) for each in sums], SHAPE))
    for mine, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(as_numpy(mine), other, atol=1e-6)


def test_parts_that_are_first_shown_are_alike(apart, height, mask, rng):
    holes, before = np.where(mask, height, np.float32(np.nan)), rng.integers(0, 2, SHAPE).astype(np.float32)
    for others in (None, before):
        against = None if others is None else floats(apart, others)
        there_ = images_device.newly_visible(apart, there(apart, holes), against)
        expected = np.isfinite(holes) & (True if others is None else others == 0.0)
        np.testing.assert_array_equal(there_, ndimage.binary_dilation(expected, np.ones((3, 3))))


def test_maps_come_back_as_they_were(apart, height, rng):
    m = HeightMap(
        3, height, rng.random(SHAPE).astype(np.float16), rng.integers(0, 9, SHAPE).astype(np.uint8),
        rng.random(SHAPE).astype(np.float16),
    )  # fmt: skip
    back = images_device.download(images_device.upload(apart, m))
    for name in ("height", "score", "agreeing", "spread"):
        found, expected = getattr(back, name), getattr(m, name)
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)
