"""Small linear systems and eigenvalue problems, solved without SciPy's linear algebra.

For `numpy.linalg`, numba would load SciPy's linear algebra, which takes 0.1 s in each process.
"""

import numpy as np

from shapecat.arrays import F8
from shapecat.jit import kernel

__all__ = ["principal_axes", "solve"]

_SINGULAR = 1e-10
"""A diagonal element that one elimination step reduces to this fraction counts as 0."""
_SWEEPS = 8
"""Number of sweeps of the Jacobi method. Each sweep doubles the valid digits; five usually
suffice."""


@kernel(inner=True)
def solve(A: F8, b: F8) -> None:
    """Solve A x = b for a symmetric positive semidefinite matrix ``A`` (n, n).

    ``b`` (n,) becomes x; ``A`` is overwritten. The method is Gaussian elimination. An unknown that
    the equations do not determine becomes 0.
    """
    size = b.size
    for k in range(size):
        pivot = A[k, k]
        for j in range(k):
            A[k, j] = 0.0
        if not pivot > 0.0:
            A[k, :] = 0.0
            b[k] = 0.0
            continue
        for i in range(k + 1, size):
            factor = A[i, k] / pivot
            before = A[i, i]
            for j in range(k, size):
                A[i, j] -= factor * A[k, j]
            b[i] -= factor * b[k]
            if A[i, i] <= _SINGULAR * before:
                A[i, i] = 0.0
    for k in range(size - 1, -1, -1):
        for j in range(k + 1, size):
            b[k] -= A[k, j] * b[j]
        b[k] = b[k] / A[k, k] if A[k, k] > 0.0 else 0.0


@kernel(inner=True)
def principal_axes(A: F8) -> tuple[F8, F8]:
    """Return the eigenvalues (3,) and eigenvectors (3, 3) of a symmetric matrix ``A`` (3, 3).

    The values ascend; the vectors are the columns, of either sign. ``A`` is overwritten.

    Source: Golub and Van Loan 2013, 8.5 (Jacobi rotations).
    """
    vectors = np.zeros((3, 3))
    for k in range(3):
        vectors[k, k] = 1.0
    for _ in range(_SWEEPS):
        for p in range(2):
            for q in range(p + 1, 3):
                if A[p, q] == 0.0:
                    continue
                gap, twice = A[q, q] - A[p, p], 2.0 * A[p, q]
                length = np.hypot(gap, twice)
                t = twice / (gap + (length if gap >= 0.0 else -length))
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    A[k, p], A[k, q] = c * A[k, p] - s * A[k, q], s * A[k, p] + c * A[k, q]
                for k in range(3):
                    A[p, k], A[q, k] = c * A[p, k] - s * A[q, k], s * A[p, k] + c * A[q, k]
                    left, right = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = c * left - s * right, s * left + c * right
                A[p, q] = A[q, p] = 0.0
    values, axes = np.zeros(3), np.zeros((3, 3))
    for k in range(3):
        rank = 0
        for j in range(3):
            rank += A[j, j] < A[k, k] or (A[j, j] == A[k, k] and j < k)
        values[rank] = A[k, k]
        for j in range(3):  # assigning columns would compile a check of their sizes, for 2 s
            axes[j, rank] = vectors[j, k]
    return values, axes
