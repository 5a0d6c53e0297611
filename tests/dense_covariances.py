"""Covariances of networks that tests state as dense matrices."""

import numpy as np

from calgraph.geometry import Array
from calgraph.network.joint.planar_poses import NearCovariances


def relate_all(covariance: Array, count: int) -> NearCovariances:
    """Those of all pairs of scanners, from a matrix (nS, nS)."""
    n, pairs = len(covariance) // count, np.column_stack(np.triu_indices(count))
    first, second = pairs.T
    return NearCovariances(count, pairs, covariance.reshape(count, n, count, n)[first, :, second])
