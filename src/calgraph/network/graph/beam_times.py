"""When the beams of scans were measured whose messages do not state it: one after the other, or simultaneously.

Drivers leave ``time_increment`` at zero for scanners that turn, and rightly so for those whose beams are
simultaneous. Tracks distinguish them: a person whom a scanner measures a time τ after the stamp is v τ ahead of
where the tracks of others are at the stamp, with τ = s T u, where T is the time between scans, u from 0 to 1 the
share of a turn from the first beam to the person, and s is 1 or -1 for a scanner that turns, and 0 otherwise.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, select_rows
from calgraph.network.graph.network_initialization import NetworkInitialization
from calgraph.network.pairs.synchronized_tracks import TrackSamples, pair_samples, resample_tracks, to_ticks
from calgraph.network.tracking.track import ScannerTracks
from calgraph.sensors.untimed_scans import UntimedScans, decide_turn
from calgraph.solver.grouped_errors import solve_with_grouped_errors

# Samples of two scanners are of one person if they are nearer than this, m, and their velocities, m/s, differ by
# less: start poses are off by some centimetres, and a scan at 5 Hz of a person who walks by 0.3 m.
_MAX_DISTANCE, _MAX_VELOCITY_DIFFERENCE = 0.5, 0.6
# Slower people do not show times, m/s.
_MIN_SPEED = 0.4
# Time within which the errors of samples of one pair of tracks count as the same, s: a step takes 0.5 s, and
# errors of smoothed tracks last for some steps.
_ERROR_TIME = 2.0
# Factor on standard deviations: in 25 simulated networks (office, lab, turning and simultaneous), estimates of s
# scattered 1.2 to 2.5 times as much as groups of samples imply. Differences between halves of the recording come
# on top: where people walk the same ways all the time, errors of their centres look like times.
_STDDEV_FACTOR = 1.5
# Limit of samples times squared unknowns: some seconds. Samples of large networks are thinned to it.
_MAX_PRODUCTS = 2e9
# Unknowns of a scanner: x, y and rotation of its pose, its clock, and s.
_UNKNOWNS = 5


def recognize_beam_times(
    tracked: Mapping[str, ScannerTracks], initialization: NetworkInitialization, inverted: frozenset[str]
) -> dict[str, int]:
    """Decides for each connected scanner whose scans have no times, from the paths that others measured, too.

    Where the tracks of one scanner alone do not suffice, those of all that send such scans decide: they are
    usually of one kind, with one driver.

    Args:
        tracked: tracks by scanner, with the clocks and in the mountings that the poses belong to.
        initialization: start poses.
        inverted: scanners whose tracks are mirrored.

    Returns:
        By scanner, 1 if its beams follow each other in the order of the message, -1 in the opposite one, 0 if they
        are simultaneous. Scanners of which the tracks do not show it are left out.
    """
    names = [name for name in initialization.names if name in tracked]
    untimed = {name: scans for name in names if (scans := tracked[name].untimed) is not None}
    poses = dict(zip(initialization.names, initialization.solution.T_root_node, strict=True))
    samples = {name: resample_tracks(tracked[name]) for name in names} if untimed else {}
    parts = [
        part
        for i, j in combinations(range(len(names)), 2)
        for part in _linearize((names[i], names[j]), (i, j), samples, poses, untimed, inverted, len(names))
    ]
    if not parts:
        return {}
    most = int(_MAX_PRODUCTS / (_UNKNOWNS * len(names)) ** 2)
    thinned = slice(None, None, 1 + int(sum(len(part.group) for part in parts) / most))
    samples_of = _Part(
        np.concatenate([part.jacobian for part in parts])[thinned],
        np.concatenate([part.differences for part in parts])[thinned],
        _number([part.group for part in parts])[thinned],
        np.concatenate([part.ticks for part in parts])[thinned],
    )
    columns = {name: _UNKNOWNS * names.index(name) + 4 for name in untimed if name in names}
    own = _estimate_with_halves(samples_of, [[column] for column in columns.values()])
    ((common, stddev),) = _estimate_with_halves(samples_of, [list(columns.values())])
    # A common value may follow from what scanners have in common alone: it is no better known than their own are.
    stddev = max(stddev, 1 / np.sqrt(sum(1 / sigma**2 for _, sigma in own) + 1e-12))
    decided = {name: decide_turn(*value) for name, value in zip(columns, own, strict=True)}
    turns = {name: decide_turn(common, stddev) if turn is None else turn for name, turn in decided.items()}
    return {name: turn for name, turn in turns.items() if turn is not None}


@dataclass(frozen=True, eq=False)
class _Part:
    """The differences of simultaneous positions of one person in two scanners."""

    jacobian: Array
    """(M, 2, U) by the unknowns of all scanners."""
    differences: Array
    """(M, 2) m, in the root's frame."""
    group: NDArray[np.int64]
    """(M,) of samples with the same errors."""
    ticks: NDArray[np.intp]
    """(M,) times."""


def _linearize(
    names: tuple[str, str],
    nodes: tuple[int, int],
    samples: Mapping[str, TrackSamples],
    poses: Mapping[str, Array],
    untimed: Mapping[str, UntimedScans],
    inverted: frozenset[str],
    count: int,
) -> Iterator[_Part]:
    pairs = pair_samples(samples[names[0]], samples[names[1]])
    if not len(pairs):
        return
    places = pairs.x_a, pairs.x_b
    rotations = [poses[name][:2, :2] for name in names]
    x_a, x_b = (x @ R.T + poses[name][:2, 2] for x, R, name in zip(places, rotations, names, strict=True))
    v_a, v_b = (v @ R.T for v, R in zip((pairs.a.velocities[pairs.row_a], pairs.v_b), rotations, strict=True))
    difference, speed = x_a - x_b, (v_a + v_b) / 2
    rows = np.flatnonzero(
        (np.hypot(*difference.T) < _MAX_DISTANCE)
        & (np.hypot(*(v_a - v_b).T) < _MAX_VELOCITY_DIFFERENCE)
        & (np.hypot(*speed.T) > _MIN_SPEED)
    )
    if not len(rows):
        return
    rows = rows[pairs.are_mutual_nearest(rows, (difference[rows] ** 2).sum(axis=1))]
    jacobian = np.zeros((len(rows), 2, count, _UNKNOWNS))
    v = speed[rows]
    for sign, name, node, x, place in zip((1, -1), names, nodes, (x_a, x_b), places, strict=True):
        at, own = x[rows], place[rows]
        jacobian[:, 0, node, 0] = jacobian[:, 1, node, 1] = sign
        jacobian[:, 0, node, 2], jacobian[:, 1, node, 2] = -sign * at[:, 1], sign * at[:, 0]
        jacobian[:, :, node, 3] = sign * v
        if name in untimed:
            bearings = np.arctan2(own[:, 1] * (-1 if name in inverted else 1), own[:, 0])
            jacobian[:, :, node, 4] = sign * v * untimed[name].turn_times(bearings)[:, None]
    spans = pairs.a.tick[pairs.row_a[rows]] // to_ticks(_ERROR_TIME)
    _, group = np.unique(np.column_stack([pairs.trajectories[rows], spans]), axis=0, return_inverse=True)
    ticks = pairs.a.tick[pairs.row_a[rows]]
    yield _Part(jacobian.reshape(len(rows), 2, -1), difference[rows], group.ravel(), ticks)


def _number(groups: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """The groups of all parts, numbered from 0."""
    before = np.cumsum([0, *(int(group.max(initial=-1)) + 1 for group in groups)])
    return np.concatenate([group + first for group, first in zip(groups, before, strict=False)])


def _estimate_with_halves(part: _Part, shared: Sequence[Sequence[int]]) -> list[tuple[float, float]]:
    """Estimates and standard deviations of s, which contain the differences between halves of the recording."""
    later = part.ticks > np.median(part.ticks)
    halves = [_estimate(select_rows(part, rows), shared) for rows in (later, ~later)]
    return [
        (value, float(np.hypot(sigma, (a - b) / 2)) if np.isfinite([stddev_a, stddev_b]).all() else np.inf)
        for (value, sigma), (a, stddev_a), (b, stddev_b) in zip(_estimate(part, shared), *halves, strict=True)
    ]


def _estimate(part: _Part, shared: Sequence[Sequence[int]]) -> list[tuple[float, float]]:
    """Estimates and standard deviations of s, one for each group of columns that have the same.

    Least squares with Huber's weights, and errors that are the same within groups (sandwich covariance).
    """
    jacobian, differences, groups = part.jacobian, part.differences, part.group
    others = [k for k in range(4, jacobian.shape[2]) if k % _UNKNOWNS != 4]  # the pose and clock of the root are 0
    sums = [jacobian[:, :, list(columns)].sum(axis=2) for columns in shared]
    # A scanner that shares no person with others has no times.
    kept = [k for k, column in enumerate(sums) if np.any(column)]
    A = (
        np.concatenate([jacobian[:, :, others], np.stack([sums[k] for k in kept], axis=2)], axis=2)
        if kept
        else None
    )
    found = [(0.0, np.inf)] * len(shared)
    if A is None or len(A) < A.shape[2]:
        return found
    solution, stddev = solve_with_grouped_errors(A, differences, groups)
    stddev = _STDDEV_FACTOR * stddev
    for k, value, sigma in zip(kept, solution[len(others) :], stddev[len(others) :], strict=True):
        found[k] = float(value), float(sigma)
    return found
