"""The fewest nodes of a tree of poses whose displacement explains the difference of two sets of poses.

Poses are in SE(2) or SE(3), with tangent vectors of d = 3 or 6 components.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations
from math import comb, log

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtri

from calgraph.geometry import Array
from calgraph.geometry.se_n import rotation_jacobian, translation


def find_displaced_nodes(
    T_root_node: Array,
    difference: Array,
    covariance: Array,
    false_alarm_probability: float,
    max_sets: int,
    indistinguishable_ratio: float = 1.0,
) -> list[tuple[int, ...]]:
    """The smallest sets of nodes whose displacement explains a difference of poses; the most likely first.

    A moved node adds an unknown displacement to its difference; the root, whose frame all poses are in, to all of
    them. A set explains the difference if the squared Mahalanobis distance of the remainder is below the χ²
    quantile. A tree without a moved node is tested once, so that it has a false alarm with the stated
    probability, regardless of the number of nodes.

    Source: Baarda, "A testing procedure for use in geodetic networks", 1968, for sets of observations.

    Args:
        T_root_node: (N, n+1, n+1) poses, the root's first.
        difference: (N, d) of two sets of poses in the root's fixed axes; zero for the root.
        covariance: (N·d, N·d) of the difference; the root's rows are not used.
        false_alarm_probability: of naming a node although none has moved.
        max_sets: sets of one size that are all tested; beyond, the best smaller set grows by one node.
        indistinguishable_ratio: sets of the same size follow if their likelihood is smaller by less than this.

    Returns:
        Sets of nodes, each ascending, all of one size. Where no smaller set explains the difference, all nodes but
        one have moved, and any of them may be the one that has not.
    """
    count, d = difference.shape
    if count < 2:
        return [()]
    factor = np.linalg.cholesky(covariance[d:, d:])
    whitened = solve_triangular(factor, difference[1:].ravel(), lower=True)
    jacobian = solve_triangular(factor, _compute_jacobian(T_root_node, d)[d:], lower=True).reshape(-1, count, d)
    best: tuple[int, ...] = ()
    for size in range(count - 1):
        found = sorted(
            (_compute_remainder(whitened, jacobian, nodes), nodes)
            for nodes in _list_sets(count, size, best, max_sets)
        )
        least, best = found[0]
        if least <= chdtri(d * (count - 1 - size), false_alarm_probability):
            return [nodes for remainder, nodes in found if remainder <= least + 2 * log(indistinguishable_ratio)]
    return list(combinations(range(count), count - 1))[::-1]


def estimate_displacements(
    T_root_node: Array, difference: Array, covariance: Array, nodes: Sequence[int]
) -> tuple[Array, Array]:
    """Displacements of some nodes if all others have not moved, by generalised least squares.

    Args:
        T_root_node: as for :func:`find_displaced_nodes`, with the next two.
        difference: of two sets of poses.
        covariance: of the difference.
        nodes: that have moved; at most N - 1.

    Returns:
        Displacements (K, d) along the root's fixed axes, m and rad, and their covariances (K, d, d).
    """
    d = difference.shape[1]
    factor = np.linalg.cholesky(covariance[d:, d:])
    whitened = solve_triangular(factor, difference[1:].ravel(), lower=True)
    columns = (d * np.array(nodes)[:, None] + np.arange(d)).ravel()
    jacobian = solve_triangular(factor, _compute_jacobian(T_root_node, d)[d:, columns], lower=True)
    joint = np.linalg.inv(jacobian.T @ jacobian)
    steps = (joint @ jacobian.T @ whitened).reshape(-1, d)
    # All others are displaced in the frame of a root that moved, and in the opposite direction.
    steps[np.array(nodes) == 0] *= -1
    blocks = joint.reshape(len(nodes), d, len(nodes), d)
    return steps, np.array([blocks[k, :, k] for k in range(len(nodes))])


def _list_sets(count: int, size: int, smaller: Sequence[int], max_sets: int) -> Iterator[tuple[int, ...]]:
    """All sets of nodes of a size; where there are too many, those that contain a smaller set."""
    if comb(count, size) <= max_sets:
        return combinations(range(count), size)
    return (tuple(sorted((*smaller, node))) for node in range(count) if node not in smaller)


def _compute_jacobian(T_root_node: Array, d: int) -> Array:
    """(N·d, N·d) derivatives of all nodes' differences by the displacement of each, in the root's fixed axes."""
    count, n = len(T_root_node), T_root_node.shape[-1] - 1
    jacobian = np.eye(d * count)
    of_root = np.tile(np.eye(d), (count, 1, 1))
    of_root[:, :n, n:] = rotation_jacobian(translation(T_root_node))
    jacobian[:, :d] = of_root.reshape(-1, d)
    return jacobian


def _compute_remainder(whitened: Array, jacobian: Array, nodes: Sequence[int]) -> float:
    """Squared norm of a whitened difference (M,) minus its least squares fit by displacements of nodes."""
    if not nodes:
        return float(whitened @ whitened)
    axes, _ = np.linalg.qr(jacobian[:, list(nodes)].reshape(len(whitened), -1))
    return float(whitened @ whitened - np.sum((axes.T @ whitened) ** 2))
