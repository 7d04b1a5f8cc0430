"""A solver for small linear systems that never fails."""

from shapecat.arrays import F8
from shapecat.jit import kernel

__all__ = ["solve"]

_SINGULAR = 1e-10


@kernel(inner=True)
def solve(A: F8, b: F8) -> None:
    """Solve A x = b in place for a symmetric positive semidefinite matrix (n, n): b becomes x.

    The method is Gaussian elimination. An unknown that the equations do not determine becomes 0.
    """
    size = b.size
    for k in range(size):
        own = A[k, k]
        for j in range(k):
            A[k, j] = 0.0
        if not own > 0.0:
            A[k, :] = 0.0
            b[k] = 0.0
            continue
        for i in range(k + 1, size):
            factor = A[i, k] / own
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
