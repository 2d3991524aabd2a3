"""Pixels with the depth of their file: 16 bits without a loss, transparency, orientation, pages, HEIC, masks."""

import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from refract.lens import Lens
from survey.errors import ImageError
from survey.photos.cameras import View
from survey.photos.exif import read_exif
from survey.photos.images import ImageStore, load_image, load_mask, load_pixels, read_mask
from survey.photos.pixels import read_rgb

LENS = Lens("PINHOLE", (100.0, 100.0, 32.0, 24.0), 64, 48)


def view_of(path) -> View:
    return View(path.name, path, LENS.camera(np.zeros(3), np.diag([1.0, -1.0, -1.0])), LENS)


@pytest.fixture
def deep(rng) -> np.ndarray:
    return rng.integers(0, 65536, (48, 64, 3), dtype=np.uint16)


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_sixteen_bits_of_colour_are_read_whole(tmp_path, deep, name):
    path = tmp_path / name
    cv2.imwrite(str(path), deep[:, :, ::-1])
    assert read_exif(path).bits == 16
    np.testing.assert_array_equal(read_rgb(path), deep)
    # Colours have 8 bits, rounded; Pillow would have cut the last 8.
    colours = load_image(view_of(path))
    np.testing.assert_array_equal(colours, np.rint(deep / 257.0))
    assert colours.dtype == np.uint8


def test_tiles_and_compression_make_no_difference(tmp_path, deep):
    rasterio = pytest.importorskip("rasterio")
    path = tmp_path / "a.tif"
    options = {"tiled": True, "blockxsize": 16, "blockysize": 16, "compress": "lzw", "interleave": "pixel"}
    size = {"height": 48, "width": 64, "count": 3}
    with (
        pytest.warns(rasterio.errors.NotGeoreferencedWarning),
        rasterio.open(path, "w", driver="GTiff", dtype="uint16", photometric="RGB", **size, **options) as file,
    ):
        file.write(deep.transpose(2, 0, 1))
    np.testing.assert_array_equal(read_rgb(path), deep)


def test_sixteen_bits_in_separate_planes_are_refused_rather_than_mixed_up(tmp_path, deep):
    rasterio = pytest.importorskip("rasterio")
    path, size = tmp_path / "a.tif", {"height": 48, "width": 64, "count": 3}
    with (
        pytest.warns(rasterio.errors.NotGeoreferencedWarning),
        rasterio.open(path, "w", driver="GTiff", dtype="uint16", photometric="RGB", interleave="band", **size) as file,
    ):
        file.write(deep.transpose(2, 0, 1))
    with pytest.raises(ImageError, match=r"a\.tif has 16 bits per channel in separate planes"):
        read_rgb(path)


def test_grey_of_sixteen_bits_has_steps_between_those_of_eight(tmp_path):
    ramp = np.broadcast_to(np.arange(64, dtype=np.uint16) + 29910, (48, 64))
    Image.fromarray(np.ascontiguousarray(ramp)).save(tmp_path / "a.png")
    view, store = view_of(tmp_path / "a.png"), ImageStore(10**6)
    grey = store.grey(view)
    np.testing.assert_allclose(grey, ramp / 257.0, atol=2e-5)
    assert len(np.unique(grey)) == 64
    assert len(np.unique(store.load(view))) == 2
    np.testing.assert_array_equal(store.load(view), load_image(view))


def test_a_smaller_image_averages_all_sixteen_bits(tmp_path, deep):
    cv2.imwrite(str(tmp_path / "a.png"), deep[:, :, ::-1])
    small = load_pixels(view_of(tmp_path / "a.png"), scale=0.5)
    mean = deep.reshape(24, 2, 32, 2, 3).mean(axis=(1, 3))
    assert small.dtype == np.uint16
    assert np.abs(small - mean).max() <= 0.5


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("bits", [8, 16])
def test_a_tag_of_the_orientation_turns_no_pixel_of_a_tiff(tmp_path, rng, orientation, bits):
    path, kind = tmp_path / "a.tif", {8: np.uint8, 16: np.uint16}[bits]
    stored = rng.integers(0, 2**bits - 1, (48, 64), dtype=kind)
    Image.fromarray(stored).save(path, tiffinfo={274: orientation})
    head = read_exif(path)
    assert (head.size_px, head.orientation, head.bits) == ((64, 48), orientation, bits)
    np.testing.assert_array_equal(read_rgb(path)[:, :, 0], stored)


def test_floating_point_is_refused(tmp_path):
    Image.fromarray(np.zeros((48, 64), np.float32)).save(tmp_path / "a.tif")
    with pytest.raises(ImageError, match="32 bits per channel, expected 8 or 16"):
        read_rgb(tmp_path / "a.tif")


def test_what_is_transparent_is_left_out_together_with_what_a_mask_leaves_out(tmp_path):
    pixels = np.full((48, 64, 4), 255, np.uint8)
    pixels[:10, :, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "a.png")
    expected = np.broadcast_to((np.arange(48) >= 10)[:, None], (48, 64))
    np.testing.assert_array_equal(load_mask(view_of(tmp_path / "a.png")), expected)
    mask = np.full((48, 64), 255, np.uint8)
    mask[:, :5] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    both = load_mask(replace(view_of(tmp_path / "a.png"), mask_path=tmp_path / "mask.png"))
    np.testing.assert_array_equal(both, expected & (mask > 0))


def write_tiff(path, bands: np.ndarray, extra: int | None) -> None:
    """A TIFF of RGB and one band more, with or without the tag that says what that band is."""
    height, width, num = bands.shape
    data, bits = bands.astype(bands.dtype.newbyteorder("<")).tobytes(), 8 * bands.dtype.itemsize
    tags = [(256, width), (257, height), (258, 0), (259, 1), (262, 2), (273, 0), (277, num), (278, height)]
    tags += [(279, len(data)), (284, 1)] + ([] if extra is None else [(338, extra)])
    # The bits of each channel stand behind the directory, and the pixels behind them.
    after = 8 + 2 + 12 * len(tags) + 4
    values = dict(tags) | {258: after, 273: after + 2 * num}
    entries = [
        struct.pack("<HHII", tag, 3 if tag == 258 else 4, num if tag == 258 else 1, values[tag]) for tag, _ in tags
    ]
    head = struct.pack("<2sHI", b"II", 42, 8) + struct.pack("<H", len(tags)) + b"".join(entries) + bytes(4)
    path.write_bytes(head + struct.pack(f"<{num}H", *[bits] * num) + data)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("extra", [None, 0, 1, 2])
@pytest.mark.parametrize("is_picture", [True, False])
def test_a_fourth_band_is_transparency_only_where_it_is_said_and_is_no_picture(tmp_path, rng, kind, extra, is_picture):
    """Near infrared is zero over water: as transparency it would leave all of it out."""
    most = np.iinfo(kind).max
    bands = rng.integers(most // 4, most // 2, (48, 64, 4)).astype(kind)
    if not is_picture:
        bands[:, :, 3] = most
    bands[:10, :, 3] = 0
    path = tmp_path / "a.tif"
    write_tiff(path, bands, extra)
    mask = load_mask(view_of(path))
    if extra in (1, 2) and not is_picture:
        np.testing.assert_array_equal(mask, np.broadcast_to((np.arange(48) >= 10)[:, None], (48, 64)))
    else:
        assert mask is None
        if extra != 1:
            np.testing.assert_array_equal(read_rgb(path), bands[:, :, :3])


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "I;16"])
def test_masks_may_be_of_any_kind(tmp_path, mode):
    black = np.zeros((48, 64), np.uint8)
    black[:, 20:] = 255
    image = Image.fromarray(black.astype(np.uint16) * 257 if mode == "I;16" else black)
    (image if mode == "I;16" else image.convert(mode)).save(tmp_path / "m.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), black > 0)
    # Zero and one, as programs write them.
    Image.fromarray(black // 255).save(tmp_path / "m.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), black > 0)


def test_black_in_a_jpeg_is_black_though_it_is_not_quite(tmp_path):
    black = np.full((48, 64), 255, np.uint8)
    black[:, :21] = 0
    Image.fromarray(black).save(tmp_path / "m.jpg", quality=50)
    assert np.asarray(Image.open(tmp_path / "m.jpg"))[black == 0].max() > 0
    np.testing.assert_array_equal(read_mask(tmp_path / "m.jpg"), black > 0)


def test_pages_of_a_tiff_are_counted_and_the_first_is_used(tmp_path, rng):
    pages = [Image.fromarray(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)) for _ in range(3)]
    pages[0].save(tmp_path / "a.tif", save_all=True, append_images=pages[1:])
    assert read_exif(tmp_path / "a.tif").has_pages
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.tif"), np.asarray(pages[0]))


def test_heic_is_read_with_its_exif(tmp_path, rng):
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    smooth = cv2.resize(rng.integers(0, 255, (6, 8, 3), dtype=np.uint8), (64, 48), interpolation=cv2.INTER_CUBIC)
    exif = Image.Exif()
    exif[271] = "maker"
    Image.fromarray(smooth).save(tmp_path / "a.heic", quality=95, exif=exif)
    head = read_exif(tmp_path / "a.heic")
    assert (head.size_px, head.camera, head.bits) == ((64, 48), "maker", 8)
    assert np.abs(read_rgb(tmp_path / "a.heic").astype(int) - smooth).mean() < 8.0


def test_ten_bits_of_heic_are_read_as_sixteen(tmp_path, deep):
    heif = pytest.importorskip("pillow_heif")
    heif.from_bytes(mode="RGB;16", size=(64, 48), data=deep.tobytes()).save(str(tmp_path / "a.heic"), quality=100)
    pixels = read_rgb(tmp_path / "a.heic")
    assert read_exif(tmp_path / "a.heic").bits > 8
    assert (pixels.dtype, pixels.shape) == (np.uint16, (48, 64, 3))
