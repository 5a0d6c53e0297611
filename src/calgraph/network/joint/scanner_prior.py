"""Prior of scanner poses from an earlier calibration, as a term of the joint solution."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array, Index, se_n
from calgraph.network.joint.planar_poses import NetworkPoses
from calgraph.network.joint.scanner_matrix import ScannerMatrix

# Least standard deviation of a prior, m and rad, by numbers of a pose: a covariance of 0 would be singular.
_MIN_SIGMA = {3: (1e-5, 1e-5, 1e-6), 6: (1e-5, 1e-5, 1e-5, 1e-6, 1e-6, 1e-6)}


@dataclass(frozen=True, eq=False)
class ScannerPrior:
    """Joint Gaussian prior of K scanners' poses in the root frame, of d = 3 numbers in a plane or 6 in space."""

    nodes: Index
    """(K,)."""
    T_root_scanner: Array
    """(K, 3, 3) or (K, 4, 4)."""
    information: Array
    """(dK, dK) in the root's fixed axes."""

    def express_in(self, T_world_root: Array) -> "ScannerPrior":
        """The same of poses in another frame, where the root has a pose that is known."""
        turn = np.kron(np.eye(len(self.nodes)), se_n.rotation_adjoint(se_n.rotation(T_world_root)))
        return ScannerPrior(self.nodes, T_world_root @ self.T_root_scanner, turn @ self.information @ turn.T)

    def add_to_equations(self, T_root_scanner: Array, H: ScannerMatrix, g: Array) -> float:
        """Adds the term at poses (S, 3, 3) to normal equations over all scanners (US), in place; its cost."""
        error = se_n.difference(T_root_scanner[self.nodes], self.T_root_scanner).ravel()
        gradient = self.information @ error
        K, U = len(self.nodes), H.order.unknowns
        block = np.zeros((K, U, K, U))
        block[:, :3, :, :3] = self.information.reshape(K, 3, K, 3)
        H.add(self.nodes, block.reshape(K * U, K * U))
        g.reshape(-1, U)[self.nodes, :3] += gradient.reshape(K, 3)
        return 0.5 * float(error @ gradient)


def build_scanner_prior(poses: NetworkPoses, names: Sequence[str]) -> ScannerPrior:
    """The prior of those scanners of a network that have an earlier pose, in the frame of its root, the first.

    Where the correlations of their errors are unknown (all zero), the prior is weaker than for any correlations.
    """
    shared = [name for name in names[1:] if name in poses.names]
    selected = poses.select([names[0], *shared])
    d = selected.size
    covariance = selected.covariance[d:, d:] + np.diag(np.tile(np.square(_MIN_SIGMA[d]), len(shared)))
    own = np.kron(np.eye(len(shared), dtype=np.bool_), np.ones((d, d), dtype=np.bool_))
    if not covariance[~own].any():
        # Unknown correlations: no joint covariance with these blocks exceeds their number times them.
        covariance *= len(shared)
    # Scaled to correlations before the inversion: variances of unobserved directions are up to 1e6 m².
    scale = np.sqrt(np.diag(covariance))
    information = np.linalg.inv(covariance / np.outer(scale, scale)) / np.outer(scale, scale)
    nodes = np.array([names.index(name) for name in shared], dtype=np.intp)
    return ScannerPrior(nodes, selected.T_root_scanner[1:], (information + information.T) / 2)
