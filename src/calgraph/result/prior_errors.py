"""Errors of poses by errors of what rig.yaml states, which all recordings of one rig have in common."""

from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array


@dataclass(frozen=True, eq=False)
class PriorErrors:
    """Errors of a calibration's poses by the stated values of systematic parameters.

    Estimates of two recordings of one rig with the same board share the errors of what rig.yaml states. With the
    posterior covariance ``P`` of poses and parameters, and the information ``L`` of the priors, an error ``e`` of
    the stated values moves the estimates by ``P L e``; the covariance of the errors of two estimates a and b is
    ``P_a L P_b``.
    """

    parameters: tuple[tuple[str, str], ...]
    """Sensor or target, and quantity, of E systematic parameters."""
    poses: Array
    """(S·6, E) errors of all poses in the root's fixed axes, m and rad, by an error of one prior standard
    deviation."""

    def cross_covariance(self, other: "PriorErrors") -> Array:
        """Covariance (S·6, S'·6) of the errors of these poses with those of another calibration."""
        shared = [one for one in self.parameters if one in other.parameters]
        i = [self.parameters.index(one) for one in shared]
        j = [other.parameters.index(one) for one in shared]
        return np.asarray(self.poses[:, i] @ other.poses[:, j].T)
