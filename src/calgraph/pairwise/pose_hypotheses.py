"""First guesses of how two scanners stand to each other: some seconds of one's walks laid over the other's.

Quenzel, Papenberg, Behnke, "Robust extrinsic calibration of multiple stationary laser range finders", 2016,
section III.D: every combination of two tracks gives hypotheses.
"""

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se2
from calgraph.pairwise.synchronized_tracks import Meetings

# Two walks are compared in stretches of so many ticks, and as a whole: a stretch outlives a confusion of people.
_STRETCHES = (30, 80, 1_000_000)
# A stretch gives a hypothesis if it has so many ticks, extends so far (m, standard deviation along the walk) and
# fits so well (m, root mean square).
_TICKS = 6
_EXTENT = 0.15
_FIT = 0.3
# So many are handed on at most.
_MOST = 200


def first_guesses(met: Meetings, rng: np.random.Generator) -> Array:
    """Poses (K, 3, 3) from stretches of every walk of a with every walk of b, whether or not they are one person.

    The stretches that say most come first, with some others at random.
    """
    walks = met.a.walk[met.row_a] * (int(met.b.walk.max()) + 1) + met.b.walk[met.row_b]
    order = np.argsort(walks, kind="stable")  # and ascending in tick within the walks
    walks, ticks = walks[order], met.a.tick[met.row_a][order]
    moments = _moments(met.x_a[order], met.x_b[order])
    poses, worth = [], []
    for length in _STRETCHES:
        begins = np.diff(walks, prepend=-1).astype(bool) | np.diff(ticks // length, prepend=-1).astype(bool)
        T, fit, extent = _kabsch(moments, np.flatnonzero(begins))
        usable = (extent > _EXTENT) & (fit < _FIT)
        poses.append(T[usable])
        worth.append(extent[usable] / (fit[usable] + 0.05))
    T, value = np.concatenate(poses), np.concatenate(worth)
    order = np.argsort(-value)
    if len(order) > _MOST:
        first, rest = order[: _MOST // 2], order[_MOST // 2 :]
        order = np.concatenate([first, rng.choice(rest, _MOST - len(first), replace=False)])
    return np.asarray(T[order])


def _moments(x_a: Array, x_b: Array) -> Array:
    """(M, 9) whose sums over a stretch give its least squares pose."""
    dot, cross = np.sum(x_a * x_b, axis=1), x_b[:, 0] * x_a[:, 1] - x_b[:, 1] * x_a[:, 0]
    squares = np.sum(x_a**2, axis=1), np.sum(x_b**2, axis=1)
    return np.column_stack([np.ones(len(x_a)), x_a, x_b, dot, cross, *squares])


def _kabsch(moments: Array, starts: NDArray[np.intp]) -> tuple[Array, Array, Array]:
    """Least squares poses of all stretches of all combinations of walks at once.

    Args:
        moments: (M, 9) as :func:`_moments` gives them, stretch by stretch.
        starts: (K,) where the stretches begin.

    Returns:
        Poses (K, 3, 3), root mean square distances (K,), m, and extents of the walks (K,), m; infinite distances
        for stretches of too few ticks.
    """
    sums = np.add.reduceat(moments, starts)
    count = sums[:, 0]
    center_a, center_b, dot, cross, square_a, square_b = np.split(sums[:, 1:] / count[:, None], [2, 4, 5, 6, 7], 1)
    dot = (dot - np.sum(center_a * center_b, axis=1, keepdims=True))[:, 0]
    cross = cross[:, 0] - (center_b[:, 0] * center_a[:, 1] - center_b[:, 1] * center_a[:, 0])
    spread_a = square_a[:, 0] - np.sum(center_a**2, axis=1)
    spread_b = square_b[:, 0] - np.sum(center_b**2, axis=1)
    T = se2.pose(np.arctan2(cross, dot), np.zeros(2))
    T[:, :2, 2] = center_a - np.einsum("kij,kj->ki", T[:, :2, :2], center_b)
    fit = np.sqrt(np.maximum(spread_a + spread_b - 2 * np.hypot(dot, cross), 0))
    extent = np.sqrt(np.maximum(np.minimum(spread_a, spread_b), 0))
    return T, np.where(count < _TICKS, np.inf, fit), extent
