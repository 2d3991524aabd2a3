"""Slow optics for reference, transcribed from docstrings and textbooks; they share no code with `refract`.

Scalar Python only: angles instead of vectors, and decimal arithmetic where float64 would limit the oracle.
"""

from __future__ import annotations

from decimal import Decimal, localcontext


def least_path_crossing(D: float, H: float, h: float, n: float) -> float:
    """Distance [m] along the surface from the camera's foot to the crossing, by Fermat's principle alone.

    Minimises the optical path ``sqrt(H^2 + r^2) + n sqrt(h^2 + (D - r)^2)`` over ``r`` in [0, D] by ternary
    search. The minimum of a function is found only to the root of the arithmetic's precision, so the search
    runs in 60 decimal digits and ends at 1e-25 of D.
    """
    with localcontext() as context:
        context.prec = 60
        D, H, h, n = (Decimal(v) for v in (D, H, h, n))

        def optical_path(r):
            return (H * H + r * r).sqrt() + n * (h * h + (D - r) * (D - r)).sqrt()

        low, high = Decimal(0), D
        while high - low > D * Decimal("1e-25"):
            third = (high - low) / 3
            if optical_path(low + third) < optical_path(high - third):
                high -= third
            else:
                low += third
        return float((low + high) / 2)


def meeting_of_lines(origins, directions) -> list[float]:
    """Point nearest to all lines, by the normal equations of ``sum |(I - d d^T)(x - o)|^2`` and Cramer's rule."""
    A = [[0.0] * 3 for _ in range(3)]
    b = [0.0] * 3
    for o, d in zip(origins, directions, strict=True):
        for i in range(3):
            for j in range(3):
                weight = (1.0 if i == j else 0.0) - float(d[i]) * float(d[j])
                A[i][j] += weight
                b[i] += weight * float(o[j])

    def determinant(m):
        return sum(
            m[0][i] * (m[1][(i + 1) % 3] * m[2][(i + 2) % 3] - m[1][(i + 2) % 3] * m[2][(i + 1) % 3]) for i in range(3)
        )

    whole = determinant(A)
    return [determinant([[b[i] if j == k else A[i][j] for j in range(3)] for i in range(3)]) / whole for k in range(3)]
