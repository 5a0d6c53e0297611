"""Where the scanners of a network are, as far as their places are not in doubt."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import Rejected
from calgraph.graph.averaging import AveragingMethod
from calgraph.graph.conflicting_evidence import find_conflicting_evidence
from calgraph.graph.network_graph import average_network, build_network_graph, edge_evidence, edge_weights
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.graph.visibility_check import find_visibility_conflict, is_confirmed_by_visibility
from calgraph.pairwise import ScannerObservations, ScannerPairEstimate

Pairs = Mapping[tuple[str, str], ScannerPairEstimate | Rejected]


@dataclass(frozen=True, eq=False)
class NetworkInitialization:
    """Scanners of a network whose places are not in doubt."""

    pairs: Pairs
    """Those that were handed in, without hypotheses that the network refutes, and without scanners in doubt."""
    graph: PoseGraph
    """Of what is left, with errors as they are."""
    names: tuple[str, ...]
    """The scanners of its nodes, the root first."""
    solution: PoseGraphSolution


def initialize_network(
    root: str,
    pairs: Pairs,
    sights: Mapping[str, ScannerObservations],
    rng: np.random.Generator,
    method: AveragingMethod = "consensus",
    *,
    weighted: bool = True,
) -> NetworkInitialization:
    """Averages a network's pairs, until nothing speaks against any scanner's place.

    Hypotheses are dropped under which people would have passed unnoticed (:func:`unnoticed`). Scanners that better
    evidence would put elsewhere (:func:`doubtful`) are put there if what others saw there confirms it; they are
    left out otherwise.

    Args:
        root: name of the root.
        pairs: with all their hypotheses.
        sights: by scanner.
        rng: used by ``consensus``.
        method: as for :func:`average`.
        weighted: whether pairs count by their evidence; all alike otherwise.
    """
    while True:
        known = [pair for pair in pairs.values() if isinstance(pair, ScannerPairEstimate)]
        graph, names = build_network_graph(root, known)
        weights = edge_weights(names, known) if weighted else None
        averaged, graph = average_network(graph, rng, method, weights)
        # A root that nothing is connected to may have seen nothing at all.
        seen = [sights[name] for name in names if name in sights]
        wrong = find_visibility_conflict(graph, seen, averaged, edge_evidence(names, known))
        if wrong:
            why = f"under its pose, scanners miss {wrong.missed_share:.0%} of the people in their open view"
            pairs = _reject_edges(pairs, names, wrong.edges, Rejected(why))
            continue
        doubt = find_conflicting_evidence(graph, names, known, averaged)
        if not doubt:
            return NetworkInitialization(pairs, graph, names, averaged)
        if is_confirmed_by_visibility(seen, doubt.T_root_node, doubt.part):
            pairs = _reject_edges(pairs, names, doubt.weaker_edges, Rejected("contradicts better evidence"))
        else:
            pairs = _reject_scanners(pairs, {names[k] for k in np.flatnonzero(doubt.part)}, Rejected(doubt.reason))


def _reject_scanners(pairs: Pairs, scanners: Set[str], why: Rejected) -> Pairs:
    return {ends: why if scanners & set(ends) else found for ends, found in pairs.items()}


def _reject_edges(pairs: Pairs, names: Sequence[str], dropped: NDArray[np.bool_], why: Rejected) -> Pairs:
    """The pairs without the hypotheses (E,) that are dropped, in the order of :func:`network_graph`."""
    edges = iter(dropped)
    left: dict[tuple[str, str], ScannerPairEstimate | Rejected] = {}
    for ends, found in pairs.items():
        left[ends] = found
        if isinstance(found, ScannerPairEstimate) and found.sensor_a in names:
            kept = tuple(h for h in found.hypotheses if not next(edges))
            left[ends] = replace(found, hypotheses=kept) if kept else why
    return left
