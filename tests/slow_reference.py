"""Slow optics for reference, transcribed from docstrings and textbooks; they share no code with `refract`.

Scalar Python only: angles instead of vectors, and decimal arithmetic where float64 would limit the oracle.
"""


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
