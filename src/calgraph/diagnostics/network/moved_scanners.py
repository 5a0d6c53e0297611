"""Finds the scanners that have moved: the fewest that explain the difference of two sets of poses."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtri

from calgraph.config.settings import DiagnosticsSettings
from calgraph.estimation.network.planar_poses import PlanarPoses
from calgraph.geometry import Array, se2


@dataclass(frozen=True)
class MovedScanner:
    """How far a scanner has moved relative to one that has not."""

    name: str
    distance: float
    """m."""
    rotation: float
    """rad, counter-clockwise."""

    def __str__(self) -> str:
        """The displacement in words; adding zero removes the sign of a negative zero."""
        return f"{1000 * self.distance:.1f} mm and {round(float(np.degrees(self.rotation)), 2) + 0.0:+.2f}°"


def find_moved_scanners(
    before: PlanarPoses, after: PlanarPoses, settings: DiagnosticsSettings
) -> tuple[str, tuple[MovedScanner, ...]]:
    """Finds the scanners that have moved between two sets of poses, and how far.

    Args:
        before: poses of the same scanners, in the frame of the same root.
        after: estimated independently.
        settings: the probability of a false alarm, and the rounding of poses.

    Returns:
        A scanner that has not moved, the root if possible; and the displacements relative to it.
    """
    after = after.select(before.names)
    difference = se2.difference(after.T_root_scanner, before.T_root_scanner)
    network = settings.network
    rounding = [network.position_rounding, network.position_rounding, network.rotation_rounding]
    of_rounding = np.diag(np.tile(np.square(rounding), len(before.names)))
    covariance = before.covariance + after.covariance + of_rounding
    nodes = find_displaced_nodes(
        before.T_root_scanner, difference, covariance, settings.verdict.false_alarm_probability, network.max_sets
    )
    reference = next(name for k, name in enumerate(before.names) if k not in nodes)
    selected = [reference, *(before.names[k] for k in nodes)]
    T_before = before.change_root(reference).select(selected).T_root_scanner
    T_after = after.change_root(reference).select(selected).T_root_scanner
    steps = se2.difference(T_after, T_before)
    return reference, tuple(
        MovedScanner(name, float(np.hypot(*step[:2])), float(step[2]))
        for name, step in zip(selected[1:], steps[1:], strict=True)
    )


def find_displaced_nodes(
    T_root_node: Array, difference: Array, covariance: Array, false_alarm_probability: float, max_sets: int
) -> tuple[int, ...]:
    """The smallest set of nodes whose displacement explains a difference of poses; the most likely of its size.

    A moved node adds an unknown displacement to its difference; the root, whose frame all poses are in, to all of
    them. A set explains the difference if the squared Mahalanobis distance of the remainder is below the χ²
    quantile. A network without a moved node is tested once, so that it has a false alarm with the stated
    probability, regardless of the number of nodes.

    Source: Baarda, "A testing procedure for use in geodetic networks", 1968, for sets of observations.

    Args:
        T_root_node: (N, 3, 3) poses, the root's first.
        difference: (N, 3) of two sets of poses in the root's fixed axes; zero for the root.
        covariance: (3N, 3N) of the difference; the root's rows are not used.
        false_alarm_probability: of naming a node although none has moved.
        max_sets: sets of one size that are all tested; beyond, the best smaller set grows by one node.

    Returns:
        Nodes, ascending; all but the root if no smaller set explains the difference.
    """
    count = len(T_root_node)
    if count < 2:
        return ()
    root = np.linalg.cholesky(covariance[3:, 3:])
    whitened = solve_triangular(root, difference[1:].ravel(), lower=True)
    jacobian = solve_triangular(root, _compute_jacobian(T_root_node)[3:], lower=True).reshape(-1, count, 3)
    best: tuple[int, ...] = ()
    for size in range(count - 1):
        distance, best = min(
            (_compute_remainder(whitened, jacobian, nodes), nodes)
            for nodes in _list_sets(count, size, best, max_sets)
        )
        if distance <= chdtri(3 * (count - 1 - size), false_alarm_probability):
            return best
    return tuple(range(1, count))


def _list_sets(count: int, size: int, smaller: Sequence[int], max_sets: int) -> Iterator[tuple[int, ...]]:
    """All sets of nodes of a size; where there are too many, those that contain a smaller set."""
    if comb(count, size) <= max_sets:
        return combinations(range(count), size)
    return (tuple(sorted((*smaller, node))) for node in range(count) if node not in smaller)


def _compute_jacobian(T_root_node: Array) -> Array:
    """(3N, 3N) derivatives of all nodes' differences by the displacement of each, in the root's fixed axes."""
    count = len(T_root_node)
    jacobian = np.eye(3 * count)
    x, y = T_root_node[:, 0, 2], T_root_node[:, 1, 2]
    jacobian[:, :3] = np.tile(np.eye(3), (count, 1))
    jacobian[0::3, 2], jacobian[1::3, 2] = -y, x
    return jacobian


def _compute_remainder(whitened: Array, jacobian: Array, nodes: Sequence[int]) -> float:
    """Squared norm of a whitened difference (M,) minus its least squares fit by displacements of nodes."""
    if not nodes:
        return float(whitened @ whitened)
    axes, _ = np.linalg.qr(jacobian[:, list(nodes)].reshape(len(whitened), -1))
    return float(whitened @ whitened - np.sum((axes.T @ whitened) ** 2))
