"""Files that are cut off are told from complete ones by their structure, in every format, and no pixel is decoded."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

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
