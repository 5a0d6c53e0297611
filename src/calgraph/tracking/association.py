"""Which object of one scan is which of the next: assignment, birth and death of identities."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from calgraph.geometry import Array
from calgraph.tracking.clusters import Clusters
from calgraph.tracking.filtering import Gaussian, distance, motion, predict, start, update

# Squared Mahalanobis distance that a true match exceeds once in 1000 (χ², two degrees of freedom).
GATE = 13.8
# A candidate becomes an identity with this many matches, and is dropped after missing so many scans in between.
_CONFIRMED = 5
_FORGIVEN = 2
# An identity out of sight is looked for this long, s: longer than walking behind another person takes.
_REMEMBERED = 1.0
_TOO_FAR = 1e6


@dataclass(eq=False)
class _Live:
    """Identities being followed; the arrays are replaced at every scan."""

    state: Gaussian
    seen: Array
    """(K,) time of the last match, s."""
    members: list[list[int]] = field(default_factory=list)
    """Clusters matched so far."""
    missed: list[int] = field(default_factory=list)
    """Scans since the last match."""


def follow(found: Clusters, spread: float, agility: float) -> list[NDArray[np.intp]]:
    """Follows the centres of mass through all scans.

    In every scan the predicted identities and the objects found are matched one to one, at the least total
    distance. An identity without a match coasts on its velocity, so that it takes up its own object again after
    a crossing; an object without a match may be a new one.

    Args:
        found: the objects of all scans.
        spread: how far a centre of mass strays from the object's centre, standard deviation, m.
        agility: spectral density of the acceleration, m²/s³.

    Returns:
        For every identity its clusters, in order of time.
    """
    centres = found.means
    R = spread**2 * np.eye(2)
    live = _Live(start(np.empty((0, 2)), np.empty((0, 2, 2))), np.empty(0))
    finished: list[list[int]] = []
    bounds = np.flatnonzero(np.diff(found.scan, prepend=-1, append=-1))
    moments = np.array([found.times[low:high].mean() for low, high in pairwise(bounds)])
    ahead = motion(np.diff(moments, prepend=moments[:1]), agility)
    # Scans without any object need no step of their own: the prediction over the whole gap is the same.
    for k, (low, high) in enumerate(pairwise(bounds)):
        live.state = predict(live.state, ahead.at(k))
        _prune(live, moments[k], finished)
        _match(live, np.arange(low, high), centres[low:high], R, moments[k])
    finished.extend(members for members in live.members if len(members) >= _CONFIRMED)
    return [np.array(members, dtype=np.intp) for members in sorted(finished)]


def _match(live: _Live, index: NDArray[np.intp], centres: Array, R: Array, now: float) -> None:
    """Updates the identities with their objects of this scan, and begins new ones with the rest."""
    squared, determinant = distance(
        Gaussian(live.state.mean[:, None], live.state.covariance[:, None]), centres[None], R
    )
    # The likelihood's determinant keeps a vague prediction from taking the object of a sharp one.
    cost = np.where(squared <= GATE, squared + np.log(determinant / np.linalg.det(R)), _TOO_FAR)
    rows, columns = linear_sum_assignment(cost)
    matched = cost[rows, columns] < _TOO_FAR
    rows, columns = rows[matched], columns[matched]
    if len(rows):
        better = update(
            Gaussian(live.state.mean[rows], live.state.covariance[rows]),
            centres[columns],
            np.broadcast_to(R, (len(rows), 2, 2)),
        )
        live.state.mean[rows], live.state.covariance[rows] = better.mean, better.covariance
        live.seen[rows] = now
    live.missed = [count + 1 for count in live.missed]
    for row, column in zip(rows, columns, strict=True):
        live.missed[row] = 0
        live.members[row].append(int(index[column]))
    fresh = np.ones(len(centres), dtype=bool)
    fresh[columns] = False
    if fresh.any():
        new = np.flatnonzero(fresh)
        born = start(centres[new], np.broadcast_to(R, (len(new), 2, 2)))
        live.state = Gaussian(
            np.concatenate([live.state.mean, born.mean]), np.concatenate([live.state.covariance, born.covariance])
        )
        live.seen = np.append(live.seen, np.full(len(new), now))
        live.members.extend([int(index[column])] for column in new)
        live.missed.extend([0] * len(new))


def _prune(live: _Live, now: float, finished: list[list[int]]) -> None:
    """Ends identities that were out of sight too long, and candidates that were not confirmed."""
    keep = []
    for row, (members, missed) in enumerate(zip(live.members, live.missed, strict=True)):
        confirmed = len(members) >= _CONFIRMED
        if now - live.seen[row] <= _REMEMBERED and (confirmed or missed <= _FORGIVEN):
            keep.append(row)
        elif confirmed:
            finished.append(members)
    if len(keep) < len(live.members):
        live.state = Gaussian(live.state.mean[keep], live.state.covariance[keep])
        live.seen = live.seen[keep]
        live.members = [live.members[row] for row in keep]
        live.missed = [live.missed[row] for row in keep]
