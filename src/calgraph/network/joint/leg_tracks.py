"""Follows single legs through the views of all scanners of a network with approximate poses.

Clusters of all scanners are processed in order of time by one Kalman filter of constant velocity for each leg,
with white acceleration and isotropic noise, so that the covariance of a state is three numbers. A leg that one
scanner does not measure, because the other leg hides it, is mostly measured by another.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from calgraph.geometry import Array, Index, se2
from calgraph.network.tracking.association import GATE, GATED_COST
from calgraph.network.tracking.leg_clusters import LegClusters


@dataclass(frozen=True, eq=False)
class LegTrack:
    """Measured positions of one leg, in order of time."""

    times: Array
    """(N,) by the root's clock, s."""
    positions: Array
    """(N, 2) root frame, m."""
    sigma: Array
    """(N,) standard deviation of each position along each axis, m."""


@dataclass(eq=False)
class _ActiveLegs:
    """States of the legs that are being tracked: K of them."""

    times: Array = field(default_factory=lambda: np.empty(0))
    """(K,) of the last match, s."""
    mean: Array = field(default_factory=lambda: np.empty((0, 4)))
    """(K, 4) position, m, and velocity, m/s."""
    covariance: Array = field(default_factory=lambda: np.empty((0, 3)))
    """(K, 3) variances of position and velocity along an axis, at the start and end, and covariance between
    them."""
    members: list[list[int]] = field(default_factory=list)
    """Clusters of each."""

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Drops the others."""
        self.times, self.mean, self.covariance = self.times[chosen], self.mean[chosen], self.covariance[chosen]
        self.members = [members for members, kept in zip(self.members, chosen, strict=True) if kept]

    def add(self, times: Array, positions: Array, variance: Array, speed_sigma: float, index: Index) -> None:
        """Starts new ones."""
        self.times = np.concatenate([self.times, times])
        self.mean = np.concatenate([self.mean, np.column_stack([positions, np.zeros_like(positions)])])
        start = np.column_stack([variance, np.zeros_like(variance), np.full_like(variance, speed_sigma**2)])
        self.covariance = np.concatenate([self.covariance, start])
        self.members.extend([int(k)] for k in index)


# Error of the start poses, m; added to that of centres.
_POSE_SIGMA = 0.03
# Longest time without a match, s: a leg is hidden by the other one for a quarter of a stride.
_MAX_COAST_TIME = 0.4
# Matches that confirm a leg: half a second at 15 Hz, in which clutter rarely moves like a leg.
_MIN_MATCHES = 8


def track_legs(clusters: Sequence[LegClusters], T_root_scanner: Array, clock_offset: Array) -> list[LegTrack]:
    """Tracks legs over all scanners.

    Args:
        clusters: by scanner.
        T_root_scanner: (S, 3, 3) approximate poses.
        clock_offset: (S,) approximate scanner clocks minus the root clock, s.

    Returns:
        The legs that moved, in order of time.
    """
    positions = np.concatenate(
        [se2.apply(T, one.centers) for T, one in zip(T_root_scanner, clusters, strict=True)]
    )
    times = np.concatenate([one.times - offset for one, offset in zip(clusters, clock_offset, strict=True)])
    sigma = np.hypot(np.concatenate([one.sigma for one in clusters]), _POSE_SIGMA)
    before = np.cumsum([0, *(int(one.scan[-1]) + 1 if len(one.scan) else 0 for one in clusters)])
    scan = np.concatenate([one.scan + first for one, first in zip(clusters, before, strict=False)])
    # Scans in order of their mean time, each with its clusters.
    count = np.bincount(scan)
    order = np.argsort((np.bincount(scan, times) / np.maximum(count, 1))[scan], kind="stable")
    bounds = np.flatnonzero(np.diff(scan[order], prepend=-1, append=-1))
    active = _ActiveLegs()
    finished: list[list[int]] = []
    for low, high in pairwise(bounds):
        index = order[low:high]
        old = times[index[0]] - active.times > _MAX_COAST_TIME
        if old.any():
            finished.extend(members for members, ended in zip(active.members, old, strict=True) if ended)
            active.keep(~old)
        _match(active, index, times[index], positions[index], sigma[index] ** 2)
    finished.extend(active.members)
    ascending = (np.sort(np.array(one)) for one in finished if len(one) >= _MIN_MATCHES)
    ordered = (members[np.argsort(times[members], kind="stable")] for members in ascending)
    legs = [LegTrack(times[members], positions[members], sigma[members]) for members in ordered]
    return sorted((leg for leg in legs if _is_walking(leg)), key=lambda leg: float(leg.times[0]))


# Spectral density of a leg's acceleration, m²/s³: a shin changes its speed by 3 m/s twice in a stride of a
# second, with a correlation time of 0.15 s.
ACCELERATION_DENSITY = 30.0
# Maximum distance of a cluster from a prediction, m: legs side by side are 12 to 20 cm apart.
_MAX_DISTANCE = 0.25
# Prior standard deviation of a new leg's velocity along each axis, m/s: legs swing at up to 4 m/s.
_INITIAL_SPEED_SIGMA = 1.5


def _match(active: _ActiveLegs, index: Index, times: Array, positions: Array, variance: Array) -> None:
    """Updates the legs with the clusters of one scan, and starts new ones with the rest."""
    free = np.ones(len(index), dtype=bool)
    if len(active.times):
        dt = times - active.times[:, None]
        p, c, v = (active.covariance[:, k, None] for k in range(3))
        q, gap = ACCELERATION_DENSITY, np.abs(dt)
        p_ahead, c_ahead, v_ahead = (
            p + 2 * dt * c + dt * dt * v + q * gap**3 / 3,
            c + dt * v + q * dt * gap / 2,
            v + q * gap,
        )
        offset = positions - active.mean[:, None, :2] - dt[..., None] * active.mean[:, None, 2:]
        S = p_ahead + variance
        squared = np.einsum("kcd,kcd->kc", offset, offset)
        inside = (squared <= GATE * S) & (squared <= _MAX_DISTANCE**2)
        cost = np.where(inside, squared / S + 2 * np.log(S), GATED_COST)
        rows, columns = linear_sum_assignment(cost)
        good = inside[rows, columns]
        rows, columns = rows[good], columns[good]
        here = rows, columns
        gain = p_ahead[here] / S[here], c_ahead[here] / S[here]
        active.mean[rows, :2] += dt[here][:, None] * active.mean[rows, 2:] + gain[0][:, None] * offset[here]
        active.mean[rows, 2:] += gain[1][:, None] * offset[here]
        active.covariance[rows] = np.column_stack(
            [(1 - gain[0]) * p_ahead[here], (1 - gain[0]) * c_ahead[here], v_ahead[here] - gain[1] * c_ahead[here]]
        )
        active.times[rows] = times[columns]
        for row, column in zip(rows, columns, strict=True):
            active.members[row].append(int(index[column]))
        free[columns] = False
    if free.any():
        active.add(times[free], positions[free], variance[free], _INITIAL_SPEED_SIGMA, index[free])


# Shortest track that is used, s: a stride.
_MIN_DURATION = 1.0
# Minimum extent of a track that is used, m: chairs that were moved stand still.
_MIN_TRAVEL = 0.4


def _is_walking(leg: LegTrack) -> bool:
    extent = np.ptp(leg.positions, axis=0)
    return bool(leg.times[-1] - leg.times[0] >= _MIN_DURATION and np.hypot(*extent) >= _MIN_TRAVEL)
