"""The order in which the unknowns of scanners are eliminated from their equations.

Eliminating a scanner links all that are linked with it. In the order of minimum degree (Tinney and Walker, 1967),
these new links are few. Scanners that are eliminated together are a front (Duff and Reid, "The multifrontal
solution of indefinite sparse symmetric linear equations", 1983): a dense matrix over them and those that they are
linked with by then.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from heapq import heapify, heappop, heappush

import numpy as np

from calgraph.geometry import Index


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
