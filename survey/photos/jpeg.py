"""Completeness of the compressed pixels of a JPEG, by the count of its blocks (`survey.photos.pixels` decodes them).

A decoder that runs out of data, or has some left, continues without an error; missing parts become grey. Here the
single scan of a sequential JPEG is decoded from a stream that records how much was requested: the last block must be
decoded exactly at the end of the scan. Parts between restart markers, at which decoders resynchronise, are decoded
separately. Data replaced by other data with the same number of blocks leaves a seam. For several scans, as in
progressive JPEG, the headers show whether one is missing, and libjpeg's warnings whether one has more or fewer bytes
than its blocks need; for single scans these warnings are no evidence, since some cameras add bytes.

Two streams joined after the same number of blocks decode without a fault. But the pixel rows that meet there belong to
different scenes: right of one block in its row of blocks, and left of it in the next row. Streams joined at the
beginning of a row of blocks cannot be distinguished from two pictures above each other, or a picture above a bar.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import simplejpeg
from PIL import Image

from survey.photos.pixels import open_stream

# Differences between rows are compared by so many parts of the width.
_PARTS = 16
_FEWEST_ROWS = 8
# Smaller differences [grey levels] are not significant.
_QUIET = 1.0
# Mean logarithm of how much larger a difference is than those of the rows beside it, and the same in robust standard
# deviations. 2,580 whole photographs: above 0.3 up to 4.8, else up to 6.2; 120 that were joined: from 0.51 and 8.7.
_LEAST, _LEAST_STD = 0.45, 7.5
# Least part of the step of a seam on each side; edges of a scene have none.
_LEAST_OF_A_SIDE = 0.4
# Straight edges in a scene lie at the rows of blocks no more often than elsewhere.
_OVER_OTHER_ROWS = 0.3
_SOI, _EOI, _SOS, _DHT, _DRI = 0xD8, 0xD9, 0xDA, 0xC4, 0xDD
_SEQUENTIAL, _PROGRESSIVE = (0xC0, 0xC1), 0xC2
_RESTARTS = range(0xD0, 0xD8)
# Application data and comments, without that of Adobe, which says what the components are.
_APART = {*range(0xE0, 0xF0), 0xFE} - {0xEE}
# Bits that follow the last block fill up its byte; encoders in hardware fill up words of so many bytes.
_FILL = 4
# A decoder has so many bytes at hand when it decodes the last block.
_AHEAD = bytes(8)
# Parts between restart markers are decoded one by one if they are not more than so many.
_MOST_PARTS = 1000
_LONGEST_SIDE = 65_500
# So many bytes of zeros are more than two blocks whose 64 coefficients have the shortest code each, and no photograph.
_ZEROS, _SECTOR = bytes(64), bytes(512)
_ZEROS_SAID = "compressed pixels are overwritten by zeros"
_BLOCK = 8
_MOST_TO_GREY = 3
# libjpeg's warning about a few bytes before the end marker, which is ignored here.
_OF_THE_END = re.compile(r"Corrupt JPEG data: \d extraneous bytes before marker 0xd9")
_END = bytes([0xFF, _EOI])
_SEAM_SAID = "from one row of blocks on it shows another scene, as if parts of two files were joined"


def has_seam(grey: np.ndarray, step: int) -> bool:
    """Whether a picture (H, W) uint8 has a seam between rows of blocks, which begin every `step` rows."""
    found = _scores(grey, step, 0)
    if found is None or len(found[0]) < _FEWEST_ROWS:
        return False
    usual = float(np.median(found[0]))
    spread = 1.4826 * float(np.median(np.abs(found[0] - usual)))
    most = _most(found)
    if most < max(_LEAST, usual + _LEAST_STD * spread):
        return False
    others = (_scores(grey, step, shift) for shift in range(1, step))
    return all(other is None or _most(other) < most - _OVER_OTHER_ROWS for other in others)


def _most(found: tuple[np.ndarray, np.ndarray]) -> float:
    scores, is_seam = found
    return float(scores[is_seam].max(initial=0.0))


def _scores(grey: np.ndarray, step: int, shift: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Ratio of differences across a seam to those beside it, and whether both its sides have it; (R, N).

    By its row and the part of the width it begins in; left of this part it lies in the next row of blocks. None for
    pictures that are too small.
    """
    height, width = grey.shape
    rows = np.arange(step, height - step, step) + shift
    rows = rows[rows < height - 1]
    each = max(width // _PARTS, 1)
    num = width // each
    if len(rows) < 2 or num < _PARTS:
        return None
    above, last, first, below = (
        grey[rows + i, : num * each].astype(np.float32).reshape(len(rows), num, each) for i in (-2, -1, 0, 1)
    )
    adjacent = (np.abs(last - above).mean(axis=2) + np.abs(below - first).mean(axis=2)) / 2
    across = np.abs(first - last).mean(axis=2)
    right, left = _sums(np.log((across + _QUIET) / (adjacent + _QUIET)))
    found = (right[:-1] + left[1:]) / num
    parts = np.arange(1, num)
    of_sides = np.minimum(right[:-1, 1:-1] / (num - parts), left[1:, 1:-1] / parts)
    is_seam = of_sides > _LEAST_OF_A_SIDE * found[:, 1:-1]
    return found[:, 1:-1], is_seam


def _sums(larger: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums (R, num + 1) of values (R, num) less their median over R, right and left of each border between parts."""
    larger = larger - np.median(larger, axis=0)
    left = np.concatenate([np.zeros((len(larger), 1)), np.cumsum(larger, axis=1)], axis=1)
    return left[:, -1:] - left, left


@dataclass
class _Layout:
    """Layout of a JPEG."""

    # Segments before the first scan that its decoder needs, but for the frame
    head: list[bytes] = field(default_factory=list)
    # marker, frame bytes: of the frame, and its content
    marker: int = 0
    frame: bytes = b""
    interval: int = 0  # Units of blocks between restart markers; 0 without them
    # list of (header, start, end): the compressed bytes of each scan, without a marker
    scans: list[tuple[bytes, int, int]] = field(default_factory=list)
    # dict: by class (0 direct, 1 alternating) and number of a Huffman table: the symbol whose code is all zeros
    first_symbol: dict[tuple[int, int], int] = field(default_factory=dict)


def jpeg_fault(data: bytes) -> str | None:
    """Fault of the compressed pixels of a JPEG, missing or surplus, in words; None where they are whole.

    Nothing is said of a JPEG whose structure is another one: of lossless and arithmetic ones.
    """
    pixels = np.frombuffer(data, dtype=np.uint8)
    layout = _layout(data, pixels)
    if layout is None or not layout.scans or layout.marker not in (*_SEQUENTIAL, _PROGRESSIVE):
        return None
    header, start, end = layout.scans[0]
    if layout.marker == _PROGRESSIVE or header[0] < layout.frame[5]:
        return _missing_scan(layout) or _scans_fault(layout, data)
    if data.find(_ZEROS, start, end) >= 0 and not _zeros_are_constant(layout):
        return _ZEROS_SAID
    if not layout.interval:
        return _scan_fault(layout, layout.frame, data[start:end], seams=True)
    fault = _restart_fault(layout, data[start:end], pixels[start:end])
    return fault if fault is not None else _seam_fault(layout, io.BytesIO(data + _END))


def _layout(data: bytes, pixels: np.ndarray) -> _Layout | None:
    """The parts of a JPEG up to its end marker, or its end; None where it has another structure."""
    found, at = _Layout(), 2
    if data[:2] != bytes([0xFF, _SOI]):
        return None
    ends = _scan_ends(pixels)
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:
            at += 1
            continue
        if marker == _EOI:
            return found
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        content, after = data[at + 4 : at + 2 + length], at + 2 + length
        if marker == _SOS:
            following = ends[np.searchsorted(ends, after) :]
            end = int(following[0]) if len(following) else len(data)
            # Number of components, two bytes of each, and three of what the scan holds of them.
            if not content or len(content) < 1 + 2 * content[0] + 3:
                return None
            found.scans.append((content, after, end))
            after = end
        elif not found.scans and marker not in (*_APART, *_SEQUENTIAL, _PROGRESSIVE, _DRI):
            found.head.append(data[at:after])
        if marker in (*_SEQUENTIAL, _PROGRESSIVE) and len(content) >= 6 + 3 * content[5]:
            found.marker, found.frame = marker, content
        elif marker == _DRI:
            found.interval = int.from_bytes(content[:2], "big")
        elif marker == _DHT:
            _read_tables(content, found.first_symbol)
        at = after
    return found if found.scans else None


def _scan_ends(pixels: np.ndarray) -> np.ndarray:
    """Position of a marker that ends a scan, with the fill bytes before it."""
    first = np.flatnonzero(pixels[:-1] == 0xFF)
    second = pixels[first + 1]
    is_end = (second != 0) & (second != 0xFF) & ~np.isin(second, _RESTARTS)
    ends = first[is_end]
    while (fill := (ends > 0) & (pixels[ends - 1] == 0xFF)).any():
        ends = ends - fill
    return ends


def _read_tables(content: bytes, first_symbol: dict[tuple[int, int], int]) -> None:
    at = 0
    while at + 18 <= len(content):
        first_symbol[content[at] >> 4, content[at] & 15] = content[at + 17]
        at += 17 + sum(content[at + 1 : at + 17])


def _zeros_are_constant(layout: _Layout) -> bool:
    """Whether zeros are blocks without any change, as black borders have them with tables made for the image."""
    header = layout.scans[0][0]
    tables = [header[2 + 2 * i] for i in range(header[0])]
    symbols = layout.first_symbol
    return all(symbols.get((0, table >> 4)) == 0 == symbols.get((1, table & 15)) for table in tables)


def _missing_scan(layout: _Layout) -> str | None:
    """Fault of a JPEG of several scans if a component lacks coefficients, or bits of them."""
    missing = {(part, i) for part in layout.frame[6 : 6 + 3 * layout.frame[5] : 3] for i in (0, 1)}
    highest = dict.fromkeys(missing, 0)
    for header, _, _ in layout.scans:
        parts, (first, last, bits) = header[1 : 1 + 2 * header[0] : 2], header[1 + 2 * header[0] :][:3]
        for part in parts:
            if bits & 15 == 0 and first == 0:
                missing.discard((part, 0))
            if bits & 15 == 0 and last > 0:
                highest[part, 1] = max(highest.get((part, 1), 0), last)
    missing -= {(part, i) for (part, i), last in highest.items() if i == 1 and last == _BLOCK**2 - 1}
    return "some of its scans are missing" if missing else None


def _scans_fault(layout: _Layout, data: bytes) -> str | None:
    """Fault of a JPEG of several scans if one has zeros, or libjpeg warns of missing or surplus bytes."""
    for header, start, end in layout.scans:
        # A scan without the mean of blocks tells in few bytes that a part of the picture has no change.
        if header[1 + 2 * header[0]] > 0 and data.find(_SECTOR, start, end) >= 0:
            return _ZEROS_SAID
    # Of four components libjpeg makes no grey.
    colours = "GRAY" if layout.frame[5] <= _MOST_TO_GREY else "CMYK"
    try:
        simplejpeg.decode_jpeg(
            data + _END, colorspace=colours, strict=True, min_height=1, min_width=1, min_factor=_BLOCK
        )
    except ValueError as error:
        reason = " ".join(str(error).split())[:100]
        return None if _OF_THE_END.fullmatch(reason) else reason
    return None


def _restart_fault(layout: _Layout, scan: bytes, pixels: np.ndarray) -> str | None:
    """Whether a restart marker is missing or out of order, or a part between two of them is not whole."""
    first = np.flatnonzero(pixels[:-1] == 0xFF)
    marks = first[np.isin(pixels[first + 1], _RESTARTS)]
    in_order = np.array_equal(pixels[marks + 1] - _RESTARTS.start, np.arange(len(marks)) % len(_RESTARTS))
    height, width = (int.from_bytes(layout.frame[i : i + 2], "big") for i in (1, 3))
    sampling = [layout.frame[7 + 3 * i] for i in range(layout.frame[5])]
    # A scan of one component has a block in each unit.
    across, down = (1, 1) if len(sampling) == 1 else (max(s >> 4 for s in sampling), max(s & 15 for s in sampling))
    if height == 0 or not across or not down:
        return None
    units = -(-width // (_BLOCK * across)) * -(-height // (_BLOCK * down))
    expected = -(-units // layout.interval) - 1
    if not in_order or len(marks) != expected:
        return f"{len(marks)} of {expected} restart markers are there{'' if in_order else ', out of order'}"
    if len(marks) >= _MOST_PARTS or layout.interval * _BLOCK * across > _LONGEST_SIDE:
        return None
    starts, ends = [0, *(marks + 2).tolist()], [*marks.tolist(), len(scan)]
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        num = min(layout.interval, units - i * layout.interval)
        size = (_BLOCK * down).to_bytes(2, "big") + (num * _BLOCK * across).to_bytes(2, "big")
        fault = _scan_fault(layout, layout.frame[:1] + size + layout.frame[5:], scan[start:end])
        if fault is not None:
            return fault
    return None


def _scan_fault(layout: _Layout, frame: bytes, scan: bytes, *, seams: bool = False) -> str | None:
    """Whether the blocks of a frame end before the bytes of their scan do, or its bytes before the blocks.

    With ``seams``, whether the decoded picture has one, too; without, it is decoded at an eighth of its size.
    """
    # Fill bytes may be zeros, and so may be blocks without any change, but more of them.
    stripped = max(scan.rstrip(b"\0"), scan[: -len(_ZEROS)], key=len)
    start = bytes([0xFF, _SOI]) + b"".join(layout.head)
    start += _segment(layout.marker, frame) + _segment(_SOS, layout.scans[0][0])
    tail = scan[max(len(stripped) - _FILL, 0) :] + _AHEAD
    stream = _Stream([start + stripped[:-_FILL], tail, _END])
    with open_stream(stream, "JPEG") as image:
        image.draft("L", image.size if seams else (1, 1))
        try:
            image.load()
        except OSError as error:
            return " ".join(str(error).split())[:100]
        if stream.asked == 0:
            return "there are more compressed bytes than its pixels need, as if parts of two files were joined"
        if stream.asked > 1:
            return "the compressed pixels end early"
        return _seam(layout, image) if seams else None


def _seam_fault(layout: _Layout, stream: io.BytesIO) -> str | None:
    """Whether a JPEG that decodes has a seam."""
    with open_stream(stream, "JPEG") as image:
        image.draft("L", image.size)
        try:
            return _seam(layout, image)
        except OSError as error:
            return " ".join(str(error).split())[:100]


def _seam(layout: _Layout, image: Image.Image) -> str | None:
    """Whether a decoded picture has a seam between its rows of units."""
    sampling = [layout.frame[7 + 3 * i] & 15 for i in range(layout.frame[5])]
    step = _BLOCK * (1 if len(sampling) == 1 else max(sampling))
    return _SEAM_SAID if has_seam(np.asarray(image.convert("L")), step) else None


def _segment(marker: int, content: bytes) -> bytes:
    return bytes([0xFF, marker]) + (len(content) + 2).to_bytes(2, "big") + content


class _Stream(io.BytesIO):
    """A file of parts, each of which is read only when all before it are used up.

    Attributes
    ----------
    asked : int
        How many parts were asked for after the first.
    """

    def __init__(self, parts: Sequence[bytes]):
        super().__init__()
        self._parts, self._at, self.asked = list(parts), 0, 0

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Seek in the first part only, where the head is."""
        self._at = offset if whence == io.SEEK_SET else self._at + offset
        return self._at

    def read(self, size: int | None = -1) -> bytes:
        """Bytes of one part."""
        first = self._parts[0]
        if self._at < len(first):
            found = first[self._at :] if size is None or size < 0 else first[self._at : self._at + size]
            self._at += len(found)
            return found
        if self.asked + 1 >= len(self._parts):
            return b""
        self.asked += 1
        return self._parts[self.asked]
