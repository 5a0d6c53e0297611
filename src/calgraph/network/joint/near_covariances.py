"""Covariances between scanners that are near each other: those of all pairs would be dense."""

from dataclasses import dataclass, replace

import numpy as np

from calgraph.geometry import Array, Index


@dataclass(frozen=True, eq=False)
class NearCovariances:
    """Covariances of n errors of each of S scanners, for E pairs of scanners; unknown for others."""

    count: int
    """S."""
    pairs: Index
    """(E, 2) scanners, the first not after the second; each scanner with itself is one of them."""
    blocks: Array
    """(E, n, n), with the first scanner's rows."""

    @property
    def own(self) -> Array:
        """(S, n, n) of each scanner."""
        first, second = self.pairs.T
        own = np.empty((self.count, *self.blocks.shape[1:]))
        own[first[first == second]] = self.blocks[first == second]
        return own

    @property
    def stddev(self) -> Array:
        """(S, n)."""
        return np.asarray(np.sqrt(np.diagonal(self.own, axis1=1, axis2=2)))

    def scale(self, factor: float) -> "NearCovariances":
        """The covariances times a factor."""
        return replace(self, blocks=factor * self.blocks)

    def select_errors(self, errors: Index) -> "NearCovariances":
        """Those of some of the n errors."""
        return replace(self, blocks=self.blocks[:, errors[:, None], errors])

    def list_near(self, scanner: int) -> Index:
        """Scanners whose covariance with this one is known, itself among them, ascending."""
        first, second = self.pairs.T
        return np.union1d(second[first == scanner], first[second == scanner])

    def select_scanners(self, scanners: Index) -> "NearCovariances":
        """Those of some scanners, ascending."""
        number = np.full(self.count, -1)
        number[scanners] = np.arange(len(scanners))
        pairs = number[self.pairs]
        inside = (pairs >= 0).all(axis=1)
        return NearCovariances(len(scanners), pairs[inside], self.blocks[inside])

    def expand(self, unknown: float = np.nan) -> Array:
        """(nS, nS), scanner by scanner, with a value for what is not known."""
        n = self.blocks.shape[1]
        dense = np.full((self.count, n, self.count, n), unknown)
        first, second = self.pairs.T
        dense[first, :, second] = self.blocks
        dense[second, :, first] = self.blocks.swapaxes(1, 2)
        return dense.reshape(self.count * n, -1)
