"""Derivatives in 50 digits, which those of the libraries are held against."""

import mpmath
import numpy as np


def exact_derivatives(function, numbers):
    """Jacobian (M, N) and Hessian (M, N, N) of M numbers by N: by differences in 50 digits, of which 20 are left.

    ``function`` takes a list of numbers of mpmath and returns one.
    """
    with mpmath.workdps(50):
        at, step, size = [mpmath.mpf(v) for v in numbers], mpmath.mpf(10) ** -12, range(len(numbers))

        def moved(*which):
            shifted = list(at)
            for index, sign in which:
                shifted[index] += sign * step
            return np.array(function(shifted), dtype=object)

        once = {(i, s): moved((i, s)) for i in size for s in (-1, 1)}
        first = np.stack([(once[i, 1] - once[i, -1]) / (2 * step) for i in size], axis=-1)
        second = np.empty((len(first), len(numbers), len(numbers)), dtype=object)
        for i in size:
            for j in range(i + 1):
                corners = [s * t * moved((i, s), (j, t)) for s in (-1, 1) for t in (-1, 1)]
                second[:, i, j] = second[:, j, i] = sum(corners) / (4 * step * step)
        return first.astype(float), second.astype(float)


def worst(found, exact):
    """Largest error as a part of the largest derivative of the same number."""
    size = np.abs(exact).reshape(len(exact), -1).max(axis=-1).reshape(-1, *[1] * (exact.ndim - 1))
    return (np.abs(found.numpy() - exact) / np.maximum(size, 1e-3)).max()
