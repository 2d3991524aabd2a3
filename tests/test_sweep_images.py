"""Images between the kernels of the sweep, medians, and planes through heights."""

import gc
import weakref

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, ring
from scipy import ndimage

from fields.image_store import GreyImages, LazyImages, Masks
from fields.sweep import fusion
from fields.sweep.images import (
    SIDE_PX,
    extrapolate_planes,
    fill_nearest,
    median,
    newly_visible,
    put_strip,
    slope_of,
    steep_and_wall_pixels,
    strip_indices,
)
from fields.sweep.kernels.arrays import host
from fields.sweep.kernels.stack import PackedImages, ViewStack
from fields.sweep.maps import HeightMap
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
    assert len(host(device, stack.pixels(1))) == shape[0] * shape[1]
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
    for view, (found, image) in enumerate(zip(greys, images, strict=True)):
        np.testing.assert_array_equal(greys.window(view, np.s_[1:6], np.s_[3:7]), image[1:6, 3:7])
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
    first = np.asarray(packed.values(0))
    assert not np.array_equal(first, np.asarray(packed.values(1)))
    np.testing.assert_array_equal(np.asarray(packed.values(0)), first)


SHAPE = (45, 70)


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


@pytest.mark.parametrize("share", [0.7, 0.02])
def test_unknown_heights_become_that_of_the_nearest_known_pixel(rng, share):
    mask = rng.random(SHAPE) < share
    row, column = np.indices(SHAPE)
    # Heights that tell their pixel.
    number = np.arange(mask.size, dtype=np.float32).reshape(SHAPE)
    found = fill_nearest(number, mask).astype(int)
    assert mask.ravel()[found].all()
    np.testing.assert_array_equal(found[mask], number[mask])
    distance = np.hypot(row - found // SHAPE[1], column - found % SHAPE[1])
    # OpenCV's steps, 1, 1.4 and 2.1969 px long, are off by 2 %.
    np.testing.assert_array_less(distance, 1.05 * ndimage.distance_transform_edt(~mask) + 1e-6)


@pytest.mark.parametrize("known", [True, False])
def test_where_all_or_nothing_is_known_heights_stay(height, known):
    np.testing.assert_array_equal(fill_nearest(height, np.full(SHAPE, known)), height)


def test_a_strip_is_put_where_it_belongs(height, rng):
    rows, columns, strip, radius = slice(7, 20), slice(12, 50), slice(10, 58), 2
    wide = rng.random((rows.stop - rows.start + 2 * radius, strip.stop - strip.start)).astype(np.float32)
    lost = radius * (wide.shape[1] + 1)
    target = height.flatten()
    put_strip(target, SHAPE[1], wide.ravel()[lost:-lost], (rows, columns), strip, radius)
    expected = height.copy()
    expected[rows, columns] = wide[radius:-radius, columns.start - strip.start : columns.stop - strip.start]
    np.testing.assert_array_equal(target.reshape(SHAPE), expected)
    np.testing.assert_array_equal(target[strip_indices((rows, columns), SHAPE[1])], expected[rows, columns].ravel())


def test_parts_that_are_first_shown_are_those_that_no_steeper_view_agrees_with(height, mask, rng):
    holes, before = np.where(mask, height, np.float32(np.nan)), rng.integers(0, 2, SHAPE).astype(np.float32)
    for others in (None, before):
        expected = np.isfinite(holes) & (True if others is None else others == 0.0)
        found = newly_visible(holes, None if others is None else others.ravel())
        np.testing.assert_array_equal(found, ndimage.binary_dilation(expected, np.ones((3, 3))))


@pytest.mark.parametrize("shape", [(1,), (2,), (7, 9), (8, 9)])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_it_is_that_of_numpy_and_the_values_stay_in_their_order(shape, kind, rng):
    values = rng.normal(size=shape).astype(kind)
    before = values.copy()
    assert median(values) == float(np.median(before))
    np.testing.assert_array_equal(values, before)


@pytest.mark.parametrize("count", [4, 5])
def test_it_is_nan_where_a_value_is(count, rng):
    values = rng.normal(size=count)
    values[1] = np.nan
    assert np.isnan(median(values))


def test_no_values_are_refused():
    with pytest.raises(ValueError, match="no values"):
        median(np.empty((0, 3)))


# Of heights of some metres in float32.
ROUNDING_M = 2e-6
TOLERANCE_M = 0.02
# More rows than are worked out together.
SHAPE_PLANES = (150, 40)


@pytest.fixture
def slope() -> np.ndarray:
    """A bed that falls by three centimetres from row to row."""
    rows, columns = np.indices(SHAPE_PLANES)
    return (-2.0 - 0.03 * rows + 0.01 * columns).astype(np.float32)


def test_unknown_heights_on_a_slope_are_those_of_the_slope(slope, rng):
    known = rng.random(SHAPE_PLANES) < 0.6
    wrong = np.where(known, slope, slope + rng.normal(0.0, 0.5, SHAPE_PLANES)).astype(np.float32)
    np.testing.assert_allclose(extrapolate_planes(wrong, known, TOLERANCE_M), slope, atol=ROUNDING_M)


def test_the_plane_is_that_of_least_squares(slope, rng):
    known, noisy = rng.random(SHAPE_PLANES) < 0.5, (slope + rng.normal(0.0, 0.005, SHAPE_PLANES)).astype(np.float32)
    known[64, 20] = False
    found, half = extrapolate_planes(noisy, known, TOLERANCE_M), SIDE_PX // 2
    rows, columns = np.nonzero(known[64 - half : 64 + half + 1, 20 - half : 20 + half + 1])
    ones = np.stack([np.ones(len(rows)), rows - half, columns - half], axis=-1)
    expected = np.linalg.lstsq(ones, noisy[64 - half + rows, 20 - half + columns].astype(np.float64))[0][0]
    assert found[64, 20] == pytest.approx(expected, abs=ROUNDING_M)


def test_beside_a_step_nothing_is_changed(slope, rng):
    known, stepped = rng.random(SHAPE_PLANES) < 0.6, slope.copy()
    stepped[:, 20:] += 0.5
    found, beside = extrapolate_planes(stepped, known, TOLERANCE_M), slice(18, 23)
    np.testing.assert_array_equal(found[:, beside], stepped[:, beside])


@pytest.mark.parametrize("where", [np.s_[75:76, 20:21], np.s_[75:76, :], np.s_[:, 20:21], np.s_[:0]])
def test_a_few_known_heights_or_a_line_of_them_are_no_plane(slope, where):
    known = np.zeros(SHAPE_PLANES, dtype=bool)
    known[where] = True
    np.testing.assert_array_equal(extrapolate_planes(slope, known, TOLERANCE_M), slope)


def test_heights_that_are_not_trusted_begin_the_next_pass_on_the_plane_of_those_around(device):
    bed, cameras = PlaneBed(TILTED, -2.0, slope=0.1), ring(3)
    block = bed.block(device, cameras, None)
    off = np.s_[30:37, 40:47]

    def fused(is_intermediate: bool) -> np.ndarray:
        maps = {}
        for view, camera in enumerate(cameras):
            height = bed.true_height(camera).astype(np.float32)
            nobody = np.zeros(height.shape, dtype=np.uint8)
            if view == 0:
                height[off] += 1.0
            m = HeightMap(view, height, np.ones(height.shape, np.float16), nobody, nobody.astype(np.float16))
            maps[view] = m
        peers = {view: fusion.ComparedViews([other for other in maps if other != view]) for view in maps}
        fused = fusion.fuse(block, maps, 1.0, peers, is_intermediate=is_intermediate)[0]
        return fused.height[off]

    truth = bed.true_height(cameras[0])[off]
    # True heights of a tilted plane are those of one in the image but for perspective.
    np.testing.assert_allclose(fused(is_intermediate=True), truth, atol=1e-3)
    assert (np.abs(fused(is_intermediate=False) - truth) > 0.5).any()


@pytest.mark.parametrize("height", [0.0, -300.0])
def test_the_slope_of_a_plane_is_its_rise_from_pixel_to_pixel(height):
    rows, columns = np.mgrid[:20, :30]
    plane = (height + 0.03 * rows - 0.04 * columns).astype(np.float32)
    inner = np.s_[1:-1, 1:-1]
    np.testing.assert_allclose(slope_of(plane)[inner], 0.05, atol=1e-4)


def test_a_wall_is_steep_and_plane_and_an_edge_is_not_plane():
    wall = np.repeat((0.3 * np.clip(np.arange(30) - 10, 0, 9)).astype(np.float32)[None], 20, axis=0)
    found = steep_and_wall_pixels(wall, 0.1)[1][10]
    assert found[12:18].all()
    assert not found[:10].any()
    assert not found[21:].any()
    edge = np.where(np.arange(30) < 15, 0.0, 2.0).astype(np.float32)[None].repeat(20, axis=0)
    steep, walls = steep_and_wall_pixels(edge, 0.1)
    assert steep[10, 14:16].all()
    assert not steep[10, :13].any()
    assert not walls.any()
