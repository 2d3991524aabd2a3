"""Completeness of an image file, by its structure, by its checksums, and in JPEG by the count of its blocks.

Lost pixels are zeros: to the end of the data, or in sectors of a disk. Black borders of mosaics, circles of fisheye
lenses and masks are zeros too, but begin and end with rows, or at columns that change from row to row. Lost data begins
within a row, below one that has pixels there, and continues over rows.

HEIC is parsed by its boxes (ISO/IEC 14496-12, 23008-12). HEVC decoders conceal unreadable data. But a stream unit never
contains three zero bytes in a row (23008-2, 7.3.1.1: an emulation prevention byte is inserted), so longer runs are lost
data.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image

from survey.photos.jpeg import jpeg_fault
from survey.photos.pixels import HEIC_SUFFIXES, open_image

# A complete JPEG ends with this marker, which the compressed pixels never contain; cameras add a few bytes behind it.
_JPEG_END = b"\xff\xd9"
_JPEG_BEGIN, _PNG_BEGIN = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_PNG_PIXELS = (b"IHDR", b"PLTE", b"IDAT")
_PNG_END = b"IEND\xae\x42\x60\x82"
_NEAR_END = 64
# Tags of a TIFF that describe its pixels.
_TIFF_BITS, _TIFF_COMPRESSION, _TIFF_PLANES, _TIFF_TILE_WIDTH = 258, 259, 284, 322
_DEFLATE = (8, 32946)
_ZEROS, _SECTOR = bytes(64), bytes(512)
_ZEROS_SAID = "compressed pixels are overwritten by zeros"
_ZEROS_OF_PIXELS = "pixels are zeros from the middle of a row on"
_WEBP_BEGIN, _WEBP_LOSSLESS, _WEBP_LOSSY = b"RIFF", b"VP8L", b"VP8 "
# An intact sector of zeros encodes at least this many equal pixels, in a flat photograph with codes of a few bits.
_EQUAL_PIXELS = 1024
# With loss a flat photograph takes a byte for 550 pixels.
_EQUAL_FOR_ZERO = 100
# Channels of a PNG by the type of its colours, and how much of it is decompressed at once.
_PNG_CHANNELS, _AT_ONCE = {2: 3, 4: 2, 6: 4}, 1 << 24
_TIFF_PIXELS = ((273, 279), (324, 325))
# Disks and file systems lose multiples of this many bytes.
_SECTOR_BYTES = 512
# Least share of a row above lost pixels that is not black.
_LEAST_BRIGHT = 0.5
_BROADEST_BORDER = 0.15
# A border that begins with a row may have dark pixels over this share at the end of the row.
_END_OF_A_ROW = 0.05
_ITEMS_OF_HEVC = (b"hvc1", b"hev1")
_WITH_TYPES = 2


def fault_of(path: Path) -> str | None:
    """Damage within an image file, in words: sectors that became zeros, parts of another file; None for none.

    `is_complete` also detects files that are cut off.

    Raises
    ------
    ImageError
        Where the file is not an image.
    """
    if path.suffix.lower() in (".tif", ".tiff"):
        with open_image(path) as image, path.open("rb") as file:
            try:
                return _damage_of_tiff(image, file)
            except (TypeError, ValueError, OverflowError):
                return "its tags do not say where its pixels are"
    if path.suffix.lower() in HEIC_SUFFIXES:
        return _ZEROS_SAID if has_zeros(path.read_bytes()) else None
    with path.open("rb") as file:
        begin = file.read(len(_PNG_BEGIN))
        if begin == _PNG_BEGIN:
            return _damage_of_png(file)
        if begin.startswith(_WEBP_BEGIN):
            return _damage_of_webp(path, file)
        return jpeg_fault(begin + file.read()) if begin.startswith(_JPEG_BEGIN) else None


def _damage_of_png(file: BinaryIO) -> str | None:
    """Damage by the checksums of the chunks that pixels come from, and by the number of pixels in them."""
    header, stream, num_bytes = b"", zlib.decompressobj(), 0
    while len(head := file.read(8)) == 8 and head[4:] != b"IEND":
        length = int.from_bytes(head[:4], "big")
        if head[4:] not in _PNG_PIXELS:
            file.seek(length + 4, 1)
            continue
        content = file.read(length)
        if len(content) < length or zlib.crc32(content, zlib.crc32(head[4:])) != int.from_bytes(file.read(4), "big"):
            return "the checksum of a chunk does not match"
        if head[4:] == b"IHDR":
            header = content
        while head[4:] == b"IDAT" and content and not stream.eof:
            try:
                num_bytes += len(stream.decompress(content, _AT_ONCE))
            except zlib.error:
                return "its compressed pixels cannot be decoded"
            content = stream.unconsumed_tail
    return None if stream.eof and num_bytes >= _bytes_of_png(header) else "the compressed pixels end early"


def _bytes_of_png(header: bytes) -> int:
    """Bytes of the pixels of a PNG with a filter for each row; those of the first pass if interlaced."""
    if len(header) < 13:
        return 0
    width, height = (int.from_bytes(header[i : i + 4], "big") for i in (0, 4))
    if header[12]:
        width, height = -(-width // 8), -(-height // 8)
    return height * (1 + -(-width * header[8] * _PNG_CHANNELS.get(header[9], 1) // 8))


def _damage_of_webp(path: Path, file: BinaryIO) -> str | None:
    """Damage by sectors of zeros in compressed pixels that are not equal over as many; metadata may have them."""
    file.seek(12)
    while len(head := file.read(8)) == 8:
        length = int.from_bytes(head[4:], "little")
        if head[:4] in (_WEBP_LOSSLESS, _WEBP_LOSSY):
            zeros = _longest_zeros(file.read(length))
            if zeros < len(_SECTOR):
                return None
            with open_image(path) as image:
                try:
                    pixels = np.asarray(image.convert("RGB")).reshape(-1, 3)
                except (OSError, ValueError):
                    return "its compressed pixels cannot be decoded"
            changes = np.flatnonzero((pixels[1:] != pixels[:-1]).any(axis=1))
            longest = int(np.diff(changes, prepend=-1, append=len(pixels) - 1).max())
            equal = _EQUAL_PIXELS if head[:4] == _WEBP_LOSSLESS else _EQUAL_FOR_ZERO * zeros
            return _ZEROS_SAID if longest < equal else None
        # Chunks begin at even bytes.
        file.seek(length + length % 2, 1)
    return None


def _longest_zeros(data: bytes) -> int:
    """The length of the longest run of zeros of a sector or more; 0 without one."""
    longest, at = 0, 0
    while (at := data.find(_SECTOR, at)) >= 0:
        begin = at
        while data.startswith(_SECTOR, at):
            at += len(_SECTOR)
        longest = max(longest, at - begin)
    return longest


def _damage_of_tiff(image: Image.Image, file: BinaryIO) -> str | None:
    """Damage by zeros in compressed strips or tiles, more than any compression writes, and by deflate's checksum."""
    tags = getattr(image, "tag_v2", {})
    compression = tags.get(_TIFF_COMPRESSION, 1)
    if compression == 1:
        return _ZEROS_OF_PIXELS if _has_lost_pixels(image, tags, file) else None
    for where, length in _TIFF_PIXELS:
        for start, count in zip(tags.get(where, ()), tags.get(length, ()), strict=False):
            file.seek(start)
            strip = file.read(count)
            if compression not in _DEFLATE:
                if strip.endswith(_ZEROS) or strip.find(_SECTOR) >= 0:
                    return _ZEROS_SAID
                continue
            if strip.endswith(_ZEROS):
                return _ZEROS_SAID
            try:
                zlib.decompress(strip)
            except zlib.error:
                return "its compressed pixels cannot be decoded"
    return None


def _has_lost_pixels(image: Image.Image, tags: Mapping, file: BinaryIO) -> bool:
    """Whether the pixels of an uncompressed TIFF have zeros where they were lost; of strips that follow each other."""
    per_pixel = tags.get(_TIFF_BITS, (8,))
    for (where, length), width in zip(_TIFF_PIXELS, (image.width, tags.get(_TIFF_TILE_WIDTH, 0)), strict=True):
        starts, counts = np.array(tags.get(where, ()), np.int64), np.array(tags.get(length, ()), np.int64)
        bits = width * (per_pixel[0] if tags.get(_TIFF_PLANES, 1) != 1 else sum(per_pixel))
        if len(starts) == 0 or len(starts) != len(counts) or bits < 8:
            continue
        if (starts[1:] != (starts + counts)[:-1]).any():
            continue
        file.seek(int(starts[0]))
        pixels = np.frombuffer(file.read(int(counts.sum())), np.uint8)
        return has_lost_pixels(pixels, -(-bits // 8), max(bits // width // 8, 1), int(starts[0]))
    return False


def is_complete(path: Path) -> bool:
    """Whether the structure of an image file proves that nothing is cut off.

    Raises
    ------
    ImageError
        Where the file is not an image.
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
    """End of the last of the boxes of a HEIC file: the end of a complete one."""
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


def has_lost_pixels(pixels: np.ndarray, row: int, pixel: int, offset: int) -> bool:
    """Whether pixels (N,) uint8 end in zeros within a row, or have sectors of zeros.

    ``row`` and ``pixel`` are the bytes of these, ``offset`` is where the pixels begin in their file [bytes].
    """
    return _ends_within_a_row(pixels, row, pixel, offset) or _has_zero_sectors(pixels, row, offset)


def _ends_within_a_row(pixels: np.ndarray, row: int, pixel: int, offset: int) -> bool:
    # From the end, row by row: most images have no zeros there.
    end = len(pixels)
    while end > 0 and not pixels[max(end - row, 0) : end].any():
        end -= row
    if end <= 0:
        return False
    begin = max(end - row, 0)
    last = begin + int(np.flatnonzero(pixels[begin:end])[-1]) + 1
    column, above = last % row, last - row
    if -last % row < _END_OF_A_ROW * row or above < 0 or len(pixels) - last < row + _SECTOR_BYTES:
        return False
    # A picture that was put onto another may have a border that falls by less than a row over its width, but begins
    # it with a pixel, and is not broad.
    as_border = last % pixel == 0 and (last + offset) % _SECTOR_BYTES != 0
    if as_border and len(pixels) - last < _BROADEST_BORDER * len(pixels):
        return False
    begun = pixels[last - column : last]
    row_above = pixels[above : above + row - column]
    return bool(min(np.count_nonzero(begun) / len(begun), np.count_nonzero(row_above) / len(row_above)) > _LEAST_BRIGHT)


def _has_zero_sectors(pixels: np.ndarray, row: int, offset: int) -> bool:
    """Whether zeros begin and end where sectors of the file do, with pixels before and behind, within rows."""
    first = -offset % _SECTOR_BYTES
    num = (len(pixels) - first) // _SECTOR_BYTES
    if num < 3:
        return False
    is_zero = np.asarray(pixels[first : first + num * _SECTOR_BYTES].reshape(num, _SECTOR_BYTES).max(axis=1) == 0)
    begins = np.flatnonzero(is_zero[1:] & ~is_zero[:-1]) + 1
    ends = np.flatnonzero(is_zero[:-1] & ~is_zero[1:]) + 1
    if len(begins) == 0 or len(ends) == 0:
        return False
    for begin in begins:
        behind = ends[ends > begin]
        if len(behind) == 0:
            break
        at, to = first + int(begin) * _SECTOR_BYTES, first + int(behind[0]) * _SECTOR_BYTES
        above = pixels[max(at - row, 0) : max(min(to - row, at), 0)]
        within_rows = at % row and to % row and np.count_nonzero(above) > _LEAST_BRIGHT * len(above)
        if pixels[at - 1] and pixels[to] and within_rows:
            return True
    return False


def has_zeros(data: bytes) -> bool:
    """Whether a picture of a HEIC file has runs of zeros; False for other pictures and unknown boxes."""
    for kind, at, end in _boxes(data, 0, len(data)):
        if kind == b"meta":
            inner = {name: (begin, to) for name, begin, to in _boxes(data, at + 4, end)}
            if b"iinf" not in inner or b"iloc" not in inner:
                return False
            try:
                pictures = _pictures(data, *inner[b"iinf"])
                places = list(_extents(data, inner[b"iloc"][0], pictures))
            except IndexError:
                return False
            # Length fields between units have zeros too, no more than four.
            return any(data.find(_ZEROS, begin, to) >= 0 for begin, to in places)
    return False


def _boxes(data: bytes, at: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Kind of each box, and where its contents begin and end."""
    while at + 8 <= end:
        length, kind, head = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8], 8
        if length == 1:
            length, head = int.from_bytes(data[at + 8 : at + 16], "big"), 16
        if length == 0:
            length = end - at
        if length < head:
            return
        yield kind, at + head, min(at + length, end)
        at += length


def _pictures(data: bytes, at: int, end: int) -> set[int]:
    """Numbers of the items that are pictures of HEVC."""
    found = set()
    head = 4 + (2 if data[at] == 0 else 4)
    for kind, begin, _ in _boxes(data, at + head, end):
        if kind != b"infe" or data[begin] < _WITH_TYPES:
            continue
        wide = 2 if data[begin] == _WITH_TYPES else 4
        number = int.from_bytes(data[begin + 4 : begin + 4 + wide], "big")
        if data[begin + 6 + wide : begin + 10 + wide] in _ITEMS_OF_HEVC:
            found.add(number)
    return found


def _extents(data: bytes, at: int, items: set[int]) -> Iterator[tuple[int, int]]:
    """Extents of the items in the file."""
    version, sizes = data[at], (data[at + 4] >> 4, data[at + 4] & 15, data[at + 5] >> 4, data[at + 5] & 15)
    of_offset, of_length, of_base, of_index = sizes
    wide = 2 if version < _WITH_TYPES else 4
    at += 6

    def number(size: int) -> int:
        nonlocal at
        at += size
        if at > len(data):
            raise IndexError
        return int.from_bytes(data[at - size : at], "big")

    for _ in range(number(wide)):
        item = number(wide)
        in_file = version == 0 or number(2) & 15 == 0
        number(2)
        base = number(of_base)
        for _ in range(number(2)):
            if version > 0:
                number(of_index)
            begin = base + number(of_offset)
            length = number(of_length)
            if item in items and in_file:
                yield begin, begin + length if length else len(data)
