"""Zeros where pixels of an uncompressed image were lost: to the end of its data, or in sectors of a disk.

Black borders of mosaics, circles of fisheye lenses and masks are zeros too. They begin and end where a row does, or
row by row at other columns; what was lost begins within a row, below one that has pixels there, and goes on for rows.
"""

from __future__ import annotations

import numpy as np

# Disks and file systems lose multiples of so many bytes.
_SECTOR = 512
# Of a row above lost pixels so much is not black.
_LEAST_BRIGHT = 0.5
_BROADEST_BORDER = 0.15
# A border that begins with a row may have dark pixels over so much of its end.
_END_OF_A_ROW = 0.05


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
    if -last % row < _END_OF_A_ROW * row or above < 0 or len(pixels) - last < row + _SECTOR:
        return False
    # A picture that was put onto another may have a border that falls by less than a row over its width, but begins
    # it with a pixel, and is not broad.
    as_border = last % pixel == 0 and (last + offset) % _SECTOR != 0
    if as_border and len(pixels) - last < _BROADEST_BORDER * len(pixels):
        return False
    begun = pixels[last - column : last]
    rest = pixels[above : above + row - column]
    return bool(min(np.count_nonzero(begun) / len(begun), np.count_nonzero(rest) / len(rest)) > _LEAST_BRIGHT)


def _has_zero_sectors(pixels: np.ndarray, row: int, offset: int) -> bool:
    """Whether zeros begin and end where sectors of the file do, with pixels before and behind, within rows."""
    first = -offset % _SECTOR
    num = (len(pixels) - first) // _SECTOR
    if num < 3:
        return False
    is_zero = np.asarray(pixels[first : first + num * _SECTOR].reshape(num, _SECTOR).max(axis=1) == 0)
    begins = np.flatnonzero(is_zero[1:] & ~is_zero[:-1]) + 1
    ends = np.flatnonzero(is_zero[:-1] & ~is_zero[1:]) + 1
    if len(begins) == 0 or len(ends) == 0:
        return False
    for begin in begins:
        behind = ends[ends > begin]
        if len(behind) == 0:
            break
        at, to = first + int(begin) * _SECTOR, first + int(behind[0]) * _SECTOR
        above = pixels[max(at - row, 0) : max(min(to - row, at), 0)]
        within_rows = at % row and to % row and np.count_nonzero(above) > _LEAST_BRIGHT * len(above)
        if pixels[at - 1] and pixels[to] and within_rows:
            return True
    return False
