"""Symmetric matrices over the unknowns of all scanners, such as their normal equations.

Only scanners that measured a common body or wall have common entries. What all scanners have in common, a part of
their systematic errors, is a matrix of low rank beside these: ``A - V Vᵀ``.
"""

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import bsr_array

from calgraph.geometry import Array, Index
from calgraph.network.joint.scanner_order import ScannerOrder


@dataclass(frozen=True, eq=False)
class ScannerMatrix:
    """A matrix ``A - V Vᵀ`` over the unknowns of all scanners."""

    order: ScannerOrder
    entries: Array
    """(E, U, U) blocks of A, with the later scanner's rows; whole ones on the diagonal, too."""
    common: Array
    """(US, r) V, scanner by scanner."""

    @classmethod
    def zeros(cls, order: ScannerOrder) -> "ScannerMatrix":
        """The matrix without entries."""
        U = order.unknowns
        return cls(order, np.zeros((len(order.ends), U, U)), np.zeros((order.count * U, 0)))

    def add(self, scanners: Index, block: Array) -> None:
        """Adds a block (mU, mU) of different scanners (m,) that are linked with each other, in place."""
        m, U = len(scanners), self.order.unknowns
        row, column = np.tril_indices(m)
        swapped = self.order.position[scanners[row]] < self.order.position[scanners[column]]
        row, column = np.where(swapped, column, row), np.where(swapped, row, column)
        numbers = self.order.number_pairs(scanners[row], scanners[column])
        blocks = block.reshape(m, U, m, U)[row, :, column]
        self.entries[np.searchsorted(self.order.numbers, numbers)] += blocks

    def copy(self) -> "ScannerMatrix":
        """The same, for additions in place."""
        return replace(self, entries=self.entries.copy())

    def scale(self, factor: float) -> "ScannerMatrix":
        """The matrix times a positive factor."""
        return replace(self, entries=factor * self.entries, common=np.sqrt(factor) * self.common)

    @property
    def diagonal(self) -> Array:
        """(US,), scanner by scanner."""
        own = np.diagonal(self.entries[self.order.own], axis1=1, axis2=2).ravel()
        return np.asarray(own - np.sum(self.common**2, axis=1))

    def add_diagonal(self, values: Array) -> "ScannerMatrix":
        """The matrix with values (US,) added to its diagonal."""
        added, k = self.copy(), np.arange(self.order.unknowns)
        added.entries[self.order.own[:, None], k, k] += values.reshape(-1, len(k))
        return added

    def fix(self, fixed: NDArray[np.bool_]) -> "ScannerMatrix":
        """The matrix with the rows and columns of an identity for what is fixed (US,)."""
        free = 1.0 - fixed.reshape(self.order.count, -1)
        later, earlier = self.order.ends.T
        entries = self.entries * free[later, :, None] * free[earlier, None]
        without = replace(self, entries=entries, common=np.where(fixed[:, None], 0.0, self.common))
        return without.add_diagonal(fixed.astype(np.float64))

    def select(self, columns: Index) -> Array:
        """The entries (m, m) at rows and columns (m,)."""
        scanner, unknown = np.divmod(columns, self.order.unknowns)
        position = self.order.position[scanner]
        swapped = position[:, None] < position
        ends = np.broadcast_arrays(scanner[:, None], scanner)
        unknowns = np.broadcast_arrays(unknown[:, None], unknown)
        later, earlier = (np.where(swapped, *pair) for pair in (ends[::-1], ends))
        row, column = (np.where(swapped, *pair) for pair in (unknowns[::-1], unknowns))
        numbers = self.order.number_pairs(later, earlier)
        entry = np.minimum(np.searchsorted(self.order.numbers, numbers), len(self.entries) - 1)
        selected = np.where(self.order.numbers[entry] == numbers, self.entries[entry, row, column], 0.0)
        return np.asarray(selected - self.common[columns] @ self.common[columns].T)

    def multiply(self, values: Array) -> Array:
        """The product with values (US, m), scanner by scanner."""
        count, used = self.order.count, np.flatnonzero(self.entries.any(axis=(1, 2)))
        later, earlier = self.order.ends[used].T
        ends = np.searchsorted(later, np.arange(count + 1))
        lower = bsr_array((self.entries[used], earlier, ends), shape=(len(values),) * 2)
        own = self.entries[self.order.own] @ values.reshape(count, self.order.unknowns, -1)
        common = self.common @ (self.common.T @ values)
        return np.asarray(lower @ values + lower.T @ values - own.reshape(values.shape) - common)

    def factor(self) -> "ScannerFactor":
        """The Cholesky factor.

        Raises:
            LinAlgError: the matrix is not positive definite.
        """
        U, factors = self.order.unknowns, []
        # What children leave to their parents.
        waiting: dict[int, Array] = {}
        for k, front in enumerate(self.order.fronts):
            n, size = len(front.scanners), U * front.eliminated
            blocks = waiting.pop(k, None)
            if blocks is None:
                blocks = np.zeros((n, U, n, U))
            blocks[front.rows, :, front.columns] += self.entries[front.entries]
            dense = blocks.reshape(n * U, n * U)
            own = cholesky(dense[:size, :size], lower=True)
            below = solve_triangular(own, dense[size:, :size].T, lower=True).T
            factors.append((own, below))
            if front.parent is not None:
                others, others_in_parent = n - front.eliminated, len(self.order.fronts[front.parent].scanners)
                if front.parent not in waiting:
                    waiting[front.parent] = np.zeros((others_in_parent, U, others_in_parent, U))
                rest = (dense[size:, size:] - below @ below.T).reshape(others, U, others, U)
                waiting[front.parent][front.in_parent[:, None], :, front.in_parent] += rest.transpose(0, 2, 1, 3)
        return ScannerFactor(self.order, tuple(factors), self.common)


@dataclass(frozen=True, eq=False)
class ScannerFactor:
    """Cholesky factor of a :class:`ScannerMatrix`; its low rank is that of ``V`` (Woodbury, 1950)."""

    order: ScannerOrder
    fronts: tuple[tuple[Array, Array], ...]
    """By front: the factor of A over what is eliminated there, lower triangular, and its rows below that."""
    common: Array
    """(US, r) V, scanner by scanner."""

    @cached_property
    def _by_common(self) -> tuple[Array, Array]:
        """``A⁻¹ V`` (US, r), scanner by scanner, and ``(I - Vᵀ A⁻¹ V)⁻¹``."""
        solved = self._solve_sparse(self.common)
        capacitance = np.eye(self.common.shape[1]) - self.common.T @ solved
        return solved, np.asarray(np.linalg.inv(capacitance), dtype=np.float64)

    def solve(self, right: Array) -> Array:
        """Solutions (US, m) for right-hand sides (US, m), scanner by scanner."""
        by_common, capacitance = self._by_common
        solved = self._solve_sparse(right)
        return np.asarray(solved + by_common @ (capacitance @ (self.common.T @ solved)))

    def invert_block(self, columns: Index) -> Array:
        """The inverse (m, m) at rows and columns (m,)."""
        # With the factor L of A, A⁻¹ = L⁻ᵀ L⁻¹: fronts that these columns of L⁻¹ do not reach take no time.
        unit = np.zeros((len(self.common), len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        self._solve_forward(unit)
        by_common, capacitance = self._by_common
        common = by_common[columns]
        return np.asarray(unit.T @ unit + common @ capacitance @ common.T)

    def invert(self) -> "NearInverse":
        """The inverse between scanners of one front, parents first (Takahashi, Fagan and Chen, 1973)."""
        fronts, rows = self.order.fronts, list[Array]()
        children = Counter(front.parent for front in fronts)
        # Inverses of whole fronts, for as long as children need them.
        whole: dict[int, Array] = {}
        for k in reversed(range(len(fronts))):
            own, below = self.fronts[k]
            inverse = solve_triangular(own, np.eye(len(own)), lower=True)
            eliminated, mixed, others = inverse.T @ inverse, np.zeros((0, len(own))), np.zeros((0, 0))
            if (parent := fronts[k].parent) is not None:
                place = self._place(fronts[k].in_parent)
                others = whole[parent][np.ix_(place, place)]
                children[parent] -= 1
                if not children[parent]:
                    del whole[parent]
                gain = below @ inverse
                mixed = -others @ gain
                eliminated -= gain.T @ mixed
            rows.append(np.hstack([eliminated, mixed.T]))
            if children[k]:
                whole[k] = np.vstack([rows[-1], np.hstack([mixed, others])])
        return NearInverse(self.order, tuple(reversed(rows)), *self._by_common)

    def _solve_sparse(self, right: Array) -> Array:
        """The product of A⁻¹ with (US, m)."""
        solved = right.copy()
        self._solve_forward(solved)
        for front, (own, below) in zip(reversed(self.order.fronts), reversed(self.fronts), strict=True):
            eliminated, others = np.split(self._place(front.scanners), [len(own)])
            right_here = solved[eliminated] - below.T @ solved[others]
            solved[eliminated] = solve_triangular(own, right_here, lower=True, trans="T")
        return solved

    def _solve_forward(self, right: Array) -> None:
        """Multiplies (US, m) by L⁻¹, in place."""
        for front, (own, below) in zip(self.order.fronts, self.fronts, strict=True):
            eliminated, others = np.split(self._place(front.scanners), [len(own)])
            if right[eliminated].any():
                right[eliminated] = solve_triangular(own, right[eliminated], lower=True)
                right[others] -= below @ right[eliminated]

    def _place(self, scanners: Index) -> Index:
        """Places of the unknowns of scanners, scanner by scanner."""
        return np.asarray((self.order.unknowns * scanners[:, None] + np.arange(self.order.unknowns)).ravel())


@dataclass(frozen=True, eq=False)
class NearInverse:
    """Entries of an inverse between scanners of one front."""

    order: ScannerOrder
    rows: tuple[Array, ...]
    """By front: the inverse of A at the unknowns of what is eliminated there, and of all its scanners."""
    by_common: Array
    """(US, r) ``A⁻¹ V``, scanner by scanner."""
    capacitance: Array
    """(r, r) ``(I - Vᵀ A⁻¹ V)⁻¹``."""

    def select(self, columns: Index) -> Array:
        """The inverse (m, m) at rows and columns (m,); NaN between scanners that no front contains."""
        scanner, unknown = np.divmod(columns, self.order.unknowns)
        front_of, selected = self.order.front_of[scanner], np.full((len(columns), len(columns)), np.nan)
        place = np.full(self.order.count, -1)
        for k in np.unique(front_of).tolist():
            front = self.order.fronts[k]
            place[front.scanners] = np.arange(len(front.scanners))
            inside, own = np.flatnonzero(place[scanner] >= 0), np.flatnonzero(front_of == k)
            at = self.order.unknowns * place[scanner] + unknown
            of_own = self.rows[k][np.ix_(at[own], at[inside])]
            selected[np.ix_(inside, own)], selected[np.ix_(own, inside)] = of_own.T, of_own
            place[front.scanners] = -1
        by_common = self.by_common[columns]
        # In place, row by row: those of all scanners of a large network take much memory.
        for row, left in enumerate(by_common @ self.capacitance):
            selected[row] += by_common @ left
        return selected

    def select_pairs(self, pairs: Index) -> Array:
        """The inverse (E, U, U) of pairs of scanners (E, 2), with the first one's rows; NaN as :meth:`select`."""
        U, order = self.order.unknowns, self.order
        swapped = order.position[pairs[:, 0]] > order.position[pairs[:, 1]]
        earlier, later = np.where(swapped[:, None], pairs[:, ::-1], pairs).T
        selected, place = np.full((len(pairs), U, U), np.nan), np.full(order.count, -1)
        front_of = order.front_of[earlier]
        by_front = np.argsort(front_of, kind="stable")
        ends = np.searchsorted(front_of[by_front], np.arange(len(order.fronts) + 1))
        for front, rows, begin, end in zip(order.fronts, self.rows, ends[:-1], ends[1:], strict=True):
            place[front.scanners] = np.arange(len(front.scanners))
            chosen = by_front[begin:end]
            chosen = chosen[place[later[chosen]] >= 0]
            blocks = rows.reshape(-1, U, len(front.scanners), U)
            selected[chosen] = blocks[place[earlier[chosen]], :, place[later[chosen]]]
            place[front.scanners] = -1
        by_common = self.by_common.reshape(order.count, U, -1)
        selected += by_common[earlier] @ self.capacitance @ by_common[later].swapaxes(1, 2)
        return np.where(swapped[:, None, None], selected.swapaxes(1, 2), selected)
