"""Marginalisation of a bias that is common to all measurements of a view or scan.

The errors of such measurements are correlated, so that more of them do not average out. The bias is an unknown
with a Gaussian prior, eliminated from the normal equations (Schur complement).
"""

import numpy as np

from calgraph.geometry import Array, se_n


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


def compute_bias_covariance(information: Array, prior: Array) -> Array:
    """Posterior covariances P (V, n, n) of biases, ``(I + Q A)⁻¹ Q``; the most likely bias is ``-P b``.

    Args:
        information: (V, n, n) A.
        prior: (n, n) or (V, n, n) Q, which may be singular.
    """
    matrix = np.eye(prior.shape[-1]) + prior @ information
    inverse = _invert_3x3(matrix) if matrix.shape[-1] == 3 else np.linalg.inv(matrix)
    P = inverse @ prior
    return np.asarray((P + se_n.transpose(P)) / 2)


def _invert_3x3(A: Array) -> Array:
    """Inverses of (V, 3, 3) by cofactors, several times as fast as a decomposition."""
    a, b, c, d, e, f, g, h, i = A.reshape(-1, 9).T
    cofactors = np.stack(
        [
            *(e * i - f * h, c * h - b * i, b * f - c * e),
            *(f * g - d * i, a * i - c * g, c * d - a * f),
            *(d * h - e * g, b * g - a * h, a * e - b * d),
        ]
    )
    return np.asarray((cofactors / (a * cofactors[0] + b * cofactors[3] + c * cofactors[6])).T.reshape(A.shape))
