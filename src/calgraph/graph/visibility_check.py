"""Pairs that a network as a whole refutes: were they right, people would have passed its scanners unnoticed.

What two scanners should have seen of each other's people refutes most wrong poses of a pair, but not all: they
may share a few seconds only, in which people walk alike. A part of a network at a wrong place stands among many
scanners, each of which saw others there than it did.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.graph.tree_cuts import fundamental_cuts
from calgraph.pairwise.synchronized_tracks import pair_samples
from calgraph.pairwise.visibility_map import ScannerObservations, find_missed_detections

Flags = NDArray[np.bool_]

# A scanner sees somebody within this distance of where another one saw him, m.
_THERE = 0.5
# A place is refuted if more than this share of what should have been seen was not, of so many positions at least
# (every 0.1 s, of each scanner).
_MISSED, _EXPECTED = 0.5, 50
# Of so many ticks at most positions are compared.
_TICKS = 1000


@dataclass(frozen=True, eq=False)
class VisibilityConflict:
    """A part of a network that is not where it was put."""

    part: Flags
    """(N,) its scanners; the root is not among them."""
    edges: Flags
    """(E,) those that hold it there."""
    missed_share: float
    """Which share of what it and the others should have seen of each other's people they did not."""


def find_visibility_conflict(
    graph: PoseGraph, sights: Sequence[ScannerObservations], averaged: PoseGraphSolution, worth: Array
) -> VisibilityConflict | None:
    """The part of a network whose place is refuted most clearly; None where no place is.

    Every tie of the tree of best evidence cuts the network in two. All that one side saw where the other one has
    an open view, some scanner of the other side should have seen, too.

    Args:
        graph: of the network.
        sights: of its scanners, node by node.
        averaged: the poses found, and the edges that agree.
        worth: (E,) evidence of each edge.
    """
    seen = _compare_detections(sights, averaged.T_root_node)
    i, j = graph.edges.T
    worst: VisibilityConflict | None = None
    for _, part in fundamental_cuts(graph, np.where(averaged.inliers, worth, 0.0)):
        expected, missed = seen.count_across(part)
        share = missed / max(expected, 1)
        if expected >= _EXPECTED and share > (worst.missed_share if worst else _MISSED):
            worst = VisibilityConflict(part, averaged.inliers & (part[i] != part[j]), share)
    return worst


def is_confirmed_by_visibility(sights: Sequence[ScannerObservations], T_root_node: Array, part: Flags) -> bool:
    """Whether a part (N,) of a network is at its place by what it and the others saw of each other's people.

    Args:
        sights: of the scanners, node by node.
        T_root_node: (N, 3, 3) their poses.
        part: (N,) some of them.
    """
    expected, missed = _compare_detections(sights, T_root_node).count_across(part)
    return expected >= _EXPECTED and missed <= _MISSED * expected


@dataclass(frozen=True, eq=False)
class _MutualDetections:
    """Of all samples, scanner by scanner, what others should have seen of them and what they did."""

    count: int
    """Samples of all scanners."""
    step: int
    """Which are of every so many ticks."""
    pairs: tuple[tuple[int, int, NDArray[np.intp], Flags, Flags], ...]
    """Two scanners, numbers (M,) of their samples, and whether the other one should have seen each, and did."""

    def count_across(self, far: Flags) -> tuple[int, int]:
        """How many of each other's positions a part (N,) and the rest should have seen, and how many none did."""
        expected, noticed = np.zeros((2, self.count), dtype=np.bool_)
        for a, b, samples, should, did in self.pairs:
            if far[a] != far[b]:
                expected[samples] |= should
                noticed[samples] |= did
        return self.step * int(np.count_nonzero(expected)), self.step * int(np.count_nonzero(expected & ~noticed))


def _compare_detections(sights: Sequence[ScannerObservations], T_root_node: Array) -> _MutualDetections:
    ticks = np.concatenate([np.zeros(0, dtype=np.intp), *(own.samples.tick for own in sights)])
    step = max(1, int(np.ptp(ticks)) // _TICKS) if len(ticks) else 1
    sights = [own.subsample(step) for own in sights]
    sizes = [len(own.samples.tick) for own in sights]
    begin = np.cumsum(sizes) - sizes
    numbers = [first + np.arange(size) for first, size in zip(begin, sizes, strict=True)]
    reach = np.array([own.visibility.max_range for own in sights])
    at = T_root_node[:, :2, 2]
    near = np.linalg.norm(at[:, None] - at, axis=-1) < reach[:, None] + reach
    pairs = []
    for a, b in np.argwhere(np.triu(near, 1)).tolist():
        met = pair_samples(sights[a].samples, sights[b].samples)
        T_a_b = se2.inverse(T_root_node[a]) @ T_root_node[b]
        (should,), (did,) = find_missed_detections(
            T_a_b[None], met, sights[a].visibility, sights[b].visibility, _THERE
        )
        if should.any():
            pairs.append((a, b, np.concatenate([numbers[a], numbers[b]]), should, did))
    return _MutualDetections(sum(sizes), step, tuple(pairs))
