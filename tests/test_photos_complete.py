"""Files that are cut off or damaged are told from complete ones, in every format."""

import io
from functools import cache

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from survey.errors import ImageError
from survey.photos.pixels import require_complete

SIZE = (400, 304)
JPEGS = {
    "420": {"quality": 75, "subsampling": 2},
    "444": {"quality": 98, "subsampling": 0},
    "rough": {"quality": 20, "subsampling": 2},
    "optimised": {"quality": 75, "optimize": True},
    "restarts": {"quality": 90, "restart_marker_blocks": 7},
    "restart rows": {"quality": 90, "restart_marker_rows": 1, "optimize": True},
    "progressive": {"quality": 75, "progressive": True},
}
EOI = b"\xff\xd9"
FORMATS = {
    "a.jpg": {"quality": 90},
    "a.png": {},
    "raw.tif": {},
    "lzw.tif": {"compression": "tiff_lzw"},
    "deflate.tif": {"compression": "tiff_adobe_deflate"},
    "lossless.webp": {"lossless": True},
    "lossy.webp": {},
    "a.heic": {},
}


@cache
def ground(seed: int, *, rough: float = 30.0) -> np.ndarray:
    """Smooth and rough places, as photographs have them; not to be written to."""
    rng = np.random.default_rng(seed)
    coarse = Image.fromarray(rng.integers(0, 255, (10, 13, 3), dtype=np.uint8)).resize(SIZE, Image.Resampling.BICUBIC)
    noise = rng.normal(0.0, 1.0, (SIZE[1], SIZE[0], 1)) * np.linspace(0.0, rough, SIZE[0])[None, :, None]
    pixels = np.clip(np.asarray(coarse) + noise, 0, 255).astype(np.uint8)
    pixels.flags.writeable = False
    return pixels


def black_below(pixels: np.ndarray) -> np.ndarray:
    """With a black border, as undistorted photographs have it, and black below."""
    pixels = pixels.copy()
    pixels[:, :80] = pixels[:, -80:] = pixels[:40] = pixels[180:] = 0
    return pixels


CONTENTS = {
    "ground": ground(1),
    "grey": ground(1)[:, :, 0],
    "black below": black_below(ground(1)),
    "black": np.zeros((SIZE[1], SIZE[0], 3), np.uint8),
    "white": np.full((SIZE[1], SIZE[0], 3), 255, np.uint8),
    "noise": np.random.default_rng(2).integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8),
    "odd size": ground(3)[:131, :77],
    "tiny": ground(3)[:5, :3],
}


def jpeg(pixels: np.ndarray, **form) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "JPEG", **form)
    return stream.getvalue()


def require_bytes(path, data: bytes) -> None:
    path.write_bytes(data)
    require_complete(path)


def save(path, pixels: np.ndarray, **form) -> None:
    if path.suffix == ".heic":
        pytest.importorskip("pillow_heif").register_heif_opener()
    Image.fromarray(pixels).save(path, **form)


@pytest.mark.parametrize("content", CONTENTS)
@pytest.mark.parametrize("name", FORMATS)
def test_whole_files_pass(tmp_path, name, content):
    save(tmp_path / name, CONTENTS[content], **FORMATS[name])
    require_complete(tmp_path / name)


@pytest.mark.parametrize("form", JPEGS)
@pytest.mark.parametrize("content", CONTENTS)
def test_a_jpeg_is_whole_with_what_cameras_add(tmp_path, content, form):
    data, path = jpeg(CONTENTS[content], **JPEGS[form]), tmp_path / "a.jpg"
    preview = jpeg(ground(4)[:64, :64])
    application = b"\xff\xe1" + (len(preview) + 2).to_bytes(2, "big") + preview
    # Previews before and behind the pixels, trailing bytes, fill bytes before the end marker, no end marker.
    require_bytes(path, data[:2] + application + data[2:] + preview + bytes(3000))
    for end in (b"\xff\xff\xff" + EOI, bytes(8) + EOI, b""):
        require_bytes(path, data[:-2] + end)


def test_a_jpeg_of_four_components_is_whole_or_cut_as_others(tmp_path):
    Image.fromarray(ground(1)).convert("CMYK").save(tmp_path / "a.jpg")
    require_complete(tmp_path / "a.jpg")
    data = (tmp_path / "a.jpg").read_bytes()
    with pytest.raises(ImageError, match="cut off"):
        require_bytes(tmp_path / "a.jpg", data[: len(data) // 2])


def filled(data: bytes, at: int, end: int) -> bytes:
    return data[:at] + bytes(end - at) + data[end:]


# Each gets the file, a photograph of another place in the same form, and a position within the compressed pixels.
DAMAGES = {
    "cut": lambda data, other, at: data[:at],
    "cut, with an end mark": lambda data, other, at: data[:at] + EOI,
    "zeros to the end": lambda data, other, at: filled(data, at, len(data)),
    "zeros to the end mark": lambda data, other, at: filled(data, at, len(data) - 2),
    "a sector of 0xff": lambda data, other, at: data[:at] + b"\xff" * 512 + data[at + 512 :],
    "text": lambda data, other, at: data[:at] + (b"GET / HTTP/1.1 " * 200)[:2500] + data[at + 2500 :],
    "the end of another": lambda data, other, at: data[:at] + other[len(other) * at // len(data) :],
    "a part left out": lambda data, other, at: data[:at] + data[at + (len(data) - at) // 3 :],
    "a part twice": lambda data, other, at: data[:at] + data[at - 400 :],
}


@pytest.mark.parametrize("share", [0.03, 0.4, 0.77])
@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("form", JPEGS)
def test_every_damaged_jpeg_is_refused(tmp_path, form, damage, share):
    data, other = (jpeg(ground(n, rough=rough), **JPEGS[form]) for n, rough in ((5, 30.0), (6, 90.0)))
    begin = data.index(b"\xff\xda")
    at = int(begin + 400 + share * (len(data) - begin - 3000))
    with pytest.raises(ImageError, match=r"a\.jpg is damaged or cut off \(.*copy it"):
        require_bytes(tmp_path / "a.jpg", DAMAGES[damage](data, other, at))


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
def test_a_progressive_jpeg_is_refused_where_its_scans_end_early(tmp_path, share):
    data = jpeg(ground(5), **JPEGS["progressive"])
    with pytest.raises(ImageError, match=r"Premature|Corrupt"):
        require_bytes(tmp_path / "a.jpg", data[: int(share * len(data))] + EOI)


@pytest.mark.parametrize("share", [0.3, 0.9])
@pytest.mark.parametrize("name", FORMATS)
def test_a_file_that_is_cut_off_is_refused(tmp_path, name, share):
    path = tmp_path / name
    save(path, ground(1), **FORMATS[name])
    whole = path.read_bytes()
    # The directory of a TIFF may be cut off too, and then it is no image at all.
    with pytest.raises(ImageError, match=r"damaged or cut off|not an image"):
        require_bytes(path, whole[: int(share * len(whole))])


@pytest.mark.parametrize("share", [0.2, 0.6])
def test_a_png_with_zeros_in_its_pixels_is_refused(tmp_path, share):
    path = tmp_path / "a.png"
    save(path, ground(1))
    whole = path.read_bytes()
    first = int(share * len(whole))
    with pytest.raises(ImageError, match="damaged or cut off"):
        require_bytes(path, filled(whole, first, first + 512))


def test_what_stands_beside_the_pixels_of_a_png_does_not_matter(tmp_path):
    text = PngInfo()
    text.add_text("Comment", "a photograph")
    save(tmp_path / "a.png", ground(1), pnginfo=text)
    require_bytes(tmp_path / "a.png", (tmp_path / "a.png").read_bytes() + bytes(20))


@pytest.mark.parametrize("compression", ["raw", "tiff_lzw"])
def test_a_tiff_whose_tags_do_not_say_where_its_pixels_are_is_refused(tmp_path, compression):
    path = tmp_path / "a.tif"
    save(path, ground(1), compression=compression)
    whole = bytearray(path.read_bytes())
    # The entry of the tag StripOffsets (273): its type becomes 7, bytes of no type.
    entry = whole.index((273).to_bytes(2, "little"), int.from_bytes(whole[4:8], "little"))
    whole[entry + 2 : entry + 4] = (7).to_bytes(2, "little")
    with pytest.raises(ImageError):
        require_bytes(path, bytes(whole))


@pytest.mark.parametrize("data", [b"\xff\xd8", b"\xff\xd8\xff\xda", b"\xff\xd8\xff\xda\0\2", b"\xff\xd8" + b"\xff" * 9])
def test_what_only_begins_as_a_jpeg_is_no_image(tmp_path, data):
    with pytest.raises(ImageError):
        require_bytes(tmp_path / "a.jpg", data)
