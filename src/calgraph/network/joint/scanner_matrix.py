"""Symmetric matrices over the unknowns of all scanners, such as their normal equations, and their factors.

Only scanners that measured a common body or wall have common entries. What all scanners have in common, a part of
their systematic errors, is a matrix of low rank beside these: ``A - V Vᵀ``.

Eliminating a scanner links all that are linked with it. In the order of minimum degree (Tinney and Walker, 1967),
these new links are few. Scanners that are eliminated together are a front (Duff and Reid, "The multifrontal
solution of indefinite sparse symmetric linear equations", 1983): a dense matrix over them and those that they are
linked with by then.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from heapq import heapify, heappop, heappush

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import bsr_array

from calgraph.geometry import Array, Index


@dataclass(frozen=True, eq=False)
class Front:
    """Scanners that are eliminated together."""

    scanners: Index
    """(n,) those that are eliminated, then those that they are linked with, in the order of elimination."""
    eliminated: int
    """Number of the first ones."""
    parent: int | None
    """The front that the next of the others is eliminated in, which contains all of them; None without others."""
    in_parent: Index
    """Places of the others in it."""
    entries: Index
    """(e,) entries of a matrix over all scanners with one of the eliminated ones."""
    rows: Index
    """(e,) places of their scanners here;"""
    columns: Index
    """(e,) and of the other scanners, which come earlier or are the same."""


@dataclass(frozen=True, eq=False)
class ScannerOrder:
    """The order of elimination of S scanners with U unknowns each."""

    position: Index
    """(S,) of each scanner; those near each other in the order are near each other in the network."""
    fronts: tuple[Front, ...]
    """Each before its parent."""
    ends: Index
    """(E, 2) scanners with common entries in ascending order of :meth:`number_pairs`, each with itself, too."""
    unknowns: int
    """U."""

    @classmethod
    def from_links(cls, count: int, links: Index, unknowns: int) -> "ScannerOrder":
        """A good order of scanners with U unknowns each, of which pairs (E, 2) have common entries."""
        groups = _find_groups(count, links)
        order = [scanner for members, _ in groups for scanner in members]
        position = np.empty(count, dtype=np.intp)
        position[order] = np.arange(count)
        pairs = np.sort(np.concatenate([links, np.repeat(np.arange(count)[:, None], 2, axis=1)]), axis=1)
        pairs = np.unique(pairs, axis=0).astype(np.intp)
        later = position[pairs[:, 0]] > position[pairs[:, 1]]
        ends = np.where(later[:, None], pairs, pairs[:, ::-1])
        ends = ends[np.lexsort((ends[:, 1], ends[:, 0]))]
        return cls(position, _build_fronts(groups, position, ends), ends, unknowns)

    @classmethod
    def complete(cls, count: int, unknowns: int) -> "ScannerOrder":
        """That of scanners which are all linked."""
        return cls.from_links(count, np.column_stack(np.triu_indices(count, 1)), unknowns)

    @property
    def count(self) -> int:
        """S."""
        return len(self.position)

    @cached_property
    def numbers(self) -> Index:
        """(E,) of the scanners with common entries, ascending."""
        return self.number_pairs(*self.ends.T)

    @cached_property
    def own(self) -> Index:
        """(S,) entry of each scanner with itself."""
        scanners = np.arange(self.count)
        return np.searchsorted(self.numbers, self.number_pairs(scanners, scanners))

    @cached_property
    def front_of(self) -> Index:
        """(S,) the front in which each scanner is eliminated."""
        front = np.empty(self.count, dtype=np.intp)
        for k, one in enumerate(self.fronts):
            front[one.scanners[: one.eliminated]] = k
        return front

    def number_pairs(self, later: Index, earlier: Index) -> Index:
        """A number for each pair of scanners (...)."""
        return np.asarray(self.count * later + earlier, dtype=np.intp)


_Group = tuple[list[int], set[int]]
"""Scanners that are eliminated together, in order, and those that they are linked with by then."""


def _find_groups(count: int, links: Index) -> list[_Group]:
    """The scanners of all fronts, each before its parent."""
    linked: list[set[int]] = [set() for _ in range(count)]
    for a, b in links.tolist():
        linked[a].add(b)
        linked[b].add(a)
    order = _eliminate_by_degree(linked)
    rank = {scanner: k for k, scanner in enumerate(order)}
    children: dict[int | None, list[int]] = {None: [], **{scanner: [] for scanner in order}}
    for scanner in order:
        children[min(linked[scanner], key=rank.__getitem__, default=None)].append(scanner)
    groups, waiting = list[_Group](), children[None]
    while waiting:
        members, joined = list[int](), [waiting.pop()]
        others = linked[joined[0]]
        while joined:
            members = joined + members
            below = children[members[0]]
            # One with the same links, but for the next scanner, is eliminated together with that.
            joined = [child for child in below if len(linked[child]) == len(linked[members[0]]) + 1][:1]
            waiting += (child for child in below if child not in joined)
        groups.append((members, others))
    return groups[::-1]


def _eliminate_by_degree(linked: list[set[int]]) -> list[int]:
    """The order of elimination; the links of each scanner become those with later ones."""
    waiting = [(len(others), scanner) for scanner, others in enumerate(linked)]
    heapify(waiting)
    order, eliminated = [], set[int]()
    while waiting:
        degree, scanner = heappop(waiting)
        others = linked[scanner]
        if scanner in eliminated or degree != len(others):
            continue
        eliminated.add(scanner)
        order.append(scanner)
        for other in others:
            linked[other] |= others
            linked[other] -= {other, scanner}
            heappush(waiting, (len(linked[other]), other))
    return order


def _build_fronts(groups: Sequence[_Group], position: Index, ends: Index) -> tuple[Front, ...]:
    scanners = [
        np.array([*members, *sorted(others, key=position.__getitem__)], dtype=np.intp)
        for members, others in groups
    ]
    front_of = np.repeat(np.arange(len(groups)), [len(members) for members, _ in groups])[position]
    by_front = np.argsort(front_of[ends[:, 1]], kind="stable")
    bounds = np.searchsorted(front_of[ends[by_front, 1]], np.arange(len(groups) + 1))
    place, fronts = np.empty(len(position), dtype=np.intp), []
    for k, (members, others) in enumerate(groups):
        parent = int(front_of[scanners[k][len(members)]]) if others else None
        if parent is not None:
            place[scanners[parent]] = np.arange(len(scanners[parent]))
        in_parent = place[scanners[k][len(members) :]]
        place[scanners[k]] = np.arange(len(scanners[k]))
        entries = by_front[bounds[k] : bounds[k + 1]]
        rows, columns = place[ends[entries]].T
        fronts.append(Front(scanners[k], len(members), parent, in_parent, entries, rows, columns))
    return tuple(fronts)


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
