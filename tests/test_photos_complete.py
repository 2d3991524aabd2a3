"""Files that are cut off are told from complete ones by their structure, in every format, and no pixel is decoded."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from survey.errors import ImageError
from survey.photos import images
from survey.photos.complete import fault_of, has_zeros, is_complete
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
    with pytest.raises(ImageError, match=r"damaged or cut off \((the checksum|(its )?compressed pixels)"):
        require_complete(path)


def test_damage_beside_the_pixels_of_a_png_does_not_matter(tmp_path, pixels):
    text = PngInfo()
    text.add_text("Comment", "a photograph")
    pixels.save(tmp_path / "a.png", pnginfo=text)
    path = tmp_path / "a.png"
    path.write_bytes(path.read_bytes().replace(b"a photograph", b"a photo-raph"))
    require_complete(path)


MODES = ["RGB", "L", "P", "LA", "RGBA", "I;16", "1"]


def drawn(rng, mode: str) -> Image.Image:
    if mode == "I;16":
        return Image.fromarray(rng.integers(0, 65535, (48, 64), dtype=np.uint16))
    return Image.fromarray(rng.integers(0, 255, (48, 64, 4), dtype=np.uint8), "RGBA").convert(mode)


def chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    found, at = [], 8
    while at < len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        found.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    return found


def png_of(parts) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        len(content).to_bytes(4, "big") + kind + content + zlib.crc32(kind + content).to_bytes(4, "big")
        for kind, content in parts
    )


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_png_with_good_checksums_whose_pixels_end_early_is_refused(tmp_path, rng, mode, share):
    path = tmp_path / "a.png"
    drawn(rng, mode).save(path)
    require_complete(path)
    parts = chunks(path.read_bytes())
    short = [(kind, content[: int(share * len(content))] if kind == b"IDAT" else content) for kind, content in parts]
    path.write_bytes(png_of(short))
    with pytest.raises(ImageError, match=r"damaged or cut off \(the compressed pixels end early"):
        require_complete(path)
    # A stream that is whole, of fewer rows than the header says.
    taller = [(kind, content[:4] + (96).to_bytes(4, "big") + content[8:] if kind == b"IHDR" else content)
              for kind, content in parts]  # fmt: skip
    path.write_bytes(png_of(taller))
    with pytest.raises(ImageError, match="end early"):
        require_complete(path)


@pytest.mark.parametrize("compression", ["tiff_adobe_deflate", "tiff_lzw", "packbits", "jpeg"])
@pytest.mark.parametrize("mode", ["RGB", "L", "CMYK"])
def test_a_tiff_with_a_sector_of_zeros_within_is_refused(tmp_path, rng, compression, mode):
    path = tmp_path / "a.tif"
    Image.fromarray(rng.integers(0, 255, (96, 128, 3), dtype=np.uint8)).convert(mode).save(
        path, compression=compression
    )
    require_complete(path)
    with Image.open(path) as image:
        start, count = image.tag_v2[273][0], image.tag_v2[279][0]
    data = bytearray(path.read_bytes())
    data[start + count // 3 : start + count // 3 + 512] = bytes(512)
    path.write_bytes(data)
    with pytest.raises(ImageError, match=r"damaged or cut off \((compressed pixels are overwritten|its compressed)"):
        require_complete(path)


@pytest.mark.parametrize("compression", ["raw", "tiff_lzw"])
def test_a_tiff_whose_tags_do_not_say_where_its_pixels_are_is_refused(tmp_path, rng, compression):
    path = tmp_path / "a.tif"
    Image.fromarray(rng.integers(0, 255, (40, 60, 3), dtype=np.uint8)).save(path, compression=compression)
    whole = bytearray(path.read_bytes())
    # The entry of the tag StripOffsets (273): its type becomes 7, bytes of no type.
    entry = whole.index((273).to_bytes(2, "little"), int.from_bytes(whole[4:8], "little"))
    whole[entry + 2 : entry + 4] = (7).to_bytes(2, "little")
    path.write_bytes(whole)
    assert fault_of(path) == "its tags do not say where its pixels are"


@pytest.mark.parametrize("method", [0, 4])
def test_a_webp_without_loss_with_a_sector_of_zeros_is_refused(tmp_path, rng, method):
    path = tmp_path / "a.webp"
    Image.fromarray(rng.integers(0, 255, (96, 128, 3), dtype=np.uint8)).save(path, lossless=True, method=method)
    require_complete(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 512] = bytes(512)
    path.write_bytes(data)
    with pytest.raises(ImageError, match=r"compressed pixels are overwritten by zeros|cannot be decoded"):
        require_complete(path)


@pytest.mark.parametrize("quality", [30, 60, 95])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.7])
@pytest.mark.parametrize("num", [512, None])
def test_a_webp_with_loss_with_zeros_in_its_pixels_is_refused(tmp_path, quality, share, num):
    path, rng = tmp_path / "a.webp", np.random.default_rng(2)
    pixels = Image.fromarray(rng.integers(0, 255, (80, 110, 3), dtype=np.uint8)).resize((440, 320))
    pixels.save(path, quality=quality)
    require_complete(path)
    data = bytearray(path.read_bytes())
    first = int(share * len(data))
    num = len(data) - first if num is None else num
    data[first : first + num] = bytes(num)
    path.write_bytes(data)
    with pytest.raises(ImageError, match=r"compressed pixels are overwritten by zeros|cannot be decoded"):
        require_complete(path)


@pytest.mark.parametrize("lossless", [True, False])
def test_zeros_in_the_metadata_of_a_webp_are_no_damage(tmp_path, rng, lossless):
    path, exif = tmp_path / "a.webp", Image.Exif()
    exif[0x927C] = bytes(2000)
    image = Image.fromarray(rng.integers(0, 255, (96, 128, 3), dtype=np.uint8))
    image.save(path, lossless=lossless, exif=exif)
    assert bytes(2000) in path.read_bytes()
    require_complete(path)


@pytest.mark.parametrize("form", [{"lossless": True, "method": 0}, {"method": 4}])
def test_a_flat_webp_with_long_zeros_is_whole(tmp_path, rng, form):
    path = tmp_path / "a.webp"
    pixels = np.full((3000, 4000, 3), 128, dtype=np.uint8)
    if "lossless" in form:
        pixels[:100, :100] = rng.integers(0, 255, (100, 100, 3))
    Image.fromarray(pixels).save(path, **form)
    assert bytes(512) in path.read_bytes()
    require_complete(path)


@pytest.mark.parametrize("suffix", ["png", "tif", "webp"])
def test_a_black_photograph_is_whole(tmp_path, suffix):
    Image.new("RGB", (512, 384)).save(
        tmp_path / f"a.{suffix}", **({"compression": "tiff_lzw"} if suffix == "tif" else {})
    )
    require_complete(tmp_path / f"a.{suffix}")


def textured(mode: str) -> np.ndarray:
    pixels = np.random.default_rng(3).integers(1, 255, (120, 161, 3), dtype=np.uint8)
    return {
        "RGB": pixels, "L": pixels[:, :, 0], "RGBA": np.dstack([pixels, np.full(pixels.shape[:2], 255, np.uint8)]),
        "I;16": pixels[:, :, 0].astype(np.uint16) * 257,
    }[mode]  # fmt: skip


def written(tmp_path, pixels: np.ndarray):
    path = tmp_path / "a.tif"
    Image.fromarray(pixels).save(path)
    with Image.open(path) as image:
        start = image.tag_v2[273][0]
        return path, start, start + sum(image.tag_v2[279])


@pytest.mark.parametrize("mode", ["RGB", "L", "RGBA", "I;16"])
@pytest.mark.parametrize("share", [0.13, 0.47, 0.79])
@pytest.mark.parametrize("kind", ["to the end", "a sector", "some sectors"])
def test_an_uncompressed_tiff_with_zeros_in_place_of_pixels_is_refused(tmp_path, mode, share, kind):
    path, start, end = written(tmp_path, textured(mode))
    data = bytearray(path.read_bytes())
    first = start + int(share * (end - start))
    if kind == "to the end":
        data[first:end] = bytes(end - first)
    else:
        first, num = first // 512 * 512, 512 if kind == "a sector" else 2048
        data[first : first + num] = bytes(num)
    path.write_bytes(data)
    with pytest.raises(ImageError, match=r"damaged or cut off \(pixels are zeros from the middle of a row on"):
        require_complete(path)


@pytest.mark.parametrize("mode", ["RGB", "L", "RGBA", "I;16"])
@pytest.mark.parametrize(
    "border",
    ["none", "below", "below dark pixels", "beside", "around", "corner", "circle", "turned", "turned a little"],
)
def test_an_uncompressed_tiff_with_a_black_border_is_whole(tmp_path, mode, border):
    pixels = textured(mode)
    height, width = pixels.shape[:2]
    y, x = np.mgrid[:height, :width]
    black = {
        "none": np.zeros((height, width), bool), "below": y > 0.6 * height,
        "below dark pixels": (y > 0.6 * height) | ((y > 0.6 * height - 1) & (x > width - 5)), "beside": x > 0.6 * width,
        "around": (np.minimum(y, height - y) < 12) | (np.minimum(x, width - x) < 12),
        "corner": (y > 0.5 * height) & (x > 0.3 * width),
        "circle": np.hypot(x - width / 2, y - height / 2) > 0.45 * height,
        "turned": y > 0.5 * height + 0.3 * (x - width / 2), "turned a little": y > 0.9 * height - 0.005 * x,
    }[border]  # fmt: skip
    pixels[black] = 0
    require_complete(written(tmp_path, pixels)[0])


@pytest.mark.parametrize("quality", [50, 90])
@pytest.mark.parametrize("kind", ["to the end", "a sector"])
def test_a_heic_with_zeros_in_its_pixels_is_refused(tmp_path, quality, kind):
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    path, exif = tmp_path / "a.heic", Image.Exif()
    exif[0x927C] = bytes(2000)
    for pixels in (textured("RGB"), np.zeros((120, 161, 3), np.uint8)):
        Image.fromarray(pixels).save(path, quality=quality, exif=exif)
        require_complete(path)
    Image.fromarray(textured("RGB")).save(path, quality=quality)
    data = bytearray(path.read_bytes())
    first, num = len(data) // 2, len(data) - len(data) // 2 if kind == "to the end" else 512
    data[first : first + num] = bytes(num)
    path.write_bytes(data)
    with pytest.raises(ImageError, match=r"damaged or cut off \(compressed pixels are overwritten"):
        require_complete(path)


@pytest.mark.parametrize("length", range(0, 200, 7))
def test_boxes_that_are_no_picture_are_left_to_the_decoder(length):
    data = b"\0\0\0\x10ftypheic\0\0\0\0" + b"\0\0\0\x60meta\0\0\0\0" + b"\0\0\0\x20iinf" + bytes(24)
    data += b"\0\0\0\x30iloc\2\0\0\0\x44\x44\xff\xff\xff\xff" + bytes(40)
    assert not has_zeros(data[:length])
