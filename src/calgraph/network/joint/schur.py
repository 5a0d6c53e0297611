"""Elimination of a body's path and shape from the normal equations by the Schur complement.

A control point of a path is coupled with the three after it only: the path's matrix is banded, and the elimination
takes time proportional to the length of the path. Source: Golub and Van Loan, "Matrix computations", 2013,
section 4.3.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from calgraph.geometry import Array, se_n


@dataclass(frozen=True, eq=False)
class BodyEquations:
    """One body's part of the normal equations: K control points, and L scanners that measured it."""

    band: Array
    """(K, 4, 3, 3) blocks between each control point and itself and the three after it."""
    gradient: Array
    """(K, 3)."""
    border: Array
    """(K, 3, B + UL) between control points and, in this order, the B parameters of the body's shape and the U
    unknowns of each scanner."""
    corner: Array
    """(B + UL, B + UL) of shape and scanners."""
    corner_gradient: Array
    """(B + UL,)."""
    shape_count: int
    """B."""
    cost: float = 0.0
    """Half the squared residuals at the state."""

    @classmethod
    def zeros(cls, count: int, shape_count: int, of_scanners: int) -> "BodyEquations":
        """The equations without terms: K control points, B parameters of shape, UL unknowns of scanners."""
        size = shape_count + of_scanners
        return cls(
            np.zeros((count, 4, 3, 3)),
            np.zeros((count, 3)),
            np.zeros((count, 3, size)),
            np.zeros((size, size)),
            np.zeros(size),
            shape_count,
        )

    def follow(self, substitution: Array) -> tuple[Array, Array]:
        """Information (UL, UL) and gradient (UL,) of the scanners where path and shape follow them.

        Args:
            substitution: S (3K + B, UL): a step of the scanners is followed by ``-S @ step``. With that of these
                equations the result is the Schur complement.
        """
        B, size = self.shape_count, 3 * len(self.band)
        border = np.concatenate([self.border[:, :, B:].reshape(size, -1), self.corner[:B, B:]])
        by_substitution = self._expand_inner() @ substitution - border
        mixed = border.T @ substitution
        return (
            self.corner[B:, B:] - mixed + substitution.T @ by_substitution,
            self.corner_gradient[B:]
            - substitution.T @ np.concatenate([self.gradient.ravel(), self.corner_gradient[:B]]),
        )

    def _expand_inner(self) -> Array:
        """(3K + B, 3K + B) of path and shape, dense."""
        B, count = self.shape_count, len(self.band)
        path, points = np.zeros((count, 3, count, 3)), np.arange(count)
        for apart in range(min(4, count)):
            earlier, later = points[: count - apart], points[apart:]
            path[later, :, earlier] = se_n.transpose(self.band[: count - apart, apart])
            path[earlier, :, later] = self.band[: count - apart, apart]
        border = self.border[:, :, :B].reshape(3 * count, B)
        return np.block([[path.reshape(3 * count, -1), border], [border.T, self.corner[:B, :B]]])

    def predict_decrease(self, step: Array, scanner_step: Array, damping: float) -> float:
        """Twice the decrease of the cost by damped steps (3K + B,) of path and shape and (UL,) of the scanners."""
        size = 3 * len(self.band)
        corner_step = np.concatenate([step[size:], scanner_step])
        path = np.sum(np.diagonal(self.band[:, 0], axis1=1, axis2=2) * step[:size].reshape(-1, 3) ** 2)
        scaled_norm = float(path + np.diagonal(self.corner) @ corner_step**2)
        slope = float(self.gradient.ravel() @ step[:size] + self.corner_gradient @ corner_step)
        return damping * scaled_norm - slope


def eliminate_path(equations: BodyEquations, damping: float) -> tuple[Array, Array]:
    """Schur complement of a body's path and shape: matrix (UL, UL) and gradient (UL,) of the scanners.

    Args:
        equations: of the body.
        damping: Levenberg–Marquardt's; the diagonal is multiplied by one plus this.
    """
    B = equations.shape_count
    factor = cholesky_banded(pack_lower_band(equations.band, damping), lower=True)
    eliminated = _substitute_forward(factor, _join_right_sides(equations))
    of_path = eliminated.T @ eliminated
    corner = equations.corner * (1 + damping * np.eye(len(equations.corner))) - of_path[:-1, :-1]
    gradient = equations.corner_gradient - of_path[:-1, -1]
    shape = np.linalg.solve(corner[:B, :B], np.concatenate([corner[:B, B:], gradient[:B, None]], axis=1))
    return corner[B:, B:] - corner[B:, :B] @ shape[:, :-1], gradient[B:] - corner[B:, :B] @ shape[:, -1]


def compute_back_substitution(equations: BodyEquations) -> Array:
    """How path and shape follow the scanners, S (3K + B, UL + 1), without damping.

    A step (UL,) of the scanners is followed by the step ``-(S[:, :-1] @ step + S[:, -1])`` of path and shape.
    """
    size, B = 3 * len(equations.band), equations.shape_count
    factor = cholesky_banded(pack_lower_band(equations.band), lower=True)
    path = cho_solve_banded((factor, True), _join_right_sides(equations))
    corner = np.concatenate([equations.corner[:B], equations.corner_gradient[:B, None]], axis=1)
    corner -= equations.border.reshape(size, -1)[:, :B].T @ path
    shape = np.linalg.solve(corner[:, :B], corner[:, B:])
    # The path depends on shape and scanners; the shape depends on the scanners.
    return np.concatenate([path[:, B:] - path[:, :B] @ shape, shape])


def _join_right_sides(equations: BodyEquations) -> Array:
    """(3K, B + UL + 1) border and gradient of the path."""
    size = 3 * len(equations.band)
    return np.concatenate([equations.border.reshape(size, -1), equations.gradient.reshape(size, 1)], axis=1)


def _substitute_forward(factor: Array, right: Array) -> Array:
    """``L⁻¹ R`` (n, m) for the lower band (12, n) of the factor L and R (n, m).

    By blocks as large as the band, that is by products of matrices; LAPACK solves for one column at a time.
    """
    width, n = factor.shape
    blocks = -(-n // width)
    band = np.zeros((width, blocks * width))
    band[:, :n], band[0, n:] = factor, 1.0
    by_block = band.reshape(width, blocks, width)
    diagonal, below = np.zeros((2, blocks, width, width))
    for offset in range(width):
        column = np.arange(width)
        row, inside = column + offset, column + offset < width
        diagonal[:, row[inside], column[inside]] = by_block[offset][:, inside]
        below[:, row[~inside] - width, column[~inside]] = by_block[offset][:, ~inside]
    inverse = np.linalg.inv(diagonal)
    solved = np.zeros((blocks, width, right.shape[1]))
    solved.reshape(blocks * width, -1)[:n] = right
    solved[0] = inverse[0] @ solved[0]
    for k in range(1, blocks):
        solved[k] = inverse[k] @ (solved[k] - below[k - 1] @ solved[k - 1])
    return np.asarray(solved.reshape(blocks * width, -1)[:n])


def substitute_back(equations: BodyEquations, damping: float, scanner_step: Array) -> Array:
    """The step (3K + B,) of path and shape after a step (UL,) of the scanners, as of :func:`eliminate_path`."""
    size, B = 3 * len(equations.band), equations.shape_count
    factor = cholesky_banded(pack_lower_band(equations.band, damping), lower=True)
    border = equations.border.reshape(size, -1)
    by_shape = border[:, :B]
    right = border[:, B:] @ scanner_step + equations.gradient.ravel()
    path = cho_solve_banded((factor, True), np.column_stack([by_shape, right]))
    corner = equations.corner[:B] * (1 + damping * np.eye(B, len(equations.corner)))
    gradient = corner[:, B:] @ scanner_step + equations.corner_gradient[:B] - by_shape.T @ path[:, -1]
    shape = np.linalg.solve(corner[:, :B] - by_shape.T @ path[:, :B], gradient)
    return -np.concatenate([path[:, -1] - path[:, :B] @ shape, shape])


def pack_lower_band(band: Array, damping: float = 0.0) -> Array:
    """The lower band (12, 3K) of a path's matrix in LAPACK's storage, with the damped diagonal."""
    count = len(band)
    lower = np.zeros((12, 3 * count))
    for offset in range(4):
        for row in range(3):
            for column in range(3):
                below = 3 * offset + row - column
                if below >= 0:
                    # The block holds (earlier, later): its transpose is below the diagonal.
                    lower[below, column::3] = band[:, offset, column, row]
    lower[0] *= 1 + damping
    return lower


def compute_path_covariance(band: Array) -> Array:
    """(K, 4, 3, 3) covariances of each control point with itself and the three after it; zero beyond the last.

    In groups of three control points, the matrix is block tridiagonal. The band of its inverse follows backwards
    from the band alone (Takahashi, Fagan and Chen, 1973).

    Args:
        band: (K, 4, 3, 3) as in :class:`BodyEquations`.
    """
    count, groups = len(band), -(-len(band) // 3)
    padded = np.zeros((3 * groups, 4, 3, 3))
    padded[:count], padded[count:, 0] = band, np.eye(3)
    diagonal, off_diagonal = np.zeros((2, groups, 3, 3, 3, 3))
    for a in range(3):
        for b in range(3):
            if a <= b:
                diagonal[:, a, :, b] = padded[a::3, b - a]
                diagonal[:, b, :, a] = se_n.transpose(padded[a::3, b - a])
            if b <= a:
                off_diagonal[:, a, :, b] = padded[a::3, 3 + b - a]
    diagonal, off_diagonal = diagonal.reshape(groups, 9, 9), off_diagonal.reshape(groups, 9, 9)
    gain = np.zeros_like(diagonal)
    for i in range(groups):
        # Schur complement of the groups before.
        diagonal[i] = np.linalg.inv(diagonal[i] - (off_diagonal[i - 1].T @ gain[i - 1] if i else 0.0))
        gain[i] = diagonal[i] @ off_diagonal[i]
    for i in reversed(range(groups - 1)):
        off_diagonal[i] = -gain[i] @ diagonal[i + 1]
        diagonal[i] -= off_diagonal[i] @ gain[i].T
    blocks = np.concatenate(
        [diagonal.reshape(groups, 3, 3, 3, 3), off_diagonal.reshape(groups, 3, 3, 3, 3)], axis=3
    )
    covariance = np.stack([blocks[:, a, :, a : a + 4].swapaxes(1, 2) for a in range(3)], axis=1)
    return np.asarray(covariance.reshape(-1, 4, 3, 3)[:count])
