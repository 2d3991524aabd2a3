"""Normal matrices: steps and inverses by Cholesky factors, in as few arrays as that takes.

A block of 2,000 photographs has 12,000 parameters, and each array of that size takes 1.2 GB. Parameters have different
units: the matrix is scaled to ones on its diagonal first.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

# Rows that are scaled at a time.
_ROWS = 256


def damped_step(normal: np.ndarray, damping: float, right: np.ndarray) -> np.ndarray:
    """Step (P,) of a normal matrix (P, P), its scaled diagonal raised by a damping, and a right side (P,).

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is singular.
    """
    matrix, scale = _scaled(normal)
    matrix[np.diag_indices_from(matrix)] += damping
    return scale * cho_solve(cho_factor(matrix, overwrite_a=True), scale * right)


def inverse(normal: np.ndarray) -> np.ndarray:
    """Inverse (P, P) of a normal matrix.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is singular.
    """
    matrix, scale = _scaled(normal)
    factor = cho_factor(matrix, overwrite_a=True)
    found = cho_solve(factor, np.eye(len(normal), order="F"), overwrite_b=True)
    _scale_rows(found, scale)
    return found


def _scaled(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A copy of the matrix scaled to ones on its diagonal, column by column as LAPACK takes it, and the scales."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    matrix = np.array(normal, order="F")
    _scale_rows(matrix, scale)
    return matrix, scale


def _scale_rows(matrix: np.ndarray, scale: np.ndarray) -> None:
    """Multiply each entry by the scales of its row and its column."""
    for first in range(0, len(matrix), _ROWS):
        columns = slice(first, first + _ROWS)
        matrix[:, columns] *= np.outer(scale, scale[columns])
