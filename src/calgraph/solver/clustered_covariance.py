"""The covariance of a solution with errors that belong together: those of one time, and those of one place.

The adjustment takes view biases as independent. They are not: a pose of the trajectory that is wrong moves all
points of its time, and furniture, frames and doors mislead all sensors that pass them. Sums of the points'
contributions to the gradient, over intervals of time and over blocks of the world, scatter accordingly.

Sources: Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986, for the covariance
from clusters; Cameron, Gelbach and Miller, "Robust inference with multiway clustering", 2011, for several kinds.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from calgraph.geometry import Array, Index

# Intervals, s, and edge length of blocks of the world, m: in a second and in half a metre errors are correlated,
# in the time and the size of a room they are independent. On real scans 2 to 10 s differ by a tenth.
_INTERVAL, _BLOCK = 5.0, 3.0
# By how much the scatter is multiplied: a minute has few rooms, and errors that last through all of them, as of
# times of beams that are not stated, do not scatter. With 1 the mean squared error over the covariance is 3.3 and
# 5.1 on two sets of 15 windows of real scans, and 3.3 on simulated drives of two LiDARs; with 4 it is 1.1, 1.6 and
# 1.2. In 11 simulated halls with LiDARs it is 1.6 with 1 and 0.5 with 4; where ranges are stated to be exact, 25 s
# are 4 with 2.
SCATTER_FACTOR = 4.0


@dataclass(frozen=True, eq=False)
class ClusteredScores:
    """What the points of a part contribute to the gradient."""

    scores: Array
    """(N, P)."""
    time: Array
    """(N,) s."""
    place: Array
    """(N, n) m."""


def widen_covariance(covariance: Array, parts: Sequence[ClusteredScores]) -> Array:
    """The covariance (P, P) of independent errors, with the scatter of contributions by time and by place."""
    kinds = [
        np.concatenate([sum_clusters(part.scores, label(part)) for part in parts])
        for label in (_label_times, _label_places)
    ]
    return widen_by_clusters(covariance, kinds)


def widen_by_clusters(covariance: Array, kinds: Sequence[Array]) -> Array:
    """The covariance (P, P) of independent errors, with the scatter of contributions to the gradient.

    Args:
        covariance: of independent errors.
        kinds: (K, P) sums of contributions over independent clusters, of each way to cluster them.
    """
    meat = sum((_sum_squares(sums) for sums in kinds), np.zeros_like(covariance))
    return np.asarray(covariance + SCATTER_FACTOR * covariance @ meat @ covariance)


def _label_times(part: ClusteredScores) -> Index:
    return label_times(part.time)


def _label_places(part: ClusteredScores) -> Index:
    return label_places(part.place)


def label_times(time: Array) -> Index:
    """(N,) number of the interval that each time (N,), s, is in."""
    return np.unique(np.floor(time / _INTERVAL), return_inverse=True)[1].ravel()


def label_places(place: Array) -> Index:
    """(N,) number of the block of the world that each place (N, n), m, is in."""
    return np.unique(np.floor(place / _BLOCK), axis=0, return_inverse=True)[1].ravel()


def sum_clusters(scores: Array | csr_array, label: Index) -> Array:
    """(K, P) sums of scores (N, P) by label (N,)."""
    shape = int(label.max(initial=-1)) + 1, len(label)
    sums = csr_array((np.ones(len(label)), (label, np.arange(len(label)))), shape=shape) @ scores
    return np.asarray(sums if isinstance(sums, np.ndarray) else sums.toarray())


def _sum_squares(sums: Array) -> Array:
    """(P, P) expected square of the sum of independent clusters (K, P)."""
    count = len(sums)
    return np.asarray(sums.T @ sums * (count / max(count - 1, 1)))
