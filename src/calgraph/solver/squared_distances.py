"""Squared Mahalanobis distances, also by singular covariances."""

import numpy as np

from calgraph.geometry import Array, Index, se_n


def compute_squared_distances(
    error: Array, covariance: Array, least_variance: float, scale: Array | None = None
) -> tuple[Array, Index]:
    """Squared distances (...) along the directions whose variance is not zero, and their numbers (...).

    Args:
        error: (..., n).
        covariance: (..., n, n).
        least_variance: up to which a variance is zero, in squares of the scale.
        scale: (..., n) standard deviations; those of the covariance if left out.
    """
    if scale is None:
        scale = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(covariance / (scale[..., :, None] * scale[..., None, :]))
    regular = values > least_variance
    along = (se_n.transpose(vectors) @ (error / scale)[..., None])[..., 0]
    squared = np.sum(regular * along**2 / np.where(regular, values, 1.0), axis=-1)
    return np.asarray(squared), np.asarray(regular.sum(axis=-1), dtype=np.intp)
