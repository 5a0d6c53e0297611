"""Covariances of the path of a body from its banded normal equations."""

import numpy as np

from calgraph.geometry import Array, se_n


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
