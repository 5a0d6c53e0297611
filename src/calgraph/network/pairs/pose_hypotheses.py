"""Pose hypotheses for two scanners: least-squares alignments of stretches of a trajectory of each.

Source: Quenzel, Papenberg, Behnke, "Robust extrinsic calibration of multiple stationary laser range finders",
2016, section III.D: every combination of two tracks gives hypotheses.
"""

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se2
from calgraph.network.pairs.synchronized_tracks import SimultaneousPairs, to_ticks
from calgraph.network.pairs.track_similarity import MAX_RMS, MIN_DURATION, MIN_EXTENT, NOISE

# Lengths of the stretches, s; whole trajectories are used, too. Short ones survive identity switches of the
# tracker, long ones determine the angle.
_STRETCH_DURATIONS = (3.0, 8.0)
# Number of hypotheses that are scored: half of them the best, half random; bounds the time for crowds. 200 of
# 2,800 (40 people, ten minutes) contained the right pose in 31 of 40 cases, 800 in all 40.
_MAX_COUNT = 800


def propose_poses(pairs: SimultaneousPairs, rng: np.random.Generator, max_count: int = _MAX_COUNT) -> Array:
    """Proposes poses (K, 3, 3) from stretches of every combination of a trajectory of a with one of b.

    The stretches with the largest extent and the smallest RMS distance come first, then a random selection.
    """
    trajectories = pairs.trajectories
    order = np.argsort(trajectories, kind="stable")  # and ascending in tick within each trajectory
    trajectories, ticks = trajectories[order], pairs.a.tick[pairs.row_a][order]
    moments = _compute_moments(pairs.x_a[order], pairs.x_b[order])
    poses, scores = [], []
    for length in (*map(to_ticks, _STRETCH_DURATIONS), np.iinfo(np.intp).max):
        begins = np.diff(trajectories, prepend=-1).astype(bool) | np.diff(ticks // length, prepend=-1).astype(bool)
        T, fit, extent = _fit_stretches(moments, np.flatnonzero(begins), to_ticks(MIN_DURATION))
        usable = (extent > MIN_EXTENT) & (fit < MAX_RMS)
        poses.append(T[usable])
        scores.append(extent[usable] / (fit[usable] + NOISE))
    T, score = np.concatenate(poses), np.concatenate(scores)
    order = np.argsort(-score)
    if len(order) > max_count:
        first, rest = np.split(order, [max_count // 2])
        order = np.concatenate([first, rng.choice(rest, max_count - len(first), replace=False)])
    return np.asarray(T[order])


def _compute_moments(x_a: Array, x_b: Array) -> Array:
    """Moments (M, 9) whose sums over a stretch determine its least-squares pose."""
    dot, cross = np.sum(x_a * x_b, axis=1), x_b[:, 0] * x_a[:, 1] - x_b[:, 1] * x_a[:, 0]
    squares = np.sum(x_a**2, axis=1), np.sum(x_b**2, axis=1)
    return np.column_stack([np.ones(len(x_a)), x_a, x_b, dot, cross, *squares])


def _fit_stretches(moments: Array, starts: NDArray[np.intp], min_ticks: int) -> tuple[Array, Array, Array]:
    """Fits poses to all stretches of all combinations of trajectories (Kabsch).

    Args:
        moments: (M, 9) from :func:`_compute_moments`, ordered by stretch.
        starts: (K,) first row of each stretch.
        min_ticks: least number of rows of a stretch.

    Returns:
        Poses (K, 3, 3), RMS distances (K,), m, and extents of the trajectories (K,), m; infinite distances for
        stretches of too few ticks.
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
    return T, np.where(count < min_ticks, np.inf, fit), extent
