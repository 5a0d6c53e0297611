"""Data association: which object of one scan is which of the next; birth and death of identities."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from calgraph.geometry import Array
from calgraph.network.tracking.clusters import Clusters
from calgraph.network.tracking.filtering import (
    Gaussian,
    constant_velocity,
    initial_state,
    mahalanobis_distance,
    predict,
    update,
)

# Cost of a pair outside the gate: above any true cost.
GATED_COST = 1e6


@dataclass(eq=False)
class _ActiveTracks:
    """Identities that are being tracked; the arrays are replaced at every scan."""

    state: Gaussian
    last_match: Array
    """(K,) time of the last match, s."""
    members: list[list[int]] = field(default_factory=list)
    """Clusters assigned so far."""
    missed_scans: list[int] = field(default_factory=list)
    """Scans since the last match."""


# Prior standard deviation of a new object's velocity along each axis, m/s: a person walks at 1 to 1.5 m/s.
INITIAL_SPEED_SIGMA = 1.5
# Matches that confirm an identity: clutter rarely appears five times at the predicted place.
_MIN_MATCHES = 5


def associate(objects: Clusters, center_sigma: float, acceleration_density: float) -> list[NDArray[np.intp]]:
    """Associates objects over all scans by their centroids (global nearest neighbour).

    In every scan the predicted identities and the objects are matched one to one, at the least total cost. An
    identity without a match coasts on its velocity, so that it finds the same object again after a crossing; an
    object without a match starts a new identity.

    Args:
        objects: of all scans.
        center_sigma: standard deviation of a centroid about the object's centre, m.
        acceleration_density: spectral density of the acceleration, m²/s³.

    Returns:
        For every identity its clusters, in order of time.
    """
    centroids = objects.centroids
    R = center_sigma**2 * np.eye(2)
    nothing = initial_state(np.empty((0, 2)), np.empty((0, 2, 2)), INITIAL_SPEED_SIGMA)
    active = _ActiveTracks(nothing, np.empty(0))
    finished: list[list[int]] = []
    bounds = np.flatnonzero(np.diff(objects.scan, prepend=-1, append=-1))
    scan_times = np.array([objects.times[low:high].mean() for low, high in pairwise(bounds)])
    transitions = constant_velocity(np.diff(scan_times, prepend=scan_times[:1]), acceleration_density)
    # Scans without any object need no prediction step: one over the whole gap is the same.
    for k, (low, high) in enumerate(pairwise(bounds)):
        active.state = predict(active.state, transitions.at(k))
        _prune(active, scan_times[k], finished)
        _match(active, np.arange(low, high), centroids[low:high], R, scan_times[k])
    finished.extend(members for members in active.members if len(members) >= _MIN_MATCHES)
    return [np.array(members, dtype=np.intp) for members in sorted(finished)]


# Maximum squared Mahalanobis distance of a centre from its prediction, in association and smoothing: a correct
# one exceeds it with probability 1e-3 (χ², two degrees of freedom).
GATE = 13.8


def _match(active: _ActiveTracks, index: NDArray[np.intp], centroids: Array, R: Array, now: float) -> None:
    """Updates the identities with their objects of this scan, and starts new ones with the rest."""
    squared, determinant = mahalanobis_distance(
        Gaussian(active.state.mean[:, None], active.state.covariance[:, None]), centroids[None], R
    )
    # The likelihood's determinant keeps a vague prediction from taking the object of a sharp one.
    cost = np.where(squared <= GATE, squared + np.log(determinant / (R[0, 0] * R[1, 1])), GATED_COST)
    rows, columns = linear_sum_assignment(cost)
    matched = cost[rows, columns] < GATED_COST
    rows, columns = rows[matched], columns[matched]
    if len(rows):
        updated = update(
            Gaussian(active.state.mean[rows], active.state.covariance[rows]),
            centroids[columns],
            np.broadcast_to(R, (len(rows), 2, 2)),
        )
        active.state.mean[rows], active.state.covariance[rows] = updated.mean, updated.covariance
        active.last_match[rows] = now
    active.missed_scans = [count + 1 for count in active.missed_scans]
    for row, column in zip(rows, columns, strict=True):
        active.missed_scans[row] = 0
        active.members[row].append(int(index[column]))
    unmatched = np.ones(len(centroids), dtype=bool)
    unmatched[columns] = False
    if unmatched.any():
        new = np.flatnonzero(unmatched)
        initial = initial_state(centroids[new], np.broadcast_to(R, (len(new), 2, 2)), INITIAL_SPEED_SIGMA)
        active.state = Gaussian(
            np.concatenate([active.state.mean, initial.mean]),
            np.concatenate([active.state.covariance, initial.covariance]),
        )
        active.last_match = np.append(active.last_match, np.full(len(new), now))
        active.members.extend([int(index[column])] for column in new)
        active.missed_scans.extend([0] * len(new))


# Longest prediction of an identity without a match, s: two people who pass hide each other for about 0.7 s.
_MAX_COAST_TIME = 1.0
# Maximum number of successive scans that an unconfirmed identity may miss: a person is detected in nearly every
# scan.
_MAX_MISSED_SCANS = 2


def _prune(active: _ActiveTracks, now: float, finished: list[list[int]]) -> None:
    """Ends identities that were missed for too long, and candidates that were not confirmed."""
    keep = []
    for row, (members, missed_scans) in enumerate(zip(active.members, active.missed_scans, strict=True)):
        confirmed = len(members) >= _MIN_MATCHES
        if now - active.last_match[row] <= _MAX_COAST_TIME and (confirmed or missed_scans <= _MAX_MISSED_SCANS):
            keep.append(row)
        elif confirmed:
            finished.append(members)
    if len(keep) < len(active.members):
        active.state = Gaussian(active.state.mean[keep], active.state.covariance[keep])
        active.last_match = active.last_match[keep]
        active.members = [active.members[row] for row in keep]
        active.missed_scans = [active.missed_scans[row] for row in keep]
