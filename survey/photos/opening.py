"""Image files opened by Pillow, with a limit on their size that fits the memory of the machine.

Pillow refuses images of more than 179 Mpx whatever the machine is, and photographs of 200 Mpx exist. The limit here:
an image may take half of the memory while it is decoded.
"""

from __future__ import annotations

import struct
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import cv2
from PIL import Image, UnidentifiedImageError

from geo.optional import library_for
from survey import machine
from survey.errors import ImageError

# Decoded by Pillow 4, converted 4, on its way to an array 3 and as one 3; measured.
_BYTES_PER_PIXEL = 14
_SHARE_OF_MEMORY = 0.5
# What Pillow and OpenCV raise about files that do not hold what their heads promise.
_DAMAGE = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    OverflowError,
    EOFError,
    struct.error,
    cv2.error,
)
_one_at_a_time = threading.RLock()
# Read by pillow-heif, an extra.
HEIC_SUFFIXES = (".heic", ".heif")


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """An image whose head is read and whose size was checked.

    Raises
    ------
    ImageError
        Where the file is no image, or one that is too large for this machine.
    UnreadableFile
        Where the library that reads its format is not installed.
    OSError
        What the disk refuses.
    """
    if path.suffix.lower() in HEIC_SUFFIXES:
        library_for(path, "pillow_heif", "heic").register_heif_opener()
    # From an open file: Pillow maps a file that it opens itself into memory, and takes width for height in a TIFF that
    # its tag of the orientation turns by a quarter.
    with path.open("rb") as file:
        with damage_named(f"{path} is not an image that can be read"):
            image = open_stream(file)
        with image:
            _require_fit(path, *image.size)
            yield image


@contextmanager
def damage_named(said: str) -> Iterator[None]:
    """Around calls of a decoder: all that damaged or hostile files make it raise becomes an ImageError.

    Errors of the disk have an errno, those of decoders about damaged files have none.
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
            why = "it does not begin as any known format does"
        raise ImageError(f"{said} ({why}); copy it again or remove it") from error


def open_stream(file: BinaryIO, *formats: str) -> Image.Image:
    """Opened without Pillow's own limit, which is one number for the whole process; of all formats, or of some."""
    with without_complaints():
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            return Image.open(file, formats=formats or None)
        finally:
            Image.MAX_IMAGE_PIXELS = limit


@contextmanager
def without_complaints() -> Iterator[None]:
    """Without the warnings of Pillow about damaged tags: what they cost, e.g. a position, is found missing later."""
    # Filters of warnings are those of the whole process too.
    with _one_at_a_time, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _require_fit(path: Path, width: int, height: int) -> None:
    most = _SHARE_OF_MEMORY * machine.memory_bytes() / _BYTES_PER_PIXEL
    said = f"{path} has {width} x {height} pixels ({width * height / 1e6:.0f} Mpx)"
    if width * height > most:
        raise ImageError(
            f"{said}, expected at most {most / 1e6:.0f} Mpx on this machine ({_BYTES_PER_PIXEL} bytes a pixel in half "
            f"of {machine.memory_bytes() / 1e9:.1f} GB); use smaller images with poses made from them, or more memory"
        )
