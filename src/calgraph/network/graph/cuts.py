"""What contradicts the poses of a whole network: its cuts, and a rule for each kind of contradiction.

Each edge of the maximum spanning tree by evidence defines a fundamental cut: the part of the network that it
connects to the root. Of each part the rules ask

- whether matches by chance alone connect it;
- whether its scanners detect what the others do of the same people: the same test of a single pair rejects most
  wrong hypotheses, but not all, as two scanners may share a few seconds only, in which people move similarly;
- whether better evidence puts it elsewhere: people who walk side by side are associated wrongly by several
  scanners, so that wrong pairs agree with each other, and the number of agreeing pairs is a weak test;
- whether another place has nearly as much evidence.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.graph.spanning_tree import fundamental_cuts
from calgraph.network.pairs.scanner_pair import MIN_COUPLE_SHIFT, SAME_ANGLE, SAME_POSITION, SAME_TURN
from calgraph.network.pairs.synchronized_tracks import pair_samples
from calgraph.network.pairs.visibility_map import (
    DETECTION_RADIUS,
    MAX_MISSED_SHARE,
    Flags,
    ScannerObservations,
    find_missed_detections,
)
from calgraph.solver.connected_parts import label_parts


@dataclass(frozen=True, eq=False)
class Cut:
    """A part of a network, and the rest."""

    tree_edge: int
    """That of most evidence between them."""
    part: Flags
    """(N,) its scanners, without the root."""
    across: Flags
    """(E,) the edges between the part and the rest."""


@dataclass(frozen=True, eq=False)
class AveragedGraph:
    """The graph of a network with averaged poses."""

    graph: PoseGraph
    solution: PoseGraphSolution
    """The estimated poses and their inliers."""
    evidence: Array
    """(E,) of each edge."""

    @cached_property
    def cuts(self) -> list[Cut]:
        """Those of the tree of most evidence among the inliers."""
        i, j = self.graph.edges.T
        return [
            Cut(edge, part, part[i] != part[j])
            for edge, part in fundamental_cuts(self.graph, np.where(self.solution.inliers, self.evidence, 0.0))
        ]


def find_chance_connections(averaged: AveragedGraph, by_chance: Flags) -> Flags:
    """Finds the edges by chance between parts of a network that no other inlier connects.

    Args:
        averaged: the network.
        by_chance: (E,) edges whose matches may be by chance.

    Returns:
        (E,) mask.
    """
    graph = averaged.graph
    part = label_parts(graph.count, graph.edges[averaged.solution.inliers & ~by_chance])
    i, j = graph.edges.T
    return np.asarray(by_chance & (part[i] != part[j]))


@dataclass(frozen=True, eq=False)
class VisibilityConflict:
    """A part of a network whose pose the detections contradict."""

    part: Flags
    """(N,) its scanners, without the root."""
    edges: Flags
    """(E,) the inlier edges between the part and the rest."""
    missed_share: float
    """Share of the expected detections between the part and the rest that are missing."""


# Expected detections, of each scanner at every tick, from which the pose of a part of a network is tested.
_MIN_EXPECTED_OF_PART = 50


def find_visibility_conflict(
    averaged: AveragedGraph, observations: Sequence[ScannerObservations]
) -> VisibilityConflict | None:
    """The part of a network that misses too many detections and is connected by least evidence; None without one.

    What one side detects within the open view of the other, some scanner of the other side should detect, too. A
    wrong edge contradicts the cuts of correct ones, too, where these have the scanners that it misplaces on one
    side: the weakest is rejected first.

    Args:
        averaged: the network.
        observations: of its scanners, node by node.
    """
    detections = _compare_detections(observations, averaged.solution.T_root_node)
    conflicts: list[tuple[float, VisibilityConflict]] = []
    for cut in averaged.cuts:
        expected, missed = detections.count_across(cut.part)
        if expected >= _MIN_EXPECTED_OF_PART and missed > MAX_MISSED_SHARE * expected:
            edges = averaged.solution.inliers & cut.across
            conflict = VisibilityConflict(cut.part, edges, missed / expected)
            conflicts.append((float(averaged.evidence[edges].sum()), conflict))
    return min(conflicts, key=lambda conflict: conflict[0])[1] if conflicts else None


def is_confirmed_by_visibility(
    observations: Sequence[ScannerObservations], T_root_node: Array, part: Flags
) -> bool:
    """Whether enough detections are expected between a part (N,) and the rest, and most of them were made.

    Args:
        observations: of the scanners, node by node.
        T_root_node: (N, 3, 3) their poses.
        part: (N,) some of them.
    """
    detections = _compare_detections(observations, T_root_node)
    expected, missed = detections.count_across(part)
    return expected >= _MIN_EXPECTED_OF_PART and missed <= MAX_MISSED_SHARE * expected


@dataclass(frozen=True, eq=False)
class _MutualDetections:
    """Which samples of the scanners other scanners should have detected, and which they did."""

    count: int
    """Samples of all scanners."""
    step: int
    """Each sample stands for this number of ticks."""
    ends: NDArray[np.intp]
    """(P, 2) scanners of each pair."""
    pairs: tuple[tuple[NDArray[np.intp], Flags, Flags], ...]
    """Of each pair the indices (M,) of samples, whether the other one should have detected each, and did."""

    def count_across(self, part: Flags) -> tuple[int, int]:
        """Number of detections expected between a part (N,) and the rest, and number of those that none made."""
        expected, detected = np.zeros((2, self.count), dtype=np.bool_)
        a, b = self.ends.T
        for k in np.flatnonzero(part[a] != part[b]).tolist():
            samples, pair_expected, pair_detected = self.pairs[k]
            expected[samples] |= pair_expected
            detected[samples] |= pair_detected
        return self.step * int(np.count_nonzero(expected)), self.step * int(np.count_nonzero(expected & ~detected))


# Longer recordings are subsampled to this number of ticks for the test of a part, which bounds its time.
_MAX_TICKS = 1000


def _compare_detections(observations: Sequence[ScannerObservations], T_root_node: Array) -> _MutualDetections:
    ticks = np.concatenate([np.zeros(0, dtype=np.intp), *(scanner.samples.tick for scanner in observations)])
    step = max(1, int(np.ptp(ticks)) // _MAX_TICKS) if len(ticks) else 1
    observations = [scanner.subsample(step) for scanner in observations]
    sizes = [len(scanner.samples.tick) for scanner in observations]
    starts = np.cumsum(sizes) - sizes
    indices = [start + np.arange(size) for start, size in zip(starts, sizes, strict=True)]
    max_range = np.array([scanner.visibility.max_range for scanner in observations])
    t = T_root_node[:, :2, 2]
    in_reach = np.linalg.norm(t[:, None] - t, axis=-1) < max_range[:, None] + max_range
    ends, pairs = [], []
    for a, b in np.argwhere(np.triu(in_reach, 1)).tolist():
        simultaneous = pair_samples(observations[a].samples, observations[b].samples)
        T_a_b = se2.inverse(T_root_node[a]) @ T_root_node[b]
        maps = observations[a].visibility, observations[b].visibility
        (expected,), (detected,) = find_missed_detections(T_a_b[None], simultaneous, *maps, DETECTION_RADIUS)
        if expected.any():
            ends.append((a, b))
            pairs.append((np.concatenate([indices[a], indices[b]]), expected, detected))
    of_pairs = np.array(ends, dtype=np.intp).reshape(-1, 2)
    return _MutualDetections(sum(sizes), step, of_pairs, tuple(pairs))


@dataclass(frozen=True, eq=False)
class ConflictingEvidence:
    """A part of a network whose pose better evidence contradicts."""

    part: Flags
    """(N,) its scanners, without the root."""
    T_root_node: Array
    """(N, 3, 3) all poses, with the part moved to where the better evidence puts it."""
    weaker_edges: Flags
    """(E,) edges between the part and the rest that contradict the moved poses and have less evidence."""
    reason: str
    """Why the estimated pose is in conflict."""


def find_conflicting_evidence(averaged: AveragedGraph, names: Sequence[str]) -> ConflictingEvidence | None:
    """The largest part of a network that a hypothesis with more evidence would put elsewhere; None without one.

    Across a cut, the tree edge is the one of most evidence among the inliers. An outlier across the cut that has
    more evidence, and contradicts the poses, is a conflict of the part.

    Args:
        averaged: the network.
        names: of its scanners.
    """
    graph, evidence, T_root_node = averaged.graph, averaged.evidence, averaged.solution.T_root_node
    conflicting = ~averaged.solution.inliers & _differ(graph, T_root_node, SAME_POSITION, SAME_ANGLE)
    distance, _ = _compare_edges(graph, T_root_node)
    for cut in sorted(averaged.cuts, key=lambda cut: -int(cut.part.sum())):
        stronger = np.flatnonzero(conflicting & cut.across & (evidence > evidence[cut.tree_edge]))
        if not len(stronger):
            continue
        best = stronger[np.argmax(evidence[stronger])]
        T = move_part(graph, T_root_node, cut.part, int(best))
        against, supporting = (" and ".join(names[int(k)] for k in graph.edges[e]) for e in (best, cut.tree_edge))
        reason = f"{against} put it {distance[best]:.1f} m elsewhere, with better evidence than {supporting} have"
        weaker = cut.across & _differ(graph, T, SAME_POSITION, SAME_ANGLE) & (evidence < evidence[best])
        weaker[cut.tree_edge] = True  # also where it differs from the moved poses by less than the limits
        return ConflictingEvidence(cut.part, T, weaker, reason)
    return None


def move_part(graph: PoseGraph, T_root_node: Array, part: Flags, edge: int) -> Array:
    """The poses (N, 3, 3) with a part moved as a whole to where an edge puts it."""
    i, j = graph.edges[edge]
    T_i_j = graph.T_i_j[edge]
    fixed, inside, T_fixed_inside = (i, j, T_i_j) if part[j] else (j, i, se2.inverse(T_i_j))
    moved = T_root_node.copy()
    moved[part] = T_root_node[fixed] @ T_fixed_inside @ se2.inverse(T_root_node[inside]) @ T_root_node[part]
    return moved


@dataclass(frozen=True)
class AmbiguousPart:
    """Scanners that may as well be elsewhere."""

    nodes: tuple[int, ...]
    """Without the root."""
    pair: tuple[int, int]
    """The pair that may be matched in another way."""
    distance: float
    """From the position of the second of that pair, relative to the first, to the other one, m."""
    rotation: float
    """From its angle to the other one, rad."""


# Ratio of the evidence of another place of a part of the network to that of its place, above which it is
# ambiguous: 0.4 at most in 343 pairs of offices, labs and halls without couples, and above 0.7 in 10 of 11 wrong
# pairs of halls with a couple and no other people.
_MAX_AMBIGUITY = 0.7


def find_ambiguous_parts(averaged: AveragedGraph) -> list[AmbiguousPart]:
    """Finds the parts of a network for which another pose has nearly as much evidence as the estimated one.

    The evidence of the edges across a cut that agree with the poses is compared with that of the edges that agree
    with the poses where the part is moved to the place that an outlier across the cut implies.
    """
    graph, evidence, T_root_node = averaged.graph, averaged.evidence, averaged.solution.T_root_node
    differing = _differ(graph, T_root_node, MIN_COUPLE_SHIFT, SAME_TURN)
    distance, rotation = _compare_edges(graph, T_root_node)
    found = []
    for cut in averaged.cuts:
        chosen = float(evidence[cut.across & averaged.solution.inliers].sum())
        others = np.flatnonzero(cut.across & differing)
        edges_across, evidence_across = graph.select_edges(cut.across), evidence[cut.across]
        for edge in others[np.argsort(-evidence[others], kind="stable")].tolist():
            T = move_part(graph, T_root_node, cut.part, edge)
            agreeing = ~_differ(edges_across, T, MIN_COUPLE_SHIFT, SAME_TURN)
            if float(evidence_across[agreeing].sum()) <= _MAX_AMBIGUITY * chosen:
                continue
            nodes, pair = np.flatnonzero(cut.part).tolist(), graph.edges[edge].tolist()
            found.append(AmbiguousPart(tuple(nodes), tuple(pair), distance[edge], rotation[edge]))
            break
    return found


def _differ(graph: PoseGraph, T_root_node: Array, max_distance: float, max_rotation: float) -> Flags:
    """(E,) which edges differ from poses by more than a distance, m, or an angle, rad."""
    distance, rotation = _compare_edges(graph, T_root_node)
    return np.asarray((distance > max_distance) | (rotation > max_rotation))


def _compare_edges(graph: PoseGraph, T_root_node: Array) -> tuple[Array, Array]:
    """(E,) distances, m, and (E,) angles, rad, of edges from poses."""
    i, j = graph.edges.T
    error = se2.difference(se2.inverse(T_root_node[i]) @ T_root_node[j], graph.T_i_j)
    return np.linalg.norm(error[:, :2], axis=1), np.abs(error[:, 2])
