"""Finds the headings of people who turn on the spot: the best sequence on a grid, by dynamic programming.

Where people turn round, the path does not determine the side, and least squares does not get from one side to the
other; the ranges to the outline do. An ellipse has no front: headings are modulo π.
"""

from dataclasses import replace

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.network.joint.body_batches import BodyBatches
from calgraph.network.joint.ellipses import TURNING_DENSITY, EllipseObservations, compute_heading_offsets
from calgraph.network.joint.path_equations import evaluate_at, index_scans
from calgraph.network.joint.problem import BodyObservations, BodyPath, BodyScans, NetworkProblem, NetworkState
from calgraph.network.joint.scanner_unknowns import (
    RANGE_BIAS,
    compute_stretches,
    compute_turns,
    rotate_by_small_angles,
)


def search_headings(network: NetworkProblem, state: NetworkState, batches: BodyBatches) -> NetworkState:
    """The state with the best headings of people, given their paths' positions and their radii."""
    return replace(state, paths=tuple(batches.map(_search_body, network, state)))


# Headings over a half turn: steps of 10°, of which the half is well below the noise of a heading.
_GRID_SIZE = 18


def _search_body(
    network: NetworkProblem, state: NetworkState, body: EllipseObservations, path: BodyPath
) -> BodyPath:
    if not body.faces_forward:
        return path
    size = _GRID_SIZE
    grid = np.pi * np.arange(size) / size
    cost = np.zeros((body.knots.count, size))
    for scans in body.scans:
        nearest, beam_cost = _compute_beam_costs(network, state, body, path, scans, grid)
        np.add.at(cost, nearest, beam_cost)
    offset, weight = compute_heading_offsets(body, path.control[:, :2], grid)
    cost += 0.5 * weight[:, None] * offset**2
    turning_variance = body.knots.step * TURNING_DENSITY
    best = _find_cheapest_sequence(cost, grid, turning_variance)
    turn = np.diff(grid[best])
    turn = (turn + np.pi / 2) % np.pi - np.pi / 2
    heading = np.concatenate([grid[best[:1]], turn]).cumsum()
    return replace(path, control=np.column_stack([path.control[:, :2], heading]))


# Error of paths at this stage, m; added to the noise of ranges.
_PATH_SIGMA = 0.01
# Weight of a beam: errors of path and outline are common to the beams of a scan, which count as a fifth of
# independent ones.
_BEAM_WEIGHT = 0.2
# Maximum cost of a beam, half squared standard deviations: three of them; beyond, a beam is of arms or of other
# people.
_MAX_BEAM_COST = 4.5


def _compute_beam_costs(
    network: NetworkProblem,
    state: NetworkState,
    body: BodyObservations,
    path: BodyPath,
    scans: BodyScans,
    grid: Array,
) -> tuple[Index, Array]:
    """The control point nearest to each beam with a weight (N,), and the beam's cost (N, G) over the grid."""
    first, weights, pose, rate = evaluate_at(network, state, body, path, scans)
    used = scans.weight > 0
    scan = index_scans(scans)[used]
    nearest = first + 1 + (weights[:, 2] > weights[:, 1])
    centre = pose[scan, :2] + scans.beam_delay[used, None] * rate[scan, :2]
    T = state.T_root_scanner[scans.scanner]
    x, y = T[:2, :2] @ scans.direction[used].T
    systematic, double_azimuth = state.systematic[scans.scanner], scans.double_azimuth[:, used]
    direction = rotate_by_small_angles(x, y, compute_turns(systematic, scans.azimuth[used], double_azimuth)).T
    sigma = np.hypot(network.range_sigma[scans.scanner], _PATH_SIGMA)
    ranges = _raycast_grid(T[:2, 2] - centre, direction, path.shape, grid)
    ranges = compute_stretches(systematic, double_azimuth)[:, None] * ranges + systematic[RANGE_BIAS]
    cost = 0.5 * ((ranges - scans.ranges[used, None]) / sigma) ** 2
    return nearest[scan], _BEAM_WEIGHT * np.fmin(cost, _MAX_BEAM_COST)


def _raycast_grid(start: Array, direction: Array, radii: Array, grid: Array) -> Array:
    """Ranges (N, G) along beams to an ellipse about the origin at all headings, m; NaN where they miss it.

    The squared norm of a vector in units of the radii is ``xᵀ Q x``, with three numbers of ``Q`` for each heading.

    Args:
        start: (N, 2) of the beams, m.
        direction: (N, 2) unit vectors.
        radii: (2,) across and along the heading, m.
        grid: (G,) headings, rad.
    """
    across, along = radii**-2
    c, s = np.cos(grid), np.sin(grid)
    Q = np.stack([across * s**2 + along * c**2, across * c**2 + along * s**2, (along - across) * s * c])

    def product(a: Array, b: Array) -> Array:
        (x, y), (other_x, other_y) = a.T, b.T
        return np.asarray(np.stack([x * other_x, y * other_y, x * other_y + y * other_x], axis=1) @ Q)

    square, half = product(direction, direction), product(start, direction)
    with np.errstate(invalid="ignore"):
        return np.asarray((-half - np.sqrt(half**2 - square * (product(start, start) - 1))) / square)


def _find_cheapest_sequence(cost: Array, grid: Array, turning_variance: float) -> Index:
    """(K,) the grid headings with the least total cost (K, G), including that of turning (Viterbi, 1967).

    The turning from one control point to the next has the given variance, rad².
    """
    turn = (grid[:, None] - grid + np.pi / 2) % np.pi - np.pi / 2
    turning_cost = turn**2 / (2 * turning_variance)
    total, previous = cost[0], np.zeros(cost.shape, dtype=np.intp)
    for k in range(1, len(cost)):
        candidates = total[:, None] + turning_cost
        previous[k] = np.argmin(candidates, axis=0)
        total = candidates.min(axis=0) + cost[k]
    best = np.empty(len(cost), dtype=np.intp)
    best[-1] = np.argmin(total)
    for k in range(len(cost) - 1, 0, -1):
        best[k - 1] = previous[k, best[k]]
    return best
