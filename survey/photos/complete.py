"""Completeness of image files by their structure, without decoding pixels."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from PIL import Image

from survey.photos.opening import open_image

# A complete JPEG ends with this marker, which the compressed pixels never contain; cameras add a few bytes behind it.
_JPEG_END = b"\xff\xd9"
_PNG_END = b"IEND\xae\x42\x60\x82"
_NEAR_END = 64
# Where a TIFF has its pixels, and how many bytes of them: in strips, or in tiles.
_TIFF_PIXELS = ((273, 279), (324, 325))


def is_complete(path: Path) -> bool:
    """Whether the structure of an image file says that nothing is cut off; False where it does not say so.

    Raises
    ------
    ImageError
        Where the file is no image.
    """
    suffix = path.suffix.lower()
    if suffix in (".tif", ".tiff"):
        with open_image(path) as image:
            return _tiff_is_complete(image, path.stat().st_size)
    with path.open("rb") as file:
        size = path.stat().st_size
        if suffix in (".jpg", ".jpeg"):
            return _tail(file, size).endswith(_JPEG_END)
        if suffix == ".png":
            return _PNG_END in _tail(file, size)
        if suffix == ".webp":
            head = file.read(12)
            return head[:4] == b"RIFF" and head[8:] == b"WEBP" and size >= int.from_bytes(head[4:8], "little") + 8
        return _boxes_end(file, size) == size


def _tail(file: BinaryIO, size: int) -> bytes:
    file.seek(max(0, size - _NEAR_END))
    return file.read()


def _tiff_is_complete(image: Image.Image, size: int) -> bool:
    """Whether all strips, or tiles, of the first page end within the file."""
    tags = getattr(image, "tag_v2", {})
    for where, length in _TIFF_PIXELS:
        starts, counts = tags.get(where, ()), tags.get(length, ())
        if starts and len(starts) == len(counts):
            return all(0 < start <= start + count <= size for start, count in zip(starts, counts, strict=True))
    return False


def _boxes_end(file: BinaryIO, size: int) -> int:
    """Where the last of the boxes ends that a HEIC file consists of: at the end of a complete one."""
    at = 0
    while at + 8 <= size:
        file.seek(at)
        head = file.read(16)
        length = int.from_bytes(head[:4], "big")
        if length == 1:
            length = int.from_bytes(head[8:16], "big")
        if length == 0:  # reaches to the end of the file
            return size
        if length < 8:
            return -1
        at += length
    return at
