"""The covariance of a solution with errors that belong together: those of a time, of a place, and of a ring.

The adjustment takes view biases as independent. They are not: a pose of the trajectory that is wrong moves all
points of its time, furniture, frames and doors mislead all sensors that pass them, and the errors of a ring's
elevation and ranges last for the whole recording. Sums of the points' contributions to the gradient, over
intervals of time, over blocks of the world and over rings, scatter accordingly.

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
# Height of a row of elevation, rad (0.4°): less than the distance of rings of most LiDARs. Edges of rows are
# shifted by a share of it to be no tenths of a degree, as elevations of rings are: rounding does not divide rings.
_ROW, _EDGE = float(np.radians(0.4)), 0.3


@dataclass(frozen=True, eq=False)
class ClusteredScores:
    """What the points of a part contribute to the gradient."""

    scores: Array
    """(N, P)."""
    time: Array
    """(N,) s."""
    place: Array
    """(N, n) m."""
    ring: Index
    """(N,) as of :func:`label_rings`, the same in all parts."""


def widen_covariance(covariance: Array, parts: Sequence[ClusteredScores]) -> Array:
    """The covariance (P, P) of independent errors, with the scatter of contributions by time, place and ring."""
    kinds = [
        np.concatenate([sum_clusters(part.scores, label) for part, label in zip(parts, labels, strict=True)])
        for labels in ([label_times(one.time) for one in parts], [label_places(one.place) for one in parts])
    ]
    rings = np.zeros((1 + max(int(part.ring.max(initial=-1)) for part in parts), len(covariance)))
    for part in parts:
        np.add.at(rings, part.ring, part.scores)
    return widen_by_clusters(covariance, kinds, rings)


def widen_by_clusters(covariance: Array, kinds: Sequence[Array], lasting: Array | None = None) -> Array:
    """The covariance (P, P) of independent errors, with the scatter of contributions to the gradient.

    Args:
        covariance: of independent errors.
        kinds: (K, P) sums of contributions over independent clusters, of each way to cluster them.
        lasting: (K, P) those over clusters that last for the whole recording, and of which all were measured:
            their scatter counts once.
    """
    meat = SCATTER_FACTOR * sum((_sum_squares(sums) for sums in kinds), np.zeros_like(covariance))
    if lasting is not None:
        meat = meat + _sum_squares(lasting)
    return np.asarray(covariance + covariance @ meat @ covariance)


def label_times(time: Array) -> Index:
    """(N,) number of the interval that each time (N,), s, is in."""
    return np.unique(np.floor(time / _INTERVAL), return_inverse=True)[1].ravel()


def label_places(place: Array) -> Index:
    """(N,) number of the block of the world that each place (N, n), m, is in."""
    return np.unique(np.floor(place / _BLOCK), axis=0, return_inverse=True)[1].ravel()


def label_rings(sensor: Index, points: Array) -> Index:
    """(N,) number of the sensor (N,) and of the row of elevation, 0.4° high, of its points (N, n) in its frame.

    Scanners in the plane have no rings: 0.
    """
    if points.shape[1] == 2:
        return np.zeros(len(points), dtype=np.intp)
    elevation: Array = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    row = np.floor((elevation + np.pi / 2) / _ROW + _EDGE).astype(np.intp)
    return np.asarray(sensor * (int(np.pi / _ROW) + 2) + row)


def sum_clusters(scores: Array | csr_array, label: Index) -> Array:
    """(K, P) sums of scores (N, P) by label (N,)."""
    shape = int(label.max(initial=-1)) + 1, len(label)
    sums = csr_array((np.ones(len(label)), (label, np.arange(len(label)))), shape=shape) @ scores
    return np.asarray(sums if isinstance(sums, np.ndarray) else sums.toarray())


def _sum_squares(sums: Array) -> Array:
    """(P, P) expected square of the sum of independent clusters (K, P), some of which may be empty."""
    count = int(np.sum(sums.any(axis=1)))
    return np.asarray(sums.T @ sums * (count / max(count - 1, 1)))
