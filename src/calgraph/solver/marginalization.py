"""Marginalisation of a bias that is common to all measurements of a view or scan.

The errors of such measurements are correlated, so that more of them do not average out. The bias is an unknown
with a Gaussian prior, eliminated from the normal equations (Schur complement).
"""

import numpy as np

from calgraph.geometry import Array, se_n

# Cube of the trace of a 3 x 3 matrix over its determinant up to which its inverse is computed by cofactors: these
# lose as many digits as the ratio has, and 6 of 16 are left.
_MAX_CANCELLATION = 1e10
# Trace of other matrices up to which they are decomposed without symmetry, which leaves 6 digits, too.
_MAX_TRACE = 1e10


def marginalize_bias(information: Array, gradient: Array, cost: Array, prior: Array) -> tuple[Array, Array, Array]:
    """Normal equations of V views with their biases marginalised: ``A - A P A = (I + A Q)⁻¹ A`` and ``b - A P b``.

    Args:
        information: (V, q, q) A.
        gradient: (V, q) b.
        cost: (V,).
        prior: (n, n) or (V, n, n) covariance Q of the bias of the first n parameters, which may be singular.

    Returns:
        (V, q, q), (V, q) and (V,).
    """
    A, b, n = information, gradient, prior.shape[-1]
    to_bias, b_bias = A[:, :, :n], b[:, :n]
    P = compute_bias_covariance(to_bias[:, :n], prior)
    shift = (P @ b_bias[..., None])[..., 0]
    return (
        A - to_bias @ P @ se_n.transpose(to_bias),
        b - (to_bias @ shift[..., None])[..., 0],
        cost - 0.5 * np.sum(b_bias * shift, axis=-1),
    )


def marginalize_independent_biases(
    information: Array, gradient: Array, cost: Array, variances: Array
) -> tuple[Array, Array, Array]:
    """:func:`marginalize_bias` with independent biases of these variances (n,), one after the other: faster."""
    # Views along the last axis: loops over the short axes take several times as long.
    A, b, cost = np.moveaxis(information, 0, -1).copy("C"), gradient.T.copy("C"), cost.copy()
    for i, variance in enumerate(variances):
        b_bias, weight = b[i].copy(), variance / (1 + variance * A[i, i])
        gain = weight * A[i]
        A -= gain[:, None] * A[i]
        b -= gain * b_bias
        cost -= 0.5 * weight * b_bias**2
    return np.moveaxis(A, -1, 0).copy("C"), b.T.copy("C"), cost


def compute_bias_covariance(information: Array, prior: Array) -> Array:
    """Posterior covariances P (V, n, n) of biases, ``(I + Q A)⁻¹ Q``; the most likely bias is ``-P b``.

    Args:
        information: (V, n, n) A.
        prior: (n, n) or (V, n, n) Q, which may be singular.
    """
    matrix = np.eye(prior.shape[-1]) + prior @ information
    trace = np.trace(matrix, axis1=-2, axis2=-1)
    if matrix.shape[-1] == 3:
        cofactors, determinant = _expand_3x3(matrix)
        inaccurate = np.abs(determinant) * _MAX_CANCELLATION < trace**3
        inverse = (cofactors / np.where(inaccurate, 1.0, determinant)).T.reshape(matrix.shape)
    else:
        inaccurate = trace > _MAX_TRACE
        inverse = np.linalg.inv(np.where(inaccurate[..., None, None], np.eye(prior.shape[-1]), matrix))
    P = inverse @ prior
    P = (P + se_n.transpose(P)) / 2
    if inaccurate.any():
        Q = np.broadcast_to(prior, matrix.shape)
        P[inaccurate] = _eliminate_symmetrically(information[inaccurate], Q[inaccurate])
    return np.asarray(P)


def _expand_3x3(A: Array) -> tuple[Array, Array]:
    """Cofactors (9, V), whose ratio to the determinants is the inverse, and determinants (V,) of (V, 3, 3).

    Several times as fast as a decomposition.
    """
    a, b, c, d, e, f, g, h, i = A.reshape(-1, 9).T
    cofactors = np.stack(
        [
            *(e * i - f * h, c * h - b * i, b * f - c * e),
            *(f * g - d * i, a * i - c * g, c * d - a * f),
            *(d * h - e * g, b * g - a * h, a * e - b * d),
        ]
    )
    return cofactors, a * cofactors[0] + b * cofactors[3] + c * cofactors[6]


def _eliminate_symmetrically(information: Array, prior: Array) -> Array:
    """:func:`compute_bias_covariance` of any condition: ``L (I + Lᵀ A L)⁻¹ Lᵀ`` with ``Q = L Lᵀ``."""
    variances, axes = np.linalg.eigh(prior)
    L = axes * np.sqrt(np.maximum(variances, 0.0))[..., None, :]
    values, vectors = np.linalg.eigh(se_n.transpose(L) @ information @ L)
    root = L @ vectors / np.sqrt(1 + np.maximum(values, 0.0))[..., None, :]
    return np.asarray(root @ se_n.transpose(root))
