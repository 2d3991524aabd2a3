"""Statistics of a column of many points in little memory: exact order statistics by counts, which add up.

Keys of 16, 32 or 64 bits that rise with the numbers are counted 16 bits at a time, from the highest on; each pass over
the column narrows down where an order statistic lies (radix selection; D. Knuth, The Art of Computer Programming 3,
section 5.2.5).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property

import numpy as np

from geo.columns import ComputedColumn, portions

# Bits that are counted in a pass.
_BITS = 16


class ColumnStatistics:
    """Statistics of the finite values of a column (N,), floating point numbers or integers.

    Parameters
    ----------
    values : (N,)
        An array, or a `ComputedColumn`.
    mask : (N,) bool, optional
        Those that count.
    scale : [-]
        Above zero; all results are of the values times it.
    """

    def __init__(self, values: np.ndarray | ComputedColumn, mask: np.ndarray | None = None, scale: float = 1.0):
        self._values, self._mask, self._scale = values, mask, scale

    def _portions(self) -> Iterator[np.ndarray]:
        for rows in portions(len(self._values)):
            part = np.asarray(self._values[rows])
            keep = np.isfinite(part)
            if self._mask is not None:
                keep &= self._mask[rows]
            yield part if keep.all() else part[keep]

    @cached_property
    def size(self) -> int:
        """Number of the values."""
        return sum(len(part) for part in self._portions())

    @property
    def least(self) -> float:
        """The least value; there must be one."""
        return self._scale * min(float(part.min()) for part in self._portions() if len(part))

    @property
    def greatest(self) -> float:
        """The greatest value; there must be one."""
        return self._scale * max(float(part.max()) for part in self._portions() if len(part))

    @property
    def mean(self) -> float:
        """The mean; there must be a value."""
        return self._scale * sum(float(part.sum(dtype=np.float64)) for part in self._portions()) / self.size

    @property
    def median(self) -> float:
        """The median; NaN where there is no value."""
        if not self.size:
            return math.nan
        low, high = self._at([(self.size - 1) // 2, self.size // 2])
        return self._scale * 0.5 * (low + high)

    def quantiles(self, *shares: float) -> list[float]:
        """Quantiles, linear between values as `numpy.quantile` has them; there must be a value."""
        places = [share * (self.size - 1) for share in shares]
        ends = self._at([end for place in places for end in (math.floor(place), math.ceil(place))])
        between = zip(places, ends[::2], ends[1::2], strict=True)
        return [self._scale * (low + (high - low) * (place - math.floor(place))) for place, low, high in between]

    def histogram(self, edges: np.ndarray) -> np.ndarray:
        """Numbers (K - 1,) of the values between edges (K,), as `numpy.histogram` has them."""
        bins = np.asarray(edges) / self._scale
        return np.sum([np.histogram(part, bins)[0] for part in self._portions()], axis=0)

    def _at(self, ranks: list[int]) -> list[float]:
        """Values at places in ascending order, counted from zero."""
        kind = np.asarray(self._values[:0]).dtype
        width = 8 * kind.itemsize
        prefixes, left = {rank: 0 for rank in ranks}, {rank: rank for rank in ranks}
        for done in range(0, width, _BITS):
            step = min(_BITS, width - done)
            counts = {prefix: np.zeros(1 << step, dtype=np.int64) for prefix in set(prefixes.values())}
            for part in self._portions():
                keys = _keys(part).astype(np.uint64)
                shifted = keys >> np.uint64(width - done - step)
                above, digit = shifted >> np.uint64(step), (shifted & np.uint64((1 << step) - 1)).astype(np.int64)
                for prefix, count in counts.items():
                    count += np.bincount(digit[above == prefix], minlength=1 << step)
            for rank, prefix in list(prefixes.items()):
                up_to = np.cumsum(counts[prefix])
                digit_of = int(np.searchsorted(up_to, left[rank], side="right"))
                left[rank] -= int(up_to[digit_of - 1]) if digit_of else 0
                prefixes[rank] = (prefix << step) | digit_of
        return [_value(prefixes[rank], kind) for rank in ranks]


def _keys(values: np.ndarray) -> np.ndarray:
    """Unsigned integers in the order of values: the bits of floating point numbers, inverted where negative."""
    unsigned = np.dtype(f"u{values.dtype.itemsize}")
    bits = np.ascontiguousarray(values).view(unsigned)
    if values.dtype.kind == "u":
        return bits
    top = unsigned.type(1 << (8 * unsigned.itemsize - 1))
    if values.dtype.kind == "i":
        return bits ^ top
    return np.where(bits & top, ~bits, bits | top)


def _value(key: int, kind: np.dtype) -> float:
    """The value of a key."""
    top = 1 << (8 * kind.itemsize - 1)
    if kind.kind == "i":
        key ^= top
    elif kind.kind == "f":
        key = key ^ top if key & top else key ^ ((1 << (8 * kind.itemsize)) - 1)
    return float(np.array([key], dtype=f"u{kind.itemsize}").view(kind)[0])
