"""Decoding of image files (JPEG, PNG, TIFF, WebP, HEIC): pixels as stored, with 8 or 16 bits for each channel.

Pillow decodes what has 8 bits, as JPEG has. It opens 16 bits of three channels too and drops half of them without a
word, so that OpenCV decodes those; pillow-heif does in HEIC. Both, and Pillow in TIFF, turn pixels by the tag of the
orientation, which is undone here: poses and sizes are those of the stored pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from geo.optional import library_for
from survey.errors import ImageError
from survey.photos.opening import HEIC_SUFFIXES, damage_named, open_image

_WIDTH, _HEIGHT, _BITS, _ORIENTATION, _PLANES = 256, 257, 258, 274, 284
_SEPARATE_PLANES = 2
# What a band beyond the colours is: 0 is unspecified, 1 and 2 are transparency that colours are multiplied with or not.
_EXTRA_SAMPLES, _ALPHA = 338, ((1,), (2,))
# Transparency is all or nothing but for edges, and a picture is not: a share of pixels.
_MOST_BETWEEN = 0.5
_ALPHA_MODES = ("RGBA", "LA", "PA")
# From pixels that were turned for the eye back to those of the file, by the value of the tag.
_STORED: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    2: np.fliplr,
    3: lambda pixels: np.rot90(pixels, 2),
    4: np.flipud,
    5: lambda pixels: pixels.swapaxes(0, 1),
    6: lambda pixels: np.rot90(pixels, 1),
    7: lambda pixels: np.rot90(pixels, 2).swapaxes(0, 1),
    8: lambda pixels: np.rot90(pixels, -1),
}


def stored_size(image: Image.Image) -> tuple[int, int]:
    """Width and height of the pixels in the file, before any turn by the tag of the orientation."""
    tags = getattr(image, "tag_v2", {})
    return (tags[_WIDTH], tags[_HEIGHT]) if image.format == "TIFF" else image.size


def channel_bits(image: Image.Image) -> int:
    """Bits of one channel; 32 for floating point."""
    if image.mode[0] == "F":
        return 32
    if image.format == "TIFF":
        bits = getattr(image, "tag_v2", {}).get(_BITS, (1,))
        return max(bits) if isinstance(bits, tuple) else bits
    if image.format == "HEIF":
        return int(image.info.get("bit_depth", 8))
    tiles = getattr(image, "tile", None)
    raw = str(tiles[0][3]) if tiles else ""
    return 16 if ";16" in raw or image.mode.startswith("I") else 8


def read_rgb(path: Path) -> np.ndarray:
    """Pixels (height, width, 3), RGB, as stored: uint8, or uint16 where a channel has more than 8 bits.

    Raises
    ------
    ImageError
        Where the file is cut off or damaged, or of a kind that would lose something.
    """
    return _decoded(path, lambda image, bits: _deep(path, image, bits) if bits > 8 else _shallow(image, "RGB"))


def read_grey(path: Path) -> np.ndarray:
    """Brightness (height, width) uint8 of a mask, as stored.

    Raises
    ------
    ImageError
        As `read_rgb`.
    """

    def grey(image: Image.Image, bits: int) -> np.ndarray:
        return _deep(path, image, bits).max(axis=2).astype(bool) * np.uint8(255) if bits > 8 else _shallow(image, "L")

    return _decoded(path, grey)


def read_opaque(path: Path) -> np.ndarray | None:
    """Opaque pixels of an image with transparency, (height, width) bool; None where it has none.

    A band beyond the colours that is a picture, as near infrared is, is no transparency, whatever the file calls it.

    Raises
    ------
    ImageError
        As `read_rgb`.
    """
    with open_image(path) as image:
        if not _has_alpha(image):
            return None
    alpha = _decoded(path, lambda image, _: _shallow(image.convert("RGBA").getchannel("A"), "L", image))
    # Some programs call every band beyond the colours transparency.
    is_between = (alpha > 0) & (alpha < alpha.max())
    return None if is_between.mean() > _MOST_BETWEEN else alpha > 0


def _has_alpha(image: Image.Image) -> bool:
    """Whether an image has transparency: a band more of a TIFF is that only where it says so."""
    if image.format == "TIFF":
        extra = getattr(image, "tag_v2", {}).get(_EXTRA_SAMPLES, ())
        return extra[-1:] in _ALPHA and image.mode in _ALPHA_MODES
    return image.mode in _ALPHA_MODES or "transparency" in image.info


def _decoded(path: Path, decode: Callable[[Image.Image, int], np.ndarray]) -> np.ndarray:
    with open_image(path) as image, damage_named(f"{path} is damaged or cut off"):
        bits = channel_bits(image)
        if bits > 16:
            raise ImageError(f"{path} has {bits} bits per channel, expected 8 or 16; convert it")
        return decode(image, bits)


def _shallow(image: Image.Image, mode: str, of: Image.Image | None = None) -> np.ndarray:
    """8 bits, by Pillow, which turns what it reads from a TIFF."""
    of = image if of is None else of
    turn = getattr(of, "tag_v2", {}).get(_ORIENTATION, 1) if of.format == "TIFF" else 1
    return _as_stored(np.asarray(image.convert(mode)), turn)


def _deep(path: Path, image: Image.Image, bits: int) -> np.ndarray:
    """More than 8 bits as (height, width, 3) uint16."""
    if path.suffix.lower() in HEIC_SUFFIXES:
        heif = library_for(path, "pillow_heif", "heic")
        return np.asarray(heif.open_heif(path, convert_hdr_to_8bit=False))[:, :, :3]
    tags, said = getattr(image, "tag_v2", {}), f"{path} has {bits} bits per channel"
    if tags.get(_PLANES) == _SEPARATE_PLANES:
        raise ImageError(f"{said} in separate planes, expected the channels of a pixel together; convert it")
    pixels = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16:
        raise ImageError(f"{said} in a form that cannot be read; convert it to PNG or TIFF of 16 bits")
    pixels = pixels[:, :, None].repeat(3, axis=2) if pixels.ndim == 2 else pixels[:, :, 2::-1]
    return np.ascontiguousarray(_as_stored(pixels, tags.get(_ORIENTATION, 1)))


def _as_stored(pixels: np.ndarray, orientation: int) -> np.ndarray:
    return _STORED[orientation](pixels) if orientation in _STORED else pixels
