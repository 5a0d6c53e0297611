"""Symmetric matrices over the unknowns of all scanners, such as their normal equations.

Only scanners that measured a common body or wall have common entries. In an order in which those are near each
other (Cuthill and McKee, 1969), the matrix is banded. What all scanners have in common, the part of their
systematic errors, is a matrix of low rank beside it: ``A - V Vᵀ``.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded, solve_triangular
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from calgraph.geometry import Array, Index


@dataclass(frozen=True, eq=False)
class ScannerOrder:
    """An order of S scanners with U unknowns each."""

    position: Index
    """(S,) of each scanner."""
    reach: int
    """Maximum distance in this order of two scanners with common entries."""
    unknowns: int
    """U."""

    @classmethod
    def from_links(cls, count: int, links: Index, unknowns: int) -> "ScannerOrder":
        """A good order for pairs (E, 2) of scanners with common entries."""
        ends = np.concatenate([links, links[:, ::-1]])
        graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count)).tocsr()
        position = np.empty(count, dtype=np.intp)
        position[reverse_cuthill_mckee(graph, symmetric_mode=True)] = np.arange(count)
        distance = np.abs(np.diff(position[links], axis=1))
        return cls(position, int(distance.max(initial=0)), unknowns)

    @cached_property
    def place(self) -> Index:
        """(US,) of each unknown, scanner by scanner, in the order."""
        return np.asarray((self.unknowns * self.position[:, None] + np.arange(self.unknowns)).ravel())


@dataclass(frozen=True, eq=False)
class ScannerMatrix:
    """A matrix ``A - V Vᵀ`` over the unknowns of all scanners."""

    order: ScannerOrder
    band: Array
    """(W, US) lower band of A in the order, in LAPACK's storage."""
    common: Array
    """(US, r) V, scanner by scanner."""

    @classmethod
    def zeros(cls, order: ScannerOrder) -> "ScannerMatrix":
        """The matrix without entries."""
        size = order.unknowns * len(order.position)
        width = min(order.unknowns * (order.reach + 1), size)
        return cls(order, np.zeros((width, size)), np.zeros((size, 0)))

    def add(self, columns: Index, block: Array) -> None:
        """Adds a block (m, m) at different rows and columns (m,), scanner by scanner, in place."""
        place = self.order.place[columns]
        below = place[:, None] - place
        lower = below >= 0
        self.band[below[lower], np.broadcast_to(place, below.shape)[lower]] += block[lower]

    def copy(self) -> "ScannerMatrix":
        """The same, for additions in place."""
        return replace(self, band=self.band.copy())

    def scale(self, factor: float) -> "ScannerMatrix":
        """The matrix times a positive factor."""
        return replace(self, band=factor * self.band, common=np.sqrt(factor) * self.common)

    @property
    def diagonal(self) -> Array:
        """(US,), scanner by scanner."""
        return np.asarray(self.band[0, self.order.place] - np.sum(self.common**2, axis=1))

    def add_diagonal(self, values: Array) -> "ScannerMatrix":
        """The matrix with values (US,) added to its diagonal."""
        band = self.band.copy()
        band[0, self.order.place] += values
        return replace(self, band=band)

    def fix(self, fixed: NDArray[np.bool_]) -> "ScannerMatrix":
        """The matrix with the rows and columns of an identity for what is fixed (US,)."""
        free = np.empty(len(fixed))
        free[self.order.place] = ~fixed
        band = self.band * free
        for below in range(1, len(band)):
            band[below, :-below] *= free[below:]
        band[0] += 1 - free
        return replace(self, band=band, common=np.where(fixed[:, None], 0.0, self.common))

    def select(self, columns: Index) -> Array:
        """The entries (m, m) at rows and columns (m,)."""
        place = self.order.place[columns]
        below = np.abs(place[:, None] - place)
        inside = below < len(self.band)
        banded = self.band[np.where(inside, below, 0), np.minimum(place[:, None], place)]
        return np.where(inside, banded, 0.0) - self.common[columns] @ self.common[columns].T

    def factor(self) -> "ScannerFactor":
        """The Cholesky factor.

        Raises:
            LinAlgError: the matrix is not positive definite.
        """
        return ScannerFactor(self.order, cholesky_banded(self.band, lower=True), self.common)


@dataclass(frozen=True, eq=False)
class ScannerFactor:
    """Cholesky factor of a :class:`ScannerMatrix`; its low rank is that of ``V`` (Woodbury, 1950)."""

    order: ScannerOrder
    lower: Array
    """(W, US) lower band of the factor of A, in the order."""
    common: Array
    """(US, r) V, scanner by scanner."""

    @cached_property
    def _by_common(self) -> tuple[Array, Array]:
        """``A⁻¹ V`` (US, r), scanner by scanner, and ``(I - Vᵀ A⁻¹ V)⁻¹``."""
        solved = self._solve_banded(self.common)
        capacitance = np.eye(self.common.shape[1]) - self.common.T @ solved
        return solved, np.asarray(np.linalg.inv(capacitance), dtype=np.float64)

    def solve(self, right: Array) -> Array:
        """Solutions (US, m) for right-hand sides (US, m), scanner by scanner."""
        by_common, capacitance = self._by_common
        solved = self._solve_banded(right)
        return np.asarray(solved + by_common @ (capacitance @ (self.common.T @ solved)))

    def invert(self, min_width: int) -> "NearInverse":
        """The inverse between scanners that are near each other in the order.

        Takahashi, Fagan and Chen, 1973, for blocks of a banded matrix: each depends on the next one only.

        Args:
            min_width: all pairs of scanners are near each other in each range of this many in the order.
        """
        size, below = self.lower.shape[1], len(self.lower) - 1
        width = min(max(below, self.order.unknowns * min_width, 1), size)
        starts = range(0, size, width)
        diagonal: list[Array] = []
        off_diagonal: list[Array] = []
        for start in reversed(starts):
            L = _expand(self.lower, slice(start, min(start + width, size)))
            inverse = solve_triangular(L, np.eye(len(L)), lower=True)
            block = inverse.T @ inverse
            if diagonal:
                rows = slice(start + width, start + width + len(diagonal[0]))
                gain = _expand_below(self.lower, rows, slice(start, start + width)) @ inverse
                off_diagonal.insert(0, -diagonal[0] @ gain)
                block -= gain.T @ off_diagonal[0]
            diagonal.insert(0, block)
        by_common, capacitance = self._by_common
        return NearInverse(self.order, width, tuple(diagonal), tuple(off_diagonal), by_common, capacitance)

    def _solve_banded(self, right: Array) -> Array:
        place = self.order.place
        ordered = np.empty_like(right)
        ordered[place] = right
        return np.asarray(cho_solve_banded((self.lower, True), ordered)[place])


@dataclass(frozen=True, eq=False)
class NearInverse:
    """Entries of an inverse between scanners that are near each other."""

    order: ScannerOrder
    width: int
    """Of the blocks."""
    diagonal: tuple[Array, ...]
    """Blocks of the inverse of A, in the order."""
    off_diagonal: tuple[Array, ...]
    """Blocks below these."""
    by_common: Array
    """(US, r) ``A⁻¹ V``, scanner by scanner."""
    capacitance: Array
    """(r, r) ``(I - Vᵀ A⁻¹ V)⁻¹``."""

    def select(self, columns: Index) -> Array:
        """The inverse (m, m) at rows and columns (m,); NaN between scanners that are not near each other."""
        block, offset = np.divmod(self.order.place[columns], self.width)
        by_common = self.by_common[columns]
        # In place: those of all scanners of a large network take much memory.
        selected = by_common @ self.capacitance @ by_common.T
        members = [np.flatnonzero(block == n) for n in range(len(self.diagonal))]
        for n, rows in enumerate(members):
            selected[np.ix_(rows, np.flatnonzero(np.abs(block - n) > 1))] = np.nan
            selected[np.ix_(rows, rows)] += self.diagonal[n][np.ix_(offset[rows], offset[rows])]
            if n and len(rows):
                before = members[n - 1]
                mixed = self.off_diagonal[n - 1][np.ix_(offset[rows], offset[before])]
                selected[np.ix_(rows, before)] += mixed
                selected[np.ix_(before, rows)] += mixed.T
        return np.asarray(selected)


def _expand(lower: Array, at: slice) -> Array:
    """The lower triangular block on the diagonal of a lower band, dense."""
    size = at.stop - at.start
    dense = np.zeros((size, size))
    for below in range(min(len(lower), size)):
        k = np.arange(size - below)
        dense[k + below, k] = lower[below, at.start : at.stop - below]
    return dense


def _expand_below(lower: Array, rows: slice, columns: slice) -> Array:
    """The dense block of a lower band below its diagonal."""
    row, column = np.arange(rows.start, rows.stop)[:, None], np.arange(columns.start, columns.stop)
    below = row - column
    inside = below < len(lower)
    return np.where(inside, lower[np.where(inside, below, 0), column], 0.0)
