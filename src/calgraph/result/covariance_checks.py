"""Checks of the covariances in files: NaN and infinite elements are of directions that were not measured."""

import numpy as np

from calgraph.geometry import Array
from calgraph.io.strict_model import invalid

# Relative to standard deviations: by which elements may differ from their mirror images, as they are rounded.
_SYMMETRY_TOLERANCE = 1e-6
_EIGENVALUE_TOLERANCE = 1e-4
"""By which eigenvalues of a correlation matrix may be negative, relative to the largest: its elements are written
with 8 digits or more, and version 0.1 wrote fewer."""


def check_symmetric(covariance: Array, key: str) -> None:
    """Refuses an element that differs from its mirror image by more than rounding."""
    scale = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore"):  # infinite variances
        excess = np.abs(covariance - covariance.T) - _SYMMETRY_TOLERANCE * np.outer(scale, scale)
    wrong_at = np.argwhere((np.nan_to_num(excess, nan=0.0) > 0) & (covariance != covariance.T))
    if len(wrong_at):
        i, j = wrong_at[0]
        raise invalid(
            f"{key}[{i}][{j}]", f"must equal {key}[{j}][{i}], got {covariance[i, j]:g} and {covariance[j, i]:g}"
        )


def check_semidefinite(covariance: Array, key: str) -> None:
    """Refuses a matrix that is no covariance: one direction would have a negative variance."""
    variances = np.diag(covariance)
    measured = np.isfinite(variances) & (variances > 0)
    stddev = np.sqrt(variances[measured])
    correlation = covariance[np.ix_(measured, measured)] / stddev / stddev[:, None]
    fixed = variances == 0
    eigenvalues = np.linalg.eigvalsh(np.nan_to_num(correlation)) if len(stddev) else np.zeros(1)
    is_negative = eigenvalues[0] < -_EIGENVALUE_TOLERANCE * max(eigenvalues[-1], 1.0)
    if is_negative or np.nan_to_num(covariance[fixed]).any():
        raise invalid(
            key, "must be positive semidefinite: as it stands, a direction has a negative variance; write it again"
        )
