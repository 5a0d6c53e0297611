"""What a body says of the scanners, once its own path and size are eliminated from the normal equations.

A control point of a path meets only the three after it: its matrix is banded, and is solved in time proportional
to the length of the path. Source: Golub and Van Loan, "Matrix computations", 2013, section 4.3.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from calgraph.geometry import Array, Index


@dataclass(frozen=True, eq=False)
class BodyEquations:
    """One body's share of the normal equations; its path and size are eliminated by :func:`eliminated`."""

    band: Array
    """(K, 4, 3, 3) between each control point and the three after it."""
    gradient: Array
    """(K, 3)."""
    border: Array
    """(K, 3, 2 + 4L) between control points and, in this order, radii and the L scanners that saw the body."""
    corner: Array
    """(2 + 4L, 2 + 4L) of radii and scanners."""
    corner_gradient: Array
    """(2 + 4L,)."""
    columns: Index
    """(4L,) where those scanners' poses and clocks stand among all."""


def eliminated(equations: BodyEquations, damping: float) -> tuple[Array, Array, Array]:
    """What a body says of the scanners once its path and size are eliminated.

    Returns:
        (4L, 4L), (4L,), and ``K`` (3K + 2, 4L + 1): for a step (4L,) of the scanners, that of path and radii is
        ``-(K[:, :-1] @ step + K[:, -1])``.
    """
    count = len(equations.band)
    factor = cholesky_banded(_banded(equations.band, damping), lower=True)
    right = np.concatenate([equations.border.reshape(3 * count, -1), equations.gradient.reshape(-1, 1)], axis=1)
    path = cho_solve_banded((factor, True), right)
    reduced = right[:, :-1].T @ path
    corner = equations.corner - reduced[:, :-1]
    gradient = equations.corner_gradient - reduced[:, -1]
    size = corner[:2, :2] + damping * np.diag(np.diagonal(equations.corner)[:2])
    radii = np.linalg.solve(size, np.concatenate([corner[:2, 2:], gradient[:2, None]], axis=1))
    H = corner[2:, 2:] - corner[2:, :2] @ radii[:, :-1]
    g = gradient[2:] - corner[2:, :2] @ radii[:, -1]
    # The path follows radii and scanners; radii follow scanners.
    along = np.concatenate([path[:, 2:-1], path[:, -1:]], axis=1) - path[:, :2] @ radii
    return H, g, np.concatenate([along, radii])


def path_covariance(band: Array) -> Array:
    """(K, 4, 3, 3) covariances of each control point with itself and the three after it; zero beyond the last.

    Three points in a row depend on the three before and after them only. Of the inverse of such a matrix, what
    stands in its band follows from itself, backwards, without the rest (Takahashi, Fagan and Chen, 1973).
    """
    count, rows = len(band), -(-len(band) // 3)
    padded = np.zeros((3 * rows, 4, 3, 3))
    padded[:count], padded[count:, 0] = band, np.eye(3)
    own, ahead = np.zeros((2, rows, 3, 3, 3, 3))
    for a in range(3):
        for b in range(3):
            if a <= b:
                own[:, a, :, b] = padded[a::3, b - a]
                own[:, b, :, a] = np.swapaxes(padded[a::3, b - a], -1, -2)
            if b <= a:
                ahead[:, a, :, b] = padded[a::3, 3 + b - a]
    own, ahead = own.reshape(rows, 9, 9), ahead.reshape(rows, 9, 9)
    gain = np.zeros_like(own)
    for i in range(rows):
        # What points before have left of these.
        own[i] = np.linalg.inv(own[i] - (ahead[i - 1].T @ gain[i - 1] if i else 0.0))
        gain[i] = own[i] @ ahead[i]
    for i in reversed(range(rows - 1)):
        ahead[i] = -gain[i] @ own[i + 1]
        own[i] -= ahead[i] @ gain[i].T
    both = np.concatenate([own.reshape(rows, 3, 3, 3, 3), ahead.reshape(rows, 3, 3, 3, 3)], axis=3)
    found = np.stack([both[:, a, :, a : a + 4].swapaxes(1, 2) for a in range(3)], axis=1)
    return np.asarray(found.reshape(-1, 4, 3, 3)[:count])


def _banded(band: Array, damping: float) -> Array:
    """The lower band (12, 3K) of a path's matrix, as LAPACK stores it."""
    count = len(band)
    lower = np.zeros((12, 3 * count))
    for apart in range(4):
        for row in range(3):
            for column in range(3):
                below = 3 * apart + row - column
                if below >= 0:
                    # The block holds (earlier, later): its transpose is below the diagonal.
                    lower[below, column::3] = band[:, apart, column, row]
    lower[0] *= 1 + damping
    return lower
