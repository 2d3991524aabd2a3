"""Photographs: as they were taken and smaller, masks, damaged files, and what EXIF says."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from small_survey import write_image

from refract.lens import Lens
from survey import machine
from survey.errors import ImageError
from survey.folder.headers import read_headers
from survey.photos.cameras import View
from survey.photos.exif import read_exif
from survey.photos.images import list_images, load_image, load_mask, same_files

BARREL = Lens("OPENCV", (100.0, 101.0, 32.0, 24.0, -0.15, 0.05, 0.001, -0.002), 64, 48)


def view_of(path, lens) -> View:
    return View(path.name, path, lens.camera(np.zeros(3), np.diag([1.0, -1.0, -1.0])), lens)


@pytest.mark.parametrize("lens", [Lens("PINHOLE", (100.0, 101.0, 32.0, 24.0), 64, 48), BARREL], ids=lambda v: v.model)
def test_a_photograph_is_given_as_it_was_taken(tmp_path, rng, lens):
    pixels = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
    path = tmp_path / "a.png"
    Image.fromarray(pixels).save(path)
    assert np.array_equal(load_image(view_of(path, lens)), pixels)
    assert load_mask(view_of(path, lens)) is None


def test_a_mask_is_that_of_the_photograph_and_a_smaller_pixel_counts_where_all_of_its_area_does(tmp_path):
    photograph, mask = tmp_path / "a.png", tmp_path / "mask.png"
    Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(photograph)
    black = np.full((48, 64), 255, np.uint8)
    black[:, :21] = 0
    Image.fromarray(black).save(mask)
    view = replace(view_of(photograph, BARREL), mask_path=mask)
    assert np.array_equal(load_mask(view), black > 0)
    assert np.array_equal(load_mask(view, scale=0.5), np.arange(32) >= np.full((24, 1), 11))
    Image.fromarray(np.full((48, 64), 255, np.uint8)).save(mask)
    assert load_mask(view) is None


def test_an_image_of_another_size_than_its_camera_is_refused(tmp_path):
    path = tmp_path / "a.jpg"
    write_image(path, size=(32, 24))
    with pytest.raises(ImageError, match=r"a\.jpg has 32 x 24 pixels, expected 64 x 48"):
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
    with pytest.raises(
        ImageError,
        match=r"nowhere does not exist, but 2 photographs lie in .*images: write \[images\] dir = .images. for them",
    ):
        list_images(tmp_path / "nowhere")


@pytest.mark.parametrize(
    "hidden", [".thumbnails", "@eaDir/0001.jpg", "__MACOSX", "card/.cache", "@__thumb", "#recycle", "Lost+Found"]
)
def test_thumbnails_of_file_managers_and_storage_are_no_photographs(tmp_path, hidden):
    for name in ("card/0001.jpg", f"{hidden}/0001.jpg", "card/._0001.jpg"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (8, 6)).save(tmp_path / name)
    assert list(list_images(tmp_path)) == ["card/0001.jpg"]


def test_single_bands_beside_photographs_are_none_of_the_survey(tmp_path):
    for name in ("DJI_1_D.JPG", "b/IMG_2_RGB.JPG", "c_NIR.tif", "flight_R.tif"):
        write_image(tmp_path / name)
    for name in ("DJI_1_MS_NIR.TIF", "DJI_1_MS_RE.TIF", "b/IMG_2_GRE.TIF"):
        Image.fromarray(np.zeros((48, 64), np.uint16)).save(tmp_path / name)
    images = list_images(tmp_path)
    assert list(images) == ["DJI_1_D.JPG", "b/IMG_2_RGB.JPG", "c_NIR.tif", "flight_R.tif"]
    _, findings = read_headers(tmp_path, tmp_path, images)
    (tmp_path / "rig").mkdir()
    for view in "DFLRB":
        Image.new("RGB", (64, 48)).save(tmp_path / "rig" / f"0001_{view}.tif")
    assert len(list_images(tmp_path / "rig")) == 5
    left_out = "3 images of single bands beside photographs, left out: DJI_1_MS_NIR.TIF, DJI_1_MS_RE.TIF and 1 more"
    assert left_out in findings.assumptions


def test_a_file_that_is_no_image_is_refused(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_text("not a photograph")
    with pytest.raises(ImageError, match=r"a\.jpg is not an image that can be read \(its first bytes are those of no"):
        read_exif(path)


def with_size_in_head(path, width: int, height: int) -> None:
    """Make a JPEG say that it is larger than it is."""
    data = bytearray(path.read_bytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    path.write_bytes(data)


def test_an_image_beyond_the_memory_is_refused_with_its_size_and_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "memory_bytes", lambda: 14 * 400_000_000)
    path = tmp_path / "a.jpg"
    write_image(path)
    with_size_in_head(path, 20000, 12000)
    words = r"a\.jpg has 20000 x 12000 pixels \(240 Mpx\), expected at most 200 Mpx on this machine \(14 bytes a pixel"
    with pytest.raises(ImageError, match=words):
        read_exif(path)
    with_size_in_head(path, 65535, 3000)
    assert read_exif(path).size_px == (65535, 3000)


def test_the_limit_of_pillow_does_not_count_and_is_left_as_it_was(tmp_path, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    path = tmp_path / "a.jpg"
    write_image(path)
    assert read_exif(path).size_px == (64, 48)
    lens = Lens("SIMPLE_PINHOLE", (100.0, 32.0, 24.0), 64, 48)
    assert load_image(view_of(path, lens)).shape == (48, 64, 3)
    assert Image.MAX_IMAGE_PIXELS == 100


def test_exif_of_a_png_is_read_without_its_pixels(tmp_path):
    path = tmp_path / "a.png"
    exif = Image.Exif()
    exif[271] = "maker"  # without a tag of its own Pillow writes none
    exif.get_ifd(0x8825).update({1: "N", 2: (46.5, 0.0, 0.0), 3: "E", 4: (10.25, 0.0, 0.0), 5: b"\0", 6: 2.5})
    Image.new("RGB", (8, 8)).save(path, exif=exif)
    # Pixels that cannot be decoded.
    data = bytearray(path.read_bytes())
    pixels = data.index(b"IDAT") + 4
    data[pixels : pixels + 8] = bytes(8)
    path.write_bytes(data)
    with pytest.raises(OSError), Image.open(path) as image:  # noqa: PT011
        image.load()
    assert read_exif(path).lat_lon_height == pytest.approx((46.5, 10.25, 2.5))
    # Behind the pixels, where other programs have it.
    at = data.index(b"eXIf") - 4
    length = 12 + int.from_bytes(data[at : at + 4], "big")
    path.write_bytes(data[:at] + data[at + length : -12] + data[at : at + length] + data[-12:])
    assert read_exif(path).lat_lon_height == pytest.approx((46.5, 10.25, 2.5))
    path.write_bytes(data[:at] + data[at + length :])
    assert read_exif(path).lat_lon_height is None


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


def test_copies_of_a_photograph_are_named(tmp_path):
    rng = np.random.default_rng(4)
    contents = [rng.bytes(size) for size in (10, 200_000, 200_000, 0, 300_000)]
    names = ("a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg", "copy of b.jpg", "copy of a.jpg")
    paths = {name: tmp_path / name for name in names}
    for path, content in zip(paths.values(), (*contents, contents[1], contents[0]), strict=True):
        path.write_bytes(content)
    assert same_files(paths) == [("a.jpg", "copy of a.jpg"), ("b.jpg", "copy of b.jpg")]
