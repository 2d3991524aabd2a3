"""Zeros in the compressed pixels of HEIC, found by its boxes (ISO/IEC 14496-12, 23008-12).

A decoder of HEVC conceals what it cannot read. But three zero bytes never follow each other in a unit of its stream
(23008-2, 7.3.1.1: a byte of 3 is put in), so that more of them were lost.
"""

from __future__ import annotations

from collections.abc import Iterator

_ITEMS_OF_HEVC = (b"hvc1", b"hev1")
# Length fields between units have zeros too, no more than four.
_ZEROS = bytes(64)
_WITH_TYPES = 2


def has_zeros(data: bytes) -> bool:
    """Whether zeros stand in a picture of a HEIC file; False for other pictures and boxes that are not understood."""
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
