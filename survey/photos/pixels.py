"""Decoding of image files (JPEG, PNG, TIFF, WebP, HEIC): pixels as stored, with 8 or 16 bits for each channel.

Pillow decodes images of 8 bits, such as JPEG. It silently drops half of the bits of images with three channels of 16
bits, so that OpenCV decodes those, and pillow-heif HEIC. Both, and Pillow for TIFF, rotate pixels by the orientation
tag, which is undone here: poses and sizes are those of the stored pixels.

Pillow refuses images of more than 179 Mpx on any machine, but photographs of 200 Mpx exist. Here an image may take half
of the memory while it is decoded.
"""

import re
import struct
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
import simplejpeg
from PIL import Image, UnidentifiedImageError

from geo.files import library_for
from survey import machine
from survey.errors import ImageError

# Decoded by Pillow 4, converted 4, on its way to an array 3 and as one 3; measured.
_BYTES_PER_PIXEL = 14
_SHARE_OF_MEMORY = 0.5
# Smaller images fit in any memory that the program runs in; to find out how much there is takes 2 ms.
_FITS_PX = 10_000_000
# Errors of Pillow and OpenCV about files whose content contradicts their header.
_DAMAGE = (
    OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError, OverflowError, EOFError, struct.error, cv2.error,
)  # fmt: skip
_GLOBALS_LOCK = threading.RLock()
# Formats of Pillow that a file may be taken for, whatever its suffix: others start programs (EPS) or are of no camera.
_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP")
# Read by pillow-heif, an extra.
HEIC_SUFFIXES, _HEIC_FORMAT = (".heic", ".heif"), "HEIF"
_WIDTH, _HEIGHT, _BITS, _ORIENTATION, _PLANES = 256, 257, 258, 274, 284
_SEPARATE_PLANES = 2
# Tag for bands beyond the colours: 0 is unspecified, 1 and 2 are premultiplied and straight transparency.
_EXTRA_SAMPLES, _ALPHA = 338, ((1,), (2,))
# Transparency is 0 or full except at edges; a band with more intermediate pixels than this share is a picture.
_MOST_BETWEEN = 0.5
_ALPHA_MODES = ("RGBA", "LA", "PA")
# Tags of TIFF: the compression, and positions and lengths of strips, and of tiles.
_COMPRESSION, _UNCOMPRESSED, _PIXELS = 259, 1, ((273, 279), (324, 325))
_JPEG_BEGIN, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
# libjpeg makes no grey levels of these. An eighth of the size takes the least time; every block is read all the same.
_FOUR_COMPONENTS, _EIGHTH = ("CMYK", "YCCK"), 8
# libjpeg's warnings about compressed pixels; others are about headers. Cameras fill up the last word of the pixels.
_LOST_PIXELS = re.compile(r"Corrupt JPEG data|Premature end|Inconsistent progression")
_FILL_BYTES = re.compile(r"Corrupt JPEG data: \d extraneous bytes before marker 0xd9")
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


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """An image whose head is read and whose size was checked."""
    formats: tuple[str, ...] = _FORMATS
    if path.suffix.lower() in HEIC_SUFFIXES:
        library_for(path, "pillow_heif", "heic").register_heif_opener()
        formats = (*_FORMATS, _HEIC_FORMAT)
    # From an open file: Pillow maps a file that it opens itself into memory, and takes width for height in a TIFF that
    # its tag of the orientation turns by a quarter.
    with path.open("rb") as file:
        with damage_named(f"{path} is not an image that can be read"):
            image = open_stream(file, *formats)
        (width, height), pixels = image.size, image.size[0] * image.size[1]
        most = np.inf if pixels <= _FITS_PX else _SHARE_OF_MEMORY * machine.memory_bytes() / _BYTES_PER_PIXEL
        with image:
            if pixels > most:
                raise ImageError(
                    f"{path} has {width} x {height} pixels ({pixels / 1e6:.0f} Mpx), expected at most {most / 1e6:.0f} "
                    f"Mpx on this machine ({_BYTES_PER_PIXEL} bytes a pixel in half of "
                    f"{machine.memory_bytes() / 1e9:.1f} GB); use smaller images with poses made from them, or more "
                    "memory"
                )
            yield image


@contextmanager
def damage_named(message: str) -> Iterator[None]:
    """Context manager that turns errors of a decoder about damaged or hostile files into ImageError.

    Errors of the disk, which have an errno, pass through.
    """
    try:
        yield
    except ImageError:
        raise
    except _DAMAGE as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        why = " ".join(str(error).split())[:200] or type(error).__name__
        if isinstance(error, UnidentifiedImageError):  # its own text names an object of Python
            why = "its first bytes are those of no known format"
        raise ImageError(f"{message} ({why}); copy it again or remove it") from error


def open_stream(file: BinaryIO, *formats: str) -> Image.Image:
    """An image of one of these formats, opened without Pillow's size limit, which is global to the process."""
    with without_complaints():
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            return Image.open(file, formats=formats)
        finally:
            Image.MAX_IMAGE_PIXELS = limit


@contextmanager
def without_complaints() -> Iterator[None]:
    """Context manager that silences Pillow's warnings about damaged tags; missing data is reported later."""
    # Filters of warnings are those of the whole process too.
    with _GLOBALS_LOCK, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def stored_size(image: Image.Image) -> tuple[int, int]:
    """Width and height of the pixels in the file, before any turn by the tag of the orientation."""
    tags = getattr(image, "tag_v2", {})
    return (tags[_WIDTH], tags[_HEIGHT]) if image.format == "TIFF" else image.size


def require_pixels(
    name: str | Path, found: tuple[int, int], expected: tuple[int, int], whose: str, remedy: str
) -> None:
    """Raise ImageError where an image does not have this width and height [px], those of ``whose``."""
    if found != expected:
        (width, height), (w, h) = found, expected
        raise ImageError(f"{name} has {width} x {height} pixels, expected {w} x {h} as {whose} has; {remedy}")


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
    """Pixels (height, width, 3), RGB, as stored: uint8, or uint16 where a channel has more than 8 bits."""
    return _decoded(path, lambda image, bits: _16_bits(path, image, bits) if bits > 8 else _8_bits(image, "RGB"))


def read_grey(path: Path) -> np.ndarray:
    """Grey levels (height, width) uint8 of a mask, as stored; of more than 8 bits 255 where it is not black."""

    def grey(image: Image.Image, bits: int) -> np.ndarray:
        if bits <= 8:
            return _8_bits(image, "L")
        return np.where(_16_bits(path, image, bits).any(axis=2), np.uint8(255), np.uint8(0))

    return _decoded(path, grey)


def read_opaque(path: Path) -> np.ndarray | None:
    """Opaque pixels of an image with transparency, (height, width) bool; None where it has none.

    A band beyond the colours that is a picture, as near infrared is, is not transparency, whatever the file calls it.
    """
    with open_image(path) as image:
        has_alpha = image.mode in _ALPHA_MODES
        if image.format == "TIFF":
            # A band more is transparency only where the file says so.
            has_alpha &= getattr(image, "tag_v2", {}).get(_EXTRA_SAMPLES, ())[-1:] in _ALPHA
        elif "transparency" in image.info:
            has_alpha = True
        if not has_alpha:
            return None
    alpha = _decoded(path, lambda image, _: _8_bits(image.convert("RGBA").getchannel("A"), "L", image))
    # Some programs call every band beyond the colours transparency.
    is_between = (alpha > 0) & (alpha < alpha.max())
    return None if is_between.mean() > _MOST_BETWEEN else alpha > 0


def _decoded(path: Path, decode: Callable[[Image.Image, int], np.ndarray]) -> np.ndarray:
    with open_image(path) as image, damage_named(f"{path} is damaged or cut off"):
        bits = channel_bits(image)
        if bits > 16:
            raise ImageError(f"{path} has {bits} bits per channel, expected 8 or 16; convert it")
        return decode(image, bits)


def _8_bits(image: Image.Image, mode: str, of: Image.Image | None = None) -> np.ndarray:
    """8 bits, by Pillow, which turns what it reads from a TIFF."""
    of = image if of is None else of
    turn = getattr(of, "tag_v2", {}).get(_ORIENTATION, 1) if of.format == "TIFF" else 1
    return _STORED.get(turn, np.asarray)(np.asarray(image.convert(mode)))


def _16_bits(path: Path, image: Image.Image, bits: int) -> np.ndarray:
    """More than 8 bits as (height, width, 3) uint16."""
    if path.suffix.lower() in HEIC_SUFFIXES:
        heif = library_for(path, "pillow_heif", "heic")
        return np.asarray(heif.open_heif(path, convert_hdr_to_8bit=False))[:, :, :3]
    tags, message = getattr(image, "tag_v2", {}), f"{path} has {bits} bits per channel"
    if tags.get(_PLANES) == _SEPARATE_PLANES:
        raise ImageError(f"{message} in separate planes, expected the channels of a pixel together; convert it")
    pixels = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16:
        raise ImageError(
            f"{message} in a form that cannot be read, or is cut off; copy it again, or convert it to PNG or TIFF of "
            "16 bits"
        )
    pixels = pixels[:, :, None].repeat(3, axis=2) if pixels.ndim == 2 else pixels[:, :, 2::-1]
    return np.ascontiguousarray(_STORED.get(tags.get(_ORIENTATION, 1), np.asarray)(pixels))


def require_complete(path: Path) -> None:
    """Raise ImageError where an image is cut off, damaged, or no image.

    Decoders fill what is missing with grey and say nothing. Of a JPEG libjpeg's warnings tell it, of a PNG its
    checksums, of an uncompressed TIFF where its strips or tiles end; other files are decoded.
    """
    with path.open("rb") as file:
        data = file.read(len(_JPEG_BEGIN))
        data = data + file.read() if data == _JPEG_BEGIN else b""
    if not data:
        with open_image(path) as image, damage_named(f"{path} is damaged or cut off"):
            is_raw = image.format == "TIFF" and _holds_all_pixels(image, path.stat().st_size)
            if image.format == "PNG":
                image.verify()
            if is_raw or image.format == "PNG":
                return
        read_rgb(path)
        return
    try:
        _, _, colours, _ = simplejpeg.decode_jpeg_header(data, strict=False)
        target = "CMYK" if colours in _FOUR_COMPONENTS else "GRAY"
        # Some cameras leave out the end marker, and some add bytes behind it.
        simplejpeg.decode_jpeg(data + _JPEG_END, target, strict=True, min_height=1, min_width=1, min_factor=_EIGHTH)
    except (ValueError, KeyError) as error:  # KeyError: of a header without colours
        warning = " ".join(str(error).split())[:100]
        if _LOST_PIXELS.match(warning) and not _FILL_BYTES.fullmatch(warning):
            raise ImageError(f"{path} is damaged or cut off ({warning}); copy it again or remove it") from error
        # Of a kind that libjpeg-turbo's interface does not know, or of another structure.
        read_rgb(path)


def _holds_all_pixels(image: Image.Image, size_bytes: int) -> bool:
    """Whether the tags of an uncompressed TIFF name a place within the file for every strip or tile."""
    tags = dict(getattr(image, "tag_v2", {}))
    starts, counts = next(((tags[where], tags.get(many, ())) for where, many in _PIXELS if where in tags), ((), ()))
    if tags.get(_COMPRESSION, _UNCOMPRESSED) != _UNCOMPRESSED or not 0 < len(starts) == len(counts):
        return False
    return all(0 < start <= start + count <= size_bytes for start, count in zip(starts, counts, strict=True))
