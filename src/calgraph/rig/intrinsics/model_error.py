"""The error of a lens's model, by the residuals that neighbouring corners of all views share.

Sources: Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal", Biometrika
1971; Kennedy and O'Hagan, "Bayesian calibration of computer models", JRSS B 2001.
"""

from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array

_RATIOS = np.geomspace(0.02, 100.0, 150)
"""RMS of a field over the noise that are compared: smaller ones have no effect, larger ones are a wrong model."""


@dataclass(frozen=True, eq=False)
class FieldEquations:
    """Normal equations of the coefficients of a field, from which all other parameters are eliminated."""

    information: Array
    """(F, F) of the residuals on the coefficients, each over its standard deviation in a field as large as the
    noise."""
    gradient: Array
    """(F,) by them, with the other sign, at coefficients of zero."""
    squared_residuals: float
    """At zero coefficients."""
    freedom: int
    """Number of residuals less that of the other parameters."""


@dataclass(frozen=True)
class ModelError:
    """How well a model and a field explain the residuals."""

    noise: float
    """Variance of the residuals beside the field, over that assumed."""
    field: float
    """Variance of the field, over that of the assumed noise."""
    deviance: float
    """-2 log of the likelihood, with the field marginalised, but for a constant."""


def estimate_model_error(equations: FieldEquations) -> ModelError:
    """Variances of noise and field by restricted maximum likelihood (REML).

    The likelihood is a function of their ratio alone. Its posterior median is taken, for a log-uniform prior: the
    most likely one is often zero with few views, and standard deviations would then be too small.
    """
    values, vectors = np.linalg.eigh(equations.information)
    values = np.maximum(values, 0.0)
    squared = (vectors.T @ equations.gradient) ** 2
    ratios = np.append(0.0, _RATIOS**2)[:, None]
    explained = np.sum(ratios * squared / (1 + ratios * values), axis=1)
    noise = np.maximum(equations.squared_residuals - explained, np.finfo(float).tiny) / equations.freedom
    deviance = equations.freedom * (1 + np.log(noise)) + np.sum(np.log1p(ratios * values), axis=1)
    best = int(np.argmin(deviance))
    posterior = np.cumsum(np.exp(-0.5 * (deviance - deviance[best])))
    middle = int(np.searchsorted(posterior, 0.5 * posterior[-1]))
    return ModelError(float(noise[best]), float(ratios[middle, 0] * noise[middle]), float(deviance[best]))
