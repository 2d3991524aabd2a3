"""The finite values of a column of points, also of one that is computed in portions."""

from __future__ import annotations

import math

import numpy as np

from geo.shapes import ComputedColumn, portions


def finite(values: np.ndarray | ComputedColumn, mask: np.ndarray | None = None) -> np.ndarray:
    """The finite values (n,) of a column (N,), of those in a ``mask`` (N,) bool: float64, of smaller ones float32."""
    kept = [np.zeros(0, dtype=np.float32)]
    for rows in portions(len(values)):
        part = np.asarray(values[rows])
        keep = np.isfinite(part) if mask is None else np.isfinite(part) & mask[rows]
        kept.append(part[keep].astype(np.result_type(part, np.float32)))
    return np.concatenate(kept)


def median(values: np.ndarray | ComputedColumn, mask: np.ndarray | None = None) -> float:
    """The median of the finite values of a column (N,); NaN where there is none."""
    known = finite(values, mask)
    return float(np.median(known, overwrite_input=True)) if len(known) else math.nan
