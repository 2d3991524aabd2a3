"""Files that are cut off are told from complete ones by their structure, in every format, and no pixel is decoded."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from survey.errors import ImageError
from survey.photos import images
from survey.photos.complete import is_complete
from survey.photos.images import require_complete

FORMATS = {
    "a.jpg": {"quality": 90},
    "a.png": {},
    "raw.tif": {},
    "lzw.tif": {"compression": "tiff_lzw"},
    "a.webp": {"lossless": True},
}


@pytest.fixture
def pixels(rng) -> Image.Image:
    return Image.fromarray(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))


@pytest.mark.parametrize("name", FORMATS)
def test_a_complete_file_is_not_decoded_and_a_cut_one_is_refused(tmp_path, pixels, monkeypatch, name):
    path = tmp_path / name
    pixels.save(path, **FORMATS[name])
    whole, decode = path.read_bytes(), images.read_rgb
    monkeypatch.setattr(images, "read_rgb", lambda *_: pytest.fail("decoded"))
    require_complete(path)
    monkeypatch.setattr(images, "read_rgb", decode)
    path.write_bytes(whole[: len(whole) // 2])
    # The directory of a TIFF may be cut off too, and then it is no image at all.
    with pytest.raises(ImageError, match=r"damaged or cut off|not an image"):
        require_complete(path)


def test_a_file_of_boxes_is_complete_where_the_last_one_ends_with_it(tmp_path):
    path = tmp_path / "a.heic"
    long = b"\0\0\0\1mdat" + (26).to_bytes(8, "big") + bytes(10)
    path.write_bytes(b"\0\0\0\x10ftypheic\0\0\0\0" + long)
    assert is_complete(path)
    path.write_bytes(path.read_bytes()[:-1])
    assert not is_complete(path)
    path.write_bytes(b"\0\0\0\x10ftypheic\0\0\0\0" + b"\0\0\0\0mdat" + bytes(10))
    assert is_complete(path)
    path.write_bytes(b"\0\0\0\3ftyp" + bytes(20))
    assert not is_complete(path)


def test_bytes_that_a_camera_adds_behind_a_png_do_not_matter(tmp_path, pixels):
    pixels.save(tmp_path / "a.png")
    with (tmp_path / "a.png").open("ab") as file:
        file.write(bytes(20))
    assert is_complete(tmp_path / "a.png")


@pytest.mark.parametrize("name", ["a.png", "lzw.tif", "deflate.tif"])
@pytest.mark.parametrize("share", [0.2, 0.6])
def test_a_file_of_its_full_length_whose_end_became_zeros_is_refused(tmp_path, pixels, name, share):
    path = tmp_path / name
    pixels.save(path, **(FORMATS | {"deflate.tif": {"compression": "tiff_adobe_deflate"}})[name])
    require_complete(path)
    whole = path.read_bytes()
    with Image.open(path) as image:
        # Where the only strip begins, and its length; the last chunk of a PNG has 12 bytes.
        tags = getattr(image, "tag_v2", {273: [0], 279: [len(whole) - 12]})
    last = tags[273][0] + tags[279][0]
    first = int(share * last)
    path.write_bytes(whole[:first] + bytes(last - first) + whole[last:])
    with pytest.raises(ImageError, match=r"damaged or cut off \((the checksum|zeros stand where)"):
        require_complete(path)


def test_damage_beside_the_pixels_of_a_png_does_not_matter(tmp_path, pixels):
    text = PngInfo()
    text.add_text("Comment", "a photograph")
    pixels.save(tmp_path / "a.png", pnginfo=text)
    path = tmp_path / "a.png"
    path.write_bytes(path.read_bytes().replace(b"a photograph", b"a photo-raph"))
    require_complete(path)
