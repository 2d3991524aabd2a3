"""Statistics of a column of points, also of one that is computed in portions."""

from __future__ import annotations

import math

import numpy as np

from geo.columns import ComputedColumn, portions


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

    def _finite(self) -> np.ndarray:
        """The values that count (n,), float32 or float64; not kept, as columns have hundreds of millions of values."""
        kept = [np.zeros(0, dtype=np.float32)]
        for rows in portions(len(self._values)):
            part = np.asarray(self._values[rows])
            keep = np.isfinite(part) if self._mask is None else np.isfinite(part) & self._mask[rows]
            kept.append(part[keep].astype(np.result_type(part, np.float32)))
        return np.concatenate(kept)

    @property
    def size(self) -> int:
        """Number of the values."""
        return len(self._finite())

    @property
    def least(self) -> float:
        """The least value; there must be one."""
        return self._scale * float(self._finite().min())

    @property
    def greatest(self) -> float:
        """The greatest value; there must be one."""
        return self._scale * float(self._finite().max())

    @property
    def mean(self) -> float:
        """The mean; there must be a value."""
        return self._scale * float(self._finite().mean(dtype=np.float64))

    @property
    def median(self) -> float:
        """The median; NaN where there is no value."""
        values = self._finite()
        return self._scale * float(np.median(values, overwrite_input=True)) if len(values) else math.nan

    def quantiles(self, *shares: float) -> list[float]:
        """Quantiles, linear between values; there must be a value."""
        return (self._scale * np.quantile(self._finite(), shares, overwrite_input=True).astype(np.float64)).tolist()

    def histogram(self, edges: np.ndarray) -> np.ndarray:
        """Numbers (K - 1,) of the values between edges (K,)."""
        return np.histogram(self._finite(), np.asarray(edges) / self._scale)[0]
