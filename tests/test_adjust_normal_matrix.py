"""Steps and inverses of normal matrices whose parameters have different units, and the memory that they take."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from survey.adjust.block.normal_matrix import _ROWS, damped_step, inverse


def normal_of(rng, size: int) -> np.ndarray:
    design = rng.normal(size=(size + 20, size)) * 10.0 ** rng.uniform(-3.0, 3.0, size)
    return design.T @ design


def test_a_step_solves_the_equations_with_their_scaled_diagonal_raised(rng):
    normal, right = normal_of(rng, 40), rng.normal(size=40)
    raised = normal + np.diag(0.01 * np.diag(normal))
    step, scale = damped_step(normal, 0.01, right), np.sqrt(np.diag(normal))
    # In units that make the diagonal ones, Cholesky's backward error of an entry is below 3 n + 1 roundings (N. J.
    # Higham, Accuracy and Stability of Numerical Algorithms, theorem 10.4), of n entries and with the product 4 n^2.
    bound = 4.0 * len(right) ** 2 * np.finfo(np.float64).eps * np.abs(scale * step).max()
    assert np.abs((raised @ step - right) / scale).max() < bound


def test_the_inverse_is_one_whatever_the_units(rng):
    normal = normal_of(rng, 300)
    scale = np.sqrt(np.diag(normal))
    product = inverse(normal) @ normal
    np.testing.assert_allclose(product * scale[:, None] / scale, np.eye(300), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(("take", "arrays"), [(lambda n: damped_step(n, 1e-3, n[0]), 1.0), (inverse, 2.0)])
def test_a_large_matrix_is_copied_as_rarely_as_can_be(rng, take, arrays):
    normal = normal_of(rng, 1200)
    tracemalloc.start()
    take(normal)
    peak = tracemalloc.get_traced_memory()[1] / normal.nbytes
    tracemalloc.stop()
    # And the rows that are scaled at a time; some fifty vectors of 1 / 1200 beside them are no copy.
    assert peak < arrays + _ROWS / len(normal) + 50 / len(normal)


def test_a_singular_matrix_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        inverse(np.diag([1.0, -1.0]))
