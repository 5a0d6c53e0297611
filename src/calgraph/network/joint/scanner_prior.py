"""Prior of scanner poses from an earlier calibration, as a term of the joint solution."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array, Index, se2
from calgraph.network.joint.planar_poses import PlanarPoses
from calgraph.network.joint.scanner_matrix import ScannerMatrix

# Least standard deviation of a prior, m and rad: a covariance of 0 would be singular.
_MIN_SIGMA = (1e-5, 1e-5, 1e-6)


@dataclass(frozen=True, eq=False)
class ScannerPrior:
    """Joint Gaussian prior of K scanners' poses in the root frame."""

    nodes: Index
    """(K,)."""
    T_root_scanner: Array
    """(K, 3, 3)."""
    information: Array
    """(3K, 3K) in the root's fixed axes."""

    def add_to_equations(self, T_root_scanner: Array, H: ScannerMatrix, g: Array) -> float:
        """Adds the term at poses (S, 3, 3) to normal equations over all scanners (US), in place; its cost."""
        error = se2.difference(T_root_scanner[self.nodes], self.T_root_scanner).ravel()
        gradient = self.information @ error
        K, U = len(self.nodes), H.order.unknowns
        block = np.zeros((K, U, K, U))
        block[:, :3, :, :3] = self.information.reshape(K, 3, K, 3)
        H.add(self.nodes, block.reshape(K * U, K * U))
        g.reshape(-1, U)[self.nodes, :3] += gradient.reshape(K, 3)
        return 0.5 * float(error @ gradient)


def build_scanner_prior(poses: PlanarPoses, names: Sequence[str]) -> ScannerPrior:
    """The prior of those scanners of a network that have an earlier pose.

    Where the correlations of their errors are unknown (all zero), the prior is weaker than for any correlations.

    Args:
        poses: earlier ones, in the frame of the network's root.
        names: of the network, the root first.
    """
    shared = [name for name in names[1:] if name in poses.names]
    selected = poses.select([names[0], *shared])
    covariance = selected.covariance[3:, 3:] + np.diag(np.tile(np.square(_MIN_SIGMA), len(shared)))
    own = np.kron(np.eye(len(shared), dtype=np.bool_), np.ones((3, 3), dtype=np.bool_))
    if not covariance[~own].any():
        # Unknown correlations: no joint covariance with these blocks exceeds their number times them.
        covariance *= len(shared)
    # Scaled to correlations before the inversion: variances of unobserved directions are up to 1e6 m².
    scale = np.sqrt(np.diag(covariance))
    information = np.linalg.inv(covariance / np.outer(scale, scale)) / np.outer(scale, scale)
    nodes = np.array([names.index(name) for name in shared], dtype=np.intp)
    return ScannerPrior(nodes, selected.T_root_scanner[1:], (information + information.T) / 2)
