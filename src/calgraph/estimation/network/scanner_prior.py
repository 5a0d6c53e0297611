"""What an earlier calibration says of a network's scanners, as a term of the joint solution."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.estimation.network.planar_poses import PlanarPoses
from calgraph.geometry import Array, Index, se2

# Nobody is mounted more precisely than this, m and rad: a covariance of 0 would hold a scanner however wrong.
_LEAST = (1e-5, 1e-5, 1e-6)


@dataclass(frozen=True, eq=False)
class ScannerPrior:
    """Where some scanners are about, in the root's frame."""

    nodes: Index
    """(K,)."""
    T_root_scanner: Array
    """(K, 3, 3)."""
    information: Array
    """(3K, 3K) of all of them together, in the root's fixed axes."""

    def add(self, T_root_scanner: Array, H: Array, g: Array) -> float:
        """Adds the term at poses (S, 3, 3) to normal equations over poses and clocks (4S), in place; its cost."""
        error = se2.difference(T_root_scanner[self.nodes], self.T_root_scanner).ravel()
        pull = self.information @ error
        columns = (4 * self.nodes[:, None] + np.arange(3)).ravel()
        H[np.ix_(columns, columns)] += self.information
        g[columns] += pull
        return 0.5 * float(error @ pull)


def prior_of(known: PlanarPoses, names: Sequence[str]) -> ScannerPrior:
    """The prior on those of a network's scanners that are known.

    Args:
        known: in the frame of the network's root.
        names: of the network, the root first.
    """
    shared = [name for name in names[1:] if name in known.names]
    own = known.of([names[0], *shared])
    spread = own.covariance[3:, 3:] + np.diag(np.tile(np.square(_LEAST), len(shared)))
    # Metres and radians, and kilometres where nothing was observed: scaled, they invert well.
    size = np.sqrt(np.diag(spread))
    information = np.linalg.inv(spread / np.outer(size, size)) / np.outer(size, size)
    nodes = np.array([names.index(name) for name in shared], dtype=np.intp)
    return ScannerPrior(nodes, own.T_root_scanner[1:], (information + information.T) / 2)
