"""Where the scanners of a network are, as far as their places are not in doubt."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.errors import Rejected
from calgraph.graph.averaging import Method
from calgraph.graph.conflicting_evidence import doubtful
from calgraph.graph.network_graph import average_network, evidence, network_graph, trust
from calgraph.graph.pose_graph import Averaged, PoseGraph
from calgraph.graph.visibility_check import confirmed, unnoticed
from calgraph.pairwise import ScannerObservations, ScannerPairEstimate

Pairs = Mapping[tuple[str, str], ScannerPairEstimate | Rejected]


@dataclass(frozen=True, eq=False)
class Placed:
    """Scanners of a network whose places are not in doubt."""

    pairs: Pairs
    """Those that were handed in, without hypotheses that the network refutes, and without scanners in doubt."""
    graph: PoseGraph
    """Of what is left, with errors as they are."""
    names: tuple[str, ...]
    """The scanners of its nodes, the root first."""
    averaged: Averaged


def placed(
    root: str,
    pairs: Pairs,
    sights: Mapping[str, ScannerObservations],
    rng: np.random.Generator,
    method: Method = "consensus",
    *,
    weighted: bool = True,
) -> Placed:
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
        graph, names = network_graph(root, known)
        weights = trust(names, known) if weighted else None
        averaged, graph = average_network(graph, rng, method, weights)
        # A root that nothing is connected to may have seen nothing at all.
        seen = [sights[name] for name in names if name in sights]
        wrong = unnoticed(graph, seen, averaged, evidence(names, known))
        if wrong:
            why = f"under its pose {wrong.missed:.0%} of the people in open view of other scanners pass unnoticed"
            pairs = _without(pairs, names, wrong.edges, Rejected(why))
            continue
        doubt = doubtful(graph, names, known, averaged)
        if not doubt:
            return Placed(pairs, graph, names, averaged)
        if confirmed(seen, doubt.T_root_node, doubt.part):
            pairs = _without(pairs, names, doubt.weaker, Rejected("contradicts better evidence"))
        else:
            pairs = _left_out(pairs, {names[k] for k in np.flatnonzero(doubt.part)}, Rejected(doubt.said))


def _left_out(pairs: Pairs, scanners: Set[str], why: Rejected) -> Pairs:
    return {ends: why if scanners & set(ends) else found for ends, found in pairs.items()}


def _without(pairs: Pairs, names: Sequence[str], dropped: NDArray[np.bool_], why: Rejected) -> Pairs:
    """The pairs without the hypotheses (E,) that are dropped, in the order of :func:`network_graph`."""
    edges = iter(dropped)
    left: dict[tuple[str, str], ScannerPairEstimate | Rejected] = {}
    for ends, found in pairs.items():
        left[ends] = found
        if isinstance(found, ScannerPairEstimate) and found.sensor_a in names:
            kept = tuple(h for h in found.hypotheses if not next(edges))
            left[ends] = replace(found, hypotheses=kept) if kept else why
    return left
