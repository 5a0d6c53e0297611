"""Whitened directions of views, and the test of a view against the solution that it is part of."""

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se_n

# Directions with less than this share of a view's largest information count as not measured by it: a numerical
# rank.
_RANK_TOLERANCE = 1e-10


def whitening(information: Array, scale: Array | None = None) -> tuple[Array, NDArray[np.bool_]]:
    """``L`` (V, p, p) with ``L @ A @ L.T`` of information A the identity where it is measured, (V, p).

    Args:
        information: (V, p, p) A.
        scale: (V, p) diagonal relative to which a direction counts as measured; that of A if left out.
    """
    # Metres and radians do not compare: scale to a unit diagonal first.
    diagonal = np.diagonal(information, axis1=-2, axis2=-1) if scale is None else scale
    size = np.sqrt(np.maximum(diagonal, 0))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(information / size[..., :, None] / size[..., None, :])
    measured = values > _RANK_TOLERANCE * np.maximum(values[..., -1:], 0 if scale is None else 1)
    root = np.where(measured, values, 1.0) ** -0.5 * measured
    return root[..., :, None] * se_n.transpose(vectors) / size[..., None, :], measured


def consistency_statistic(
    information: Array, reduction: Array, gradient: Array, min_redundancy: float, *, predicted: bool = False
) -> tuple[Array, NDArray[np.intp]]:
    """Test statistic of each view against the solution that it is part of, or that predicts it.

    Source: Baarda, "A testing procedure for use in geodetic networks", 1968.

    Args:
        information: (V, p, p) A of each view.
        reduction: (V, p, p) A P A, with the covariance P of the solution in the view's parameters.
        gradient: (V, p) of each view at the solution; its covariance is A - A P A, or A + A P A if predicted.
        min_redundancy: least redundancy number of a direction, its share of A that the other views determine.
        predicted: whether the solution is without the views' contributions.

    Returns:
        Squared Mahalanobis distances (V,) of the gradients from zero, and their degrees of freedom (V,), without
        directions of smaller redundancy.
    """
    whiten, measured = whitening(information)
    by_solution = whiten @ reduction @ se_n.transpose(whiten)
    redundancy = measured[..., :, None] * np.eye(measured.shape[-1]) + (by_solution if predicted else -by_solution)
    values, axes = np.linalg.eigh((redundancy + se_n.transpose(redundancy)) / 2)
    checked = values > min_redundancy
    along = (se_n.transpose(axes) @ whiten @ gradient[..., None])[..., 0]
    squared = np.sum(checked * along**2 / np.where(checked, values, 1.0), axis=-1)
    return squared, np.asarray(checked.sum(axis=-1), dtype=np.intp)
