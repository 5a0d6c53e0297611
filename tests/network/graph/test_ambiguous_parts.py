"""Parts of a network that other hypotheses put elsewhere with nearly as much evidence."""

import numpy as np

from calgraph.geometry import Array, se2
from calgraph.graph.pose_graph import PoseGraphSolution
from calgraph.network.graph.cuts import AmbiguousPart, AveragedGraph, find_ambiguous_parts
from calgraph.network.graph.network_graph import build_network_graph
from calgraph.network.pairs.hypothesis_evidence import PoseHypothesis
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate

NAMES = ("a", "b", "c", "d")
T = {name: se2.pose(0.3 * k, np.array([5.0 * k, 1.0])) for k, name in enumerate(NAMES)}
Edge = tuple[str, float, float]
"""Two scanners, evidence and shift, m."""


def find(*edges: Edge) -> list[AmbiguousPart]:
    """The ambiguous parts where all hypotheses without a shift are inliers."""
    pairs: dict[str, list[PoseHypothesis]] = {}
    for ends, _, shift in edges:
        a, b = tuple(ends)
        T_a_b = se2.retract(se2.inverse(T[a]) @ T[b], np.array([0.0, shift, 0.0]))
        h = PoseHypothesis(T_a_b, 1e4 * np.eye(3), 100, 1.0, 1.0, 0.1, 0.01, uses_background=False)
        pairs.setdefault(ends, []).append(h)
    estimates = [ScannerPairEstimate(ends[0], ends[1], tuple(found)) for ends, found in pairs.items()]
    graph, names = build_network_graph("a", estimates)
    poses: Array = np.array([se2.inverse(T["a"]) @ T[name] for name in names])
    by_pair = sorted(edges, key=lambda edge: list(pairs).index(edge[0]))
    evidence = np.array([edge[1] for edge in by_pair])
    inliers = np.array([edge[2] == 0 for edge in by_pair])
    return find_ambiguous_parts(AveragedGraph(graph, PoseGraphSolution(poses, inliers), evidence))


def test_nothing_is_ambiguous_without_alternatives() -> None:
    assert find(("ab", 100, 0), ("bc", 100, 0)) == []


def test_an_alternative_with_nearly_as_much_evidence_makes_all_beyond_it_ambiguous() -> None:
    (part,) = find(("ab", 100, 0), ("bc", 100, 0), ("bc", 80, 0.5), ("cd", 100, 0))
    assert part.nodes == (2, 3)
    assert part.pair == (1, 2)
    np.testing.assert_allclose([part.distance, part.rotation], [0.5, 0], atol=1e-9)


def test_an_alternative_with_less_evidence_does_not() -> None:
    assert find(("ab", 100, 0), ("bc", 100, 0), ("bc", 60, 0.5)) == []


def test_an_alternative_of_the_same_place_does_not() -> None:
    assert find(("ab", 100, 0), ("ab", 90, 0.15)) == []


def test_a_cycle_decides() -> None:
    assert find(("ab", 100, 0), ("bc", 100, 0), ("ac", 100, 0), ("bc", 95, 0.5)) == []


def test_a_cycle_of_crosswise_matches_does_not_decide() -> None:
    """Both pairs of c have an alternative, and these agree with each other: both shift c by as much."""
    T_b_c = se2.inverse(T["b"]) @ T["c"]
    shift = 0.5
    edges = (("ab", 300.0, 0.0), ("bc", 100.0, 0.0), ("ac", 100.0, 0.0), ("ac", 90.0, shift))
    moved = se2.retract(se2.inverse(T["a"]) @ T["c"], np.array([0.0, shift, 0.0]))
    off = se2.difference(se2.inverse(se2.inverse(T["a"]) @ T["b"]) @ moved, T_b_c)
    assert find(*edges) == []
    # The angle of b is nearly that of a: the shift of c in b is nearly that in a.
    assert np.hypot(*off[:2]) < shift + 0.01
    (part,) = find(*edges, ("bc", 90.0, shift))
    assert part.nodes == (2,)
