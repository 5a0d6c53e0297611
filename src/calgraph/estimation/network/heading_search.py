"""Which way bodies face while they turn: the best sequence of headings on a grid, by dynamic programming.

Where somebody turns about, the path alone does not tell whether to the left or to the right, and least squares
does not find from one to the other; the outlines seen meanwhile do. An ellipse has no front: headings count
modulo π.
"""

from dataclasses import replace

import numpy as np

from calgraph.estimation.network.solver import (
    TURNING,
    Body,
    Glimpses,
    Motion,
    Network,
    State,
    along,
    facing,
    view_of,
)
from calgraph.geometry import Array, Index

# Headings tried, and the noise at which they are: the path is still off by about this, m.
_GRID = np.pi * np.arange(18) / 18
_ROUGH = 0.01
# A beam says at most so much, in half squared standard deviations: some are of arms, or of somebody else.
_MOST = 4.5
# Beams of one scan err together: they count by this share.
_SHARE = 0.2


def with_best_headings(network: Network, state: State) -> State:
    """The state with headings that fit what was seen of each body best, its path and size being as they are."""
    motions = [
        _turned(network, state, body, motion) if body.faces else motion
        for body, motion in zip(network.bodies, state.motions, strict=True)
    ]
    return replace(state, motions=tuple(motions))


def _turned(network: Network, state: State, body: Body, motion: Motion) -> Motion:
    cost = np.zeros((body.knots.count, len(_GRID)))
    for seen in body.glimpses:
        nearest, misfit = _misfits(network, state, body, motion, seen)
        np.add.at(cost, nearest, misfit)
    off, weight = facing(body, motion.control[:, :2], _GRID)
    cost += 0.5 * weight[:, None] * off**2
    best = _cheapest(cost, body.knots.step)
    turn = np.diff(_GRID[best])
    turn = (turn + np.pi / 2) % np.pi - np.pi / 2
    heading = np.concatenate([_GRID[best[:1]], turn]).cumsum()
    return replace(motion, control=np.column_stack([motion.control[:, :2], heading]))


def _misfits(network: Network, state: State, body: Body, motion: Motion, seen: Glimpses) -> tuple[Index, Array]:
    """Of each beam that counts the control point it is nearest to (N,), and its misfit (N, G) to all headings."""
    first, weights, pose, rate = along(state, body, motion, seen)
    counts = seen.weight > 0
    view = view_of(seen)[counts]
    nearest = first + 1 + (weights[:, 2] > weights[:, 1])
    centre = pose[view, :2] + seen.lag[counts, None] * rate[view, :2]
    T = state.T_root_scanner[seen.scanner]
    direction = seen.direction[counts] @ T[:2, :2].T
    sigma = np.hypot(network.sigma[seen.scanner], _ROUGH)
    ranges = _ranges(T[:2, 2] - centre, direction, motion.radii)
    off = 0.5 * ((ranges - seen.ranges[counts, None]) / sigma) ** 2
    return nearest[view], _SHARE * np.fmin(off, _MOST)


def _ranges(start: Array, direction: Array, radii: Array) -> Array:
    """Ranges (N, G) along beams to an ellipse about the origin in all headings, m; NaN where they miss it.

    Squares of lengths in radii are ``|h|² = xᵀ Q x``, with three numbers of ``Q`` for each heading.

    Args:
        start: (N, 2) of the beams, m.
        direction: (N, 2) unit vectors.
        radii: (2,) across and along the heading, m.
    """
    across, ahead = radii**-2
    c, s = np.cos(_GRID), np.sin(_GRID)
    Q = np.stack([across * s**2 + ahead * c**2, across * c**2 + ahead * s**2, (ahead - across) * s * c])

    def product(a: Array, b: Array) -> Array:
        (x, y), (other_x, other_y) = a.T, b.T
        return np.asarray(np.stack([x * other_x, y * other_y, x * other_y + y * other_x], axis=1) @ Q)

    square, half = product(direction, direction), product(start, direction)
    with np.errstate(invalid="ignore"):
        return np.asarray((-half - np.sqrt(half**2 - square * (product(start, start) - 1))) / square)


def _cheapest(cost: Array, step: float) -> Index:
    """(K,) the choices of least total cost (K, G) and turning (Viterbi, 1967)."""
    turn = (_GRID[:, None] - _GRID + np.pi / 2) % np.pi - np.pi / 2
    turning = turn**2 / (2 * step * TURNING)
    total, before = cost[0], np.zeros(cost.shape, dtype=np.intp)
    for k in range(1, len(cost)):
        reached = total[:, None] + turning
        before[k] = np.argmin(reached, axis=0)
        total = reached.min(axis=0) + cost[k]
    best = np.empty(len(cost), dtype=np.intp)
    best[-1] = np.argmin(total)
    for k in range(len(cost) - 1, 0, -1):
        best[k - 1] = before[k, best[k]]
    return best
