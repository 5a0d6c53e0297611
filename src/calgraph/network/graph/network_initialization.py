"""Start poses of the scanners of a network, without scanners whose pose is contradicted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.graph.pose_graph import PoseAveraging, PoseGraph, PoseGraphSolution
from calgraph.network.graph.clock_mounting_consensus import average_clocks
from calgraph.network.graph.cuts import (
    AmbiguousPart,
    AveragedGraph,
    find_ambiguous_parts,
    find_chance_connections,
    find_conflicting_evidence,
    find_visibility_conflict,
    is_confirmed_by_visibility,
)
from calgraph.network.graph.network_graph import (
    average_network,
    build_network_graph,
    edge_evidence,
    edge_weights,
    list_hypotheses,
    published_weights,
)
from calgraph.network.pairs.clock_mounting_search import describe_difference
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate, ScannerPairs
from calgraph.network.pairs.visibility_map import ScannerObservations


@dataclass(frozen=True, eq=False)
class NetworkInitialization:
    """Start poses of those scanners of a network whose poses nothing contradicts."""

    pairs: ScannerPairs
    """The given pairs without hypotheses that the network contradicts; rejected where none is left."""
    graph: PoseGraph
    """Of the remaining hypotheses, with their model error as estimated."""
    names: tuple[str, ...]
    """Scanner of each node, the root first."""
    solution: PoseGraphSolution
    ambiguous: tuple[AmbiguousPart, ...] = ()
    """Parts that other hypotheses put elsewhere with nearly as much evidence."""

    def average_clocks(self) -> Array:
        """(N, 2) clock offsets of the scanners from the root and their standard deviations, s; NaN for the root.

        They are averages of those with which the pairs that agree with the poses were registered.
        """
        inlier, connected = iter(self.solution.inliers), set(self.names)
        of_nodes = (
            pair
            for pair in self.pairs.values()
            if isinstance(pair, ScannerPairEstimate) and pair.sensor_a in connected
        )
        agreeing = ((pair, tuple(h for h in pair.hypotheses if next(inlier))) for pair in of_nodes)
        differences = [describe_difference(replace(pair, hypotheses=kept)) for pair, kept in agreeing if kept]
        return average_clocks(self.names, differences)


def initialize_network(
    root: str,
    pairs: ScannerPairs,
    observations: Mapping[str, ScannerObservations],
    rng: np.random.Generator,
    *,
    averaging: PoseAveraging | None = None,
    weighted: bool = True,
) -> NetworkInitialization:
    """Averages a network's pairs, and removes hypotheses and scanners until no contradiction is left.

    Matches that may be by chance do not connect a scanner alone (:func:`find_chance_connections`).
    Hypotheses under which scanners miss people in their open view are removed (:func:`find_visibility_conflict`).
    Where better evidence contradicts the pose of a part of the network (:func:`find_conflicting_evidence`), the
    weaker edges are removed if detections confirm the moved poses; the part is left out otherwise.

    Args:
        root: name of the root.
        pairs: with all their hypotheses.
        observations: by scanner.
        rng: source of the random trees of the consensus.
        averaging: in place of the consensus.
        weighted: whether pairs are weighted by their evidence; uniformly otherwise.
    """
    while True:
        estimates = [pair for pair in pairs.values() if isinstance(pair, ScannerPairEstimate)]
        graph, names = build_network_graph(root, estimates)
        evidence = edge_evidence(names, estimates)
        weights = None
        if weighted:
            weights = published_weights(names, estimates) if averaging else edge_weights(evidence)
        solution, graph = average_network(graph, rng, weights, averaging)
        averaged = AveragedGraph(graph, solution, evidence)
        by_chance = [h.may_be_by_chance(len(observations)) for h in list_hypotheses(names, estimates)]
        unsure = find_chance_connections(averaged, np.array(by_chance, dtype=np.bool_))
        if unsure.any():
            why = (
                "the tracks match, but only where people walk straight at one speed, as different people do by "
                f"chance among {len(observations)} scanners"
            )
            pairs = _reject_edges(pairs, names, unsure, Rejected(why))
            continue
        # A root without any connection may have no observations.
        of_nodes = [observations[name] for name in names if name in observations]
        missed = find_visibility_conflict(averaged, of_nodes)
        if missed:
            why = f"under its pose, scanners miss {missed.missed_share:.0%} of the people in their open view"
            pairs = _reject_edges(pairs, names, missed.edges, Rejected(why))
            continue
        conflict = find_conflicting_evidence(averaged, names)
        if not conflict:
            return NetworkInitialization(pairs, graph, names, solution, tuple(find_ambiguous_parts(averaged)))
        if is_confirmed_by_visibility(of_nodes, conflict.T_root_node, conflict.part):
            pairs = _reject_edges(pairs, names, conflict.weaker_edges, Rejected("contradicts better evidence"))
        else:
            part = {names[k] for k in np.flatnonzero(conflict.part)}
            reason = Rejected(conflict.reason)
            pairs = {ends: reason if part & set(ends) else found for ends, found in pairs.items()}


def _reject_edges(
    pairs: ScannerPairs, names: Sequence[str], edges: NDArray[np.bool_], reason: Rejected
) -> ScannerPairs:
    """The pairs without the hypotheses of some edges (E,), in the order of :func:`build_network_graph`."""
    rejected, connected = iter(edges), set(names)
    kept_pairs: dict[tuple[str, str], ScannerPairEstimate | Rejected] = {}
    for ends, found in pairs.items():
        kept_pairs[ends] = found
        if isinstance(found, ScannerPairEstimate) and found.sensor_a in connected:
            kept = tuple(h for h in found.hypotheses if not next(rejected))
            kept_pairs[ends] = replace(found, hypotheses=kept) if kept else reason
    return kept_pairs
