"""Which scanners have moved: the fewest whose displacement explains why two sets of poses differ."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtri

from calgraph.estimation.network.planar_poses import PlanarPoses
from calgraph.geometry import Array, se2

# Sets of scanners of one size that are all tried; beyond it, the best smaller set grows by one.
_MOST = 3000
# Nobody states poses more precisely than this, m and rad.
_ROUNDING = (1e-4, 1e-4, 1e-5)


@dataclass(frozen=True)
class Displacement:
    """How far a scanner has moved, against one that has not."""

    name: str
    distance: float
    """m."""
    turn: float
    """rad, counter-clockwise."""

    def __str__(self) -> str:
        """The displacement in words."""
        return f"{1000 * self.distance:.1f} mm and {np.degrees(self.turn):+.2f}°"


def displacements(before: PlanarPoses, after: PlanarPoses, chance: float) -> tuple[str, tuple[Displacement, ...]]:
    """Which scanners have moved from one set of poses to another, and by how much.

    Args:
        before: poses of the same scanners, in the frame of the same root.
        after: found independently.
        chance: as for :func:`displaced`.

    Returns:
        A scanner that has not moved, the root if it has not; and the displacements as it sees them.
    """
    after = after.of(before.names)
    difference = se2.difference(after.T_root_scanner, before.T_root_scanner)
    spread = before.covariance + after.covariance + np.diag(np.tile(np.square(_ROUNDING), len(before.names)))
    nodes = displaced(before.T_root_scanner, difference, spread, chance)
    still = next(name for k, name in enumerate(before.names) if k not in nodes)
    then, now = before.seen_from(still), after.seen_from(still)
    chosen = [still, *(before.names[k] for k in nodes)]
    off = se2.difference(now.of(chosen).T_root_scanner, then.of(chosen).T_root_scanner)
    return still, tuple(
        Displacement(name, float(np.hypot(*step[:2])), float(step[2]))
        for name, step in zip(chosen[1:], off[1:], strict=True)
    )


def displaced(T_root_node: Array, difference: Array, covariance: Array, chance: float) -> tuple[int, ...]:
    """The smallest set of nodes whose displacement explains a difference of poses, the likeliest of that size.

    Each moved node adds a displacement of its own to the differences; the root, from which all others are seen,
    one to all of them. What is left is judged by its squared Mahalanobis distance: a set explains the difference
    if chance alone leaves more than that with probability ``chance``. That no node at all is named is a single
    such test: in a network where nothing moved, it fails with that probability, however many nodes there are.

    Source: Baarda, "A testing procedure for use in geodetic networks", 1968, for sets of observations.

    Args:
        T_root_node: (N, 3, 3) poses, the root's first.
        difference: (N, 3) of two sets of poses in the root's fixed axes; zero for the root.
        covariance: (3N, 3N) of the difference; the root's rows do not count.
        chance: probability of naming a node although none moved.

    Returns:
        Nodes, ascending; all but the root if no smaller set explains it.
    """
    count = len(T_root_node)
    if count < 2:
        return ()
    root = np.linalg.cholesky(covariance[3:, 3:])
    misfit = solve_triangular(root, difference[1:].ravel(), lower=True)
    moving = solve_triangular(root, _moving(T_root_node)[3:], lower=True).reshape(-1, count, 3)
    best: tuple[int, ...] = ()
    for size in range(count - 1):
        left, best = min((_left(misfit, moving, nodes), nodes) for nodes in _candidates(count, size, best))
        if left <= chdtri(3 * (count - 1 - size), chance):
            return best
    return tuple(range(1, count))


def _candidates(count: int, size: int, smaller: Sequence[int]) -> Iterator[tuple[int, ...]]:
    """All sets of so many nodes, or those that a smaller one grows to where there are too many."""
    if comb(count, size) <= _MOST:
        return combinations(range(count), size)
    return (tuple(sorted((*smaller, node))) for node in range(count) if node not in smaller)


def _moving(T_root_node: Array) -> Array:
    """(3N, 3N) how the differences of all nodes change with a displacement of each, in the root's fixed axes."""
    count = len(T_root_node)
    moving = np.eye(3 * count)
    x, y = T_root_node[:, 0, 2], T_root_node[:, 1, 2]
    moving[:, :3] = np.tile(np.eye(3), (count, 1))
    moving[0::3, 2], moving[1::3, 2] = -y, x
    return moving


def _left(misfit: Array, moving: Array, nodes: Sequence[int]) -> float:
    """Squared length of what of a whitened misfit (M,) is left when these nodes are displaced to suit it."""
    if not nodes:
        return float(misfit @ misfit)
    axes, _ = np.linalg.qr(moving[:, list(nodes)].reshape(len(misfit), -1))
    return float(misfit @ misfit - np.sum((axes.T @ misfit) ** 2))
