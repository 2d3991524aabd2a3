"""Photographs: undistortion to a fiftieth of a pixel, masks, damaged files, and what EXIF says."""

from __future__ import annotations

import math

import numpy as np
import pycolmap
import pytest
from PIL import Image
from small_survey import write_image

from refract.lens import Lens
from survey import machine
from survey.errors import ImageError
from survey.photos.cameras import View
from survey.photos.exif import read_exif
from survey.photos.images import list_images, load_image, load_mask, require_complete

LENSES = [
    Lens("SIMPLE_RADIAL", (350.0, 160.0, 120.0, -0.12), 320, 240),
    Lens("RADIAL", (350.0, 161.3, 118.2, -0.12, 0.04), 320, 240),
    Lens("OPENCV", (350.0, 352.0, 158.7, 121.2, -0.15, 0.05, 0.001, -0.002), 320, 240),
    Lens("OPENCV_FISHEYE", (250.0, 250.0, 160.0, 120.0, 0.02, -0.01, 0.002, 0.001), 320, 240),
    Lens("FULL_OPENCV", (350.0, 351.0, 160.0, 120.0, 0.1, -0.05, 5e-4, 3e-4, 0.01, 0.2, 0.01, 1e-3), 320, 240),
]

# OpenCV interpolates at 1/32 px, so a pixel is at most 0.5 / 32 = 0.016 px off and a dot of many pixels less;
# rounding to grey levels adds 0.002 px. Measured worst case 0.0155 px.
DOT_TOLERANCE_PX = 0.02
DOT_STD_PX = 2.0


def view_of(path, lens) -> View:
    return View(path.name, path, lens.pinhole(np.zeros(3), np.diag([1.0, -1.0, -1.0])), lens)


def distorted(lens: Lens, pixels: np.ndarray) -> np.ndarray:
    """Where pycolmap sees the points that the pinhole of the same focal length sees at these pixels."""
    camera = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
    fx, fy = lens.focal
    rays = np.column_stack([(pixels[:, 0] - lens["cx"]) / fx, (pixels[:, 1] - lens["cy"]) / fy, np.ones(len(pixels))])
    return camera.img_from_cam(rays)


def dot_centre(pixels: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Centre of a Gaussian dot, by the mean under a window of its own shape that follows it."""
    u, v = np.meshgrid(np.arange(pixels.shape[1]) + 0.5, np.arange(pixels.shape[0]) + 0.5)
    centre = near
    for _ in range(20):
        weight = pixels * np.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / (2.0 * DOT_STD_PX**2))
        centre = np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
    return centre


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_dots_of_a_distorted_photograph_land_where_the_pinhole_sees_them(tmp_path, lens):
    u, v = np.meshgrid([40.3, 95.7, 160.2, 222.9, 281.4], [35.6, 120.1, 203.8])
    dots = np.column_stack([u.ravel(), v.ravel()])
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    photograph = np.zeros((lens.height, lens.width))
    for a, b in distorted(lens, dots):
        photograph += 220.0 * np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2.0 * DOT_STD_PX**2))
    path = tmp_path / "dots.png"
    Image.fromarray(np.round(photograph).astype(np.uint8)).save(path)
    seen = load_image(view_of(path, lens))[..., 0].astype(float)
    found = np.array([dot_centre(seen, dot) for dot in dots])
    # A test that would not see the distortion proves nothing.
    assert np.abs(distorted(lens, dots) - dots).max() > 1.0
    assert np.abs(found - dots).max() < DOT_TOLERANCE_PX


def test_a_photograph_without_distortion_is_given_as_it_is(tmp_path, rng):
    pixels = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
    path = tmp_path / "a.png"
    Image.fromarray(pixels).save(path)
    for lens in (
        Lens("PINHOLE", (100.0, 101.0, 32.0, 24.0), 64, 48),
        Lens("OPENCV", (100.0, 101.0, 32.0, 24.0, 0.0, 0.0, 0.0, 0.0), 64, 48),
    ):
        assert np.array_equal(load_image(view_of(path, lens)), pixels)
        assert load_mask(view_of(path, lens)) is None


def test_a_smaller_image_averages_and_fits_the_scaled_camera(tmp_path, rng):
    pixels = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
    path = tmp_path / "a.png"
    Image.fromarray(pixels).save(path)
    view = view_of(path, Lens("PINHOLE", (100.0, 100.0, 32.0, 24.0), 64, 48))
    small = load_image(view, scale=0.5)
    camera = view.camera.scaled(0.5)
    assert small.shape == (camera.height, camera.width, 3)
    mean = pixels.reshape(24, 2, 32, 2, 3).mean(axis=(1, 3))
    assert np.abs(small - mean).max() <= 0.5


def test_pixels_that_the_photograph_does_not_have_are_masked_and_black(tmp_path):
    # Pincushion distortion: the pinhole sees beyond the photograph at its corners.
    lens = Lens("SIMPLE_RADIAL", (100.0, 32.0, 24.0, 0.5), 64, 48)
    path = tmp_path / "white.png"
    Image.fromarray(np.full((48, 64, 3), 255, np.uint8)).save(path)
    view = view_of(path, lens)
    mask, pixels = load_mask(view), load_image(view)
    corners = np.array([[0.5, 0.5], [63.5, 47.5]])
    assert (np.abs(distorted(lens, corners) - [32.0, 24.0]) > [32.0, 24.0]).all()
    assert not mask[0, 0]
    assert not mask[-1, -1]
    assert mask[24, 32]
    assert np.array_equal(mask, (pixels == 255).all(axis=-1))
    # A pixel of the halved image counts where all four are there.
    assert np.array_equal(load_mask(view, scale=0.5), mask.reshape(24, 2, 32, 2).all(axis=(1, 3)))


def test_a_polynomial_that_folds_back_does_not_show_the_image_twice(tmp_path):
    # r (1 - 0.9 r^2) turns back at r = 0.61, which is 61 px from the centre; the corners are 80 px away.
    lens = Lens("SIMPLE_RADIAL", (100.0, 64.0, 48.0, -0.9), 128, 96)
    path = tmp_path / "white.png"
    Image.fromarray(np.full((96, 128), 255, np.uint8)).save(path)
    mask = load_mask(view_of(path, lens))
    y, x = np.nonzero(mask)
    turn = 100.0 / math.sqrt(3.0 * 0.9)
    assert np.hypot(x + 0.5 - 64.0, y + 0.5 - 48.0).max() == pytest.approx(turn, abs=1.5)


def test_a_mask_is_undistorted_with_its_image(tmp_path):
    lens = LENSES[0]
    photograph, mask = tmp_path / "a.png", tmp_path / "mask.png"
    Image.fromarray(np.zeros((240, 320, 3), np.uint8)).save(photograph)
    black = np.full((240, 320), 255, np.uint8)
    black[:, :20] = 0
    Image.fromarray(black).save(mask)
    plain = view_of(photograph, lens)
    used = load_mask(View(plain.name, plain.path, plain.camera, lens, mask))
    # Along the middle row, black is what comes from the 20 stored columns at the left.
    columns = np.column_stack([np.arange(320) + 0.5, np.full(320, 120.5)])
    expected = distorted(lens, columns)[:, 0] >= 20.0
    assert 5 < np.count_nonzero(~expected) < 20
    assert np.array_equal(used[120], expected)


def test_a_photograph_that_is_cut_off_is_refused_by_name(tmp_path):
    path = tmp_path / "a.jpg"
    write_image(path)
    require_complete(path)
    data = path.read_bytes()
    # Without its end marker every pixel is still there.
    path.write_bytes(data[:-2])
    require_complete(path)
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(ImageError, match=r"a\.jpg is damaged or cut off .* copy it again"):
        require_complete(path)
    with pytest.raises(ImageError, match=r"a\.jpg is damaged or cut off"):
        load_image(view_of(path, Lens("PINHOLE", (100.0, 100.0, 32.0, 24.0), 64, 48)))


def test_an_image_of_another_size_than_its_camera_is_refused(tmp_path):
    path = tmp_path / "a.jpg"
    write_image(path, size=(32, 24))
    with pytest.raises(ImageError, match=r"a\.jpg has 32 x 24 pixels, expected 64 x 48"):
        load_image(view_of(path, Lens("PINHOLE", (100.0, 100.0, 32.0, 24.0), 64, 48)))


def test_sixteen_bit_pixels_are_refused_rather_than_clipped(tmp_path):
    path = tmp_path / "a.png"
    Image.fromarray(np.full((48, 64), 1000, np.uint16)).save(path)
    with pytest.raises(ImageError, match=r"a\.png has pixels of kind I;16, expected 8 bits per channel; convert it"):
        load_image(view_of(path, Lens("PINHOLE", (100.0, 100.0, 32.0, 24.0), 64, 48)))


def test_the_orientation_tag_is_not_applied(tmp_path):
    path = tmp_path / "a.jpg"
    write_image(path, Orientation=6)
    lens = Lens("PINHOLE", (100.0, 100.0, 32.0, 24.0), 64, 48)
    assert load_image(view_of(path, lens)).shape == (48, 64, 3)
    head = read_exif(path)
    assert head.size_px == (64, 48)
    assert head.orientation == 6


def test_images_are_listed_by_their_path_below_the_folder(tmp_path):
    write_image(tmp_path / "images" / "flight 2" / "b.JPG")
    write_image(tmp_path / "images" / "a.jpg")
    (tmp_path / "images" / "notes.txt").write_text("")
    assert list(list_images(tmp_path / "images")) == ["a.jpg", "flight 2/b.JPG"]
    assert list(list_images(tmp_path / "images", deep=False)) == ["a.jpg"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(ImageError, match=r"no images in .*empty"):
        list_images(tmp_path / "empty")
    with pytest.raises(ImageError, match=r"nowhere does not exist; make it, or correct \[images\] dir"):
        list_images(tmp_path / "nowhere")


def test_a_file_that_is_no_image_is_refused(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_text("not a photograph")
    with pytest.raises(ImageError, match=r"a\.jpg is not an image that can be read"):
        read_exif(path)


def with_size_in_head(path, width: int, height: int) -> None:
    """Make a JPEG say that it is larger than it is."""
    data = bytearray(path.read_bytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    path.write_bytes(data)


def test_an_image_beyond_the_memory_or_with_too_long_a_side_is_refused_with_its_size_and_the_limit(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(machine, "memory_bytes", lambda: 34 * 400_000_000)
    path = tmp_path / "a.jpg"
    write_image(path)
    with_size_in_head(path, 65535, 65535)
    with pytest.raises(
        ImageError, match=r"a\.jpg has 65535 x 65535 pixels \(4295 Mpx\), expected at most 32766 a side"
    ):
        read_exif(path)
    with_size_in_head(path, 20000, 12000)
    words = r"a\.jpg has 20000 x 12000 pixels \(240 Mpx\), expected at most 200 Mpx on this machine \(34 bytes a pixel"
    with pytest.raises(ImageError, match=words):
        read_exif(path)
    with_size_in_head(path, 16000, 12000)
    assert read_exif(path).size_px == (16000, 12000)


def test_the_limit_of_pillow_does_not_count_and_is_left_as_it_was(tmp_path, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    path = tmp_path / "a.jpg"
    write_image(path)
    assert read_exif(path).size_px == (64, 48)
    lens = Lens("SIMPLE_PINHOLE", (100.0, 32.0, 24.0), 64, 48)
    assert load_image(view_of(path, lens)).shape == (48, 64, 3)
    assert Image.MAX_IMAGE_PIXELS == 100


def test_position_and_focal_length_come_from_exif(tmp_path):
    path = tmp_path / "a.jpg"
    write_image(path, gps=(589012.0, 5194736.0, 2126.5), FocalLengthIn35mmFilm=24)
    head = read_exif(path)
    # Seconds are written to 1e-7, which is 3 micrometres.
    assert head.lat_lon_height == pytest.approx((46.90019, 10.16864, 2126.5), abs=1e-4)
    assert head.focal_px == pytest.approx(24.0 / 36.0 * 64.0)


def test_western_and_southern_positions_and_heights_below_zero_are_negative(tmp_path):
    image = Image.new("RGB", (8, 8))
    exif = image.getexif()
    gps = exif.get_ifd(0x8825)
    gps.update({1: "S", 2: (33.0, 30.0, 0.0), 3: "W", 4: (70.0, 15.0, 36.0), 5: b"\1", 6: 2.5})
    image.save(tmp_path / "a.jpg", exif=exif)
    assert read_exif(tmp_path / "a.jpg").lat_lon_height == pytest.approx((-33.5, -70.26, -2.5))


def test_an_image_without_a_fix_has_no_position(tmp_path):
    image = Image.new("RGB", (8, 8))
    exif = image.getexif()
    exif.get_ifd(0x8825).update({1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0), 6: 0.0})
    image.save(tmp_path / "a.jpg", exif=exif)
    assert read_exif(tmp_path / "a.jpg").lat_lon_height is None
    Image.new("RGB", (8, 8)).save(tmp_path / "b.png")
    assert read_exif(tmp_path / "b.png").lat_lon_height is None


def test_heights_over_the_start_come_from_the_drone_itself(data_dir):
    head = read_exif(data_dir / "real" / "brighton_beach" / "images" / "DJI_0030.JPG")
    assert head.camera == "DJI FC300S"
    assert head.size_px == (1600, 900)
    assert head.above_start_m == pytest.approx(40.1)
    assert head.lat_lon_height == pytest.approx((46.84228, -91.99408, 198.609), abs=1e-4)
    # 20 mm in 35 mm film.
    assert head.focal_px == pytest.approx(20.0 / 36.0 * 1600.0)
