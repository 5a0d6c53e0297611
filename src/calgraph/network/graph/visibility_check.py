"""Contradictions between the poses of a whole network and what its scanners detect of each other's people.

The same test of a single pair rejects most wrong hypotheses, but not all: the two scanners may share a few seconds
only, in which people move similarly. A part of a network at a wrong pose is among many scanners, whose
detections it should share.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.graph.spanning_tree import fundamental_cuts
from calgraph.network.pairs.candidate_pairs import label_parts
from calgraph.network.pairs.scanner_pair import DETECTION_RADIUS, MAX_MISSED_SHARE
from calgraph.network.pairs.synchronized_tracks import pair_samples
from calgraph.network.pairs.visibility_map import ScannerObservations, find_missed_detections

Flags = NDArray[np.bool_]


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
    graph: PoseGraph, observations: Sequence[ScannerObservations], solution: PoseGraphSolution, evidence: Array
) -> VisibilityConflict | None:
    """The part of a network that misses too many detections and is connected by least evidence; None without one.

    The parts are those beyond the edges of the maximum spanning tree by evidence. What one side detects within the
    open view of the other, some scanner of the other side should detect, too. A wrong edge contradicts the cuts of
    correct ones, too, where these have the scanners that it misplaces on one side: the weakest is rejected first.

    Args:
        graph: of the network.
        observations: of its scanners, node by node.
        solution: the estimated poses and their inliers.
        evidence: (E,) of each edge.
    """
    detections = _compare_detections(observations, solution.T_root_node)
    i, j = graph.edges.T
    conflicts: list[tuple[float, VisibilityConflict]] = []
    for _, part in fundamental_cuts(graph, np.where(solution.inliers, evidence, 0.0)):
        expected, missed = detections.count_across(part)
        if expected >= _MIN_EXPECTED_OF_PART and missed > MAX_MISSED_SHARE * expected:
            edges = solution.inliers & (part[i] != part[j])
            conflicts.append((float(evidence[edges].sum()), VisibilityConflict(part, edges, missed / expected)))
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


def find_chance_connections(graph: PoseGraph, solution: PoseGraphSolution, by_chance: Flags) -> Flags:
    """Finds the edges by chance between parts of a network that no other inlier connects.

    Args:
        graph: of the network.
        solution: the estimated poses and their inliers.
        by_chance: (E,) edges whose matches may be by chance.

    Returns:
        (E,) mask.
    """
    connecting = graph.edges[solution.inliers & ~by_chance]
    part = label_parts(graph.count, {(int(a), int(b)) for a, b in connecting})
    i, j = graph.edges.T
    return np.asarray(by_chance & (part[i] != part[j]))
