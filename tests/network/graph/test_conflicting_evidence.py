"""Parts of a network that better evidence would put elsewhere."""

from dataclasses import replace

import numpy as np

from calgraph.geometry import Array, se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.graph.cuts import AveragedGraph, ConflictingEvidence, find_conflicting_evidence
from calgraph.network.graph.network_graph import build_network_graph, edge_evidence
from calgraph.network.pairs.hypothesis_evidence import PoseHypothesis
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate

NAMES = ("a", "b", "c", "d")
T = {name: se2.pose(0.3 * k, np.array([5.0 * k, 1.0])) for k, name in enumerate(NAMES)}
"""T_a_scanner, but for a common shift."""


def found(a: str, b: str, observations: int, shift: float = 0.0, *, icp: bool = False) -> PoseHypothesis:
    """A hypothesis that is right, or off by a shift, m."""
    T_a_b = se2.retract(se2.inverse(T[a]) @ T[b], np.array([shift, 0.0, 0.0]))
    return PoseHypothesis(T_a_b, 1e4 * np.eye(3), observations, 1.0, 1.0, 0.1, 0.01, icp)


def doubts(*pairs: ScannerPairEstimate) -> dict[str, str]:
    """Why which scanners are in doubt if all hypotheses that are right agree with the poses found."""
    _, names, doubt = doubted(*pairs)
    return {names[k]: doubt.reason for k in np.flatnonzero(doubt.part)} if doubt else {}


def doubted(*pairs: ScannerPairEstimate) -> tuple[PoseGraph, tuple[str, ...], ConflictingEvidence | None]:
    """The graph of some pairs, its nodes, and what is in doubt."""
    graph, names = build_network_graph("a", pairs)
    poses: Array = np.array([se2.inverse(T["a"]) @ T[name] for name in names])
    i, j = graph.edges.T
    off = se2.difference(se2.inverse(poses[i]) @ poses[j], graph.T_i_j)
    solution = PoseGraphSolution(poses, np.hypot(off[:, 0], off[:, 1]) < 0.1)
    averaged = AveragedGraph(graph, solution, edge_evidence(names, pairs))
    return graph, names, find_conflicting_evidence(averaged, names)


AB = ScannerPairEstimate("a", "b", (found("a", "b", 200),))
BC = ScannerPairEstimate("b", "c", (found("b", "c", 200),))
CD = ScannerPairEstimate("c", "d", (found("c", "d", 30),))


def test_nothing_is_in_doubt_where_all_agrees() -> None:
    assert doubts(AB, BC, CD) == {}


def test_a_scanner_is_in_doubt_if_better_evidence_puts_it_elsewhere() -> None:
    said = doubts(AB, BC, CD, ScannerPairEstimate("b", "d", (found("b", "d", 40, 8.0),)))
    assert list(said) == ["d"]
    assert said["d"] == "b and d put it 8.0 m elsewhere, with better evidence than c and d have"


def test_so_is_all_that_hangs_from_it() -> None:
    weak = replace(BC, hypotheses=(found("b", "c", 30),))
    strong = replace(CD, hypotheses=(found("c", "d", 200),))
    assert set(doubts(AB, weak, strong, ScannerPairEstimate("a", "d", (found("a", "d", 40, 8.0),)))) == {"c", "d"}


def test_so_it_is_by_another_hypothesis_of_one_pair() -> None:
    assert list(doubts(AB, BC, replace(CD, hypotheses=(found("c", "d", 40, 8.0), found("c", "d", 30))))) == ["d"]


def test_weaker_evidence_casts_no_doubt() -> None:
    assert doubts(AB, BC, CD, ScannerPairEstimate("b", "d", (found("b", "d", 25, 8.0),))) == {}


def test_nor_does_what_is_wrong_between_scanners_that_are_sure() -> None:
    cycle = ScannerPairEstimate("a", "c", (found("a", "c", 150, 8.0),))
    assert doubts(AB, BC, CD, cycle) == {}


def test_nor_what_puts_it_nearly_there() -> None:
    assert doubts(AB, BC, CD, ScannerPairEstimate("b", "d", (found("b", "d", 40, 0.3),))) == {}


def test_walls_that_match_outweigh_some_seconds() -> None:
    walls = replace(CD, hypotheses=(found("c", "d", 30, icp=True),))
    assert doubts(AB, BC, walls, ScannerPairEstimate("b", "d", (found("b", "d", 60, 8.0),))) == {}


def test_a_root_alone_is_not_in_doubt() -> None:
    assert doubts() == {}


def test_what_contradicts_better_evidence_is_told_from_what_agrees_with_it() -> None:
    rival = ScannerPairEstimate("b", "d", (found("b", "d", 60, 8.0),))
    agrees = ScannerPairEstimate("a", "d", (found("a", "d", 40, 0.0),))
    graph, names, doubt = doubted(AB, BC, CD, rival, agrees)
    assert doubt
    weaker = {tuple(names[k] for k in edge) for edge in graph.edges[doubt.weaker_edges].tolist()}
    assert weaker == {("c", "d"), ("a", "d")}
    moved = se2.inverse(doubt.T_root_node[names.index("b")]) @ doubt.T_root_node[names.index("d")]
    np.testing.assert_allclose(moved, rival.T_a_b, atol=1e-12)


def test_what_holds_a_scanner_goes_even_if_better_evidence_hardly_contradicts_it() -> None:
    near = ScannerPairEstimate("b", "d", (found("b", "d", 40, 0.55),))
    graph, names, doubt = doubted(AB, BC, replace(CD, hypotheses=(found("c", "d", 30, 0.09),)), near)
    assert doubt
    assert [tuple(names[k] for k in edge) for edge in graph.edges[doubt.weaker_edges].tolist()] == [("c", "d")]


def test_edges_with_more_evidence_than_the_conflict_are_kept() -> None:
    """An outlier 0.3 m off does not contradict the estimated pose, but the moved one."""
    better = ScannerPairEstimate("b", "d", (found("b", "d", 40, 8.0),))
    near = ScannerPairEstimate("a", "d", (found("a", "d", 60, 0.3),))
    graph, names, conflict = doubted(AB, BC, CD, better, near)
    assert conflict
    assert [tuple(names[k] for k in edge) for edge in graph.edges[conflict.weaker_edges].tolist()] == [("c", "d")]


def test_the_largest_of_several_parts_is_in_conflict() -> None:
    weak = replace(BC, hypotheses=(found("b", "c", 30),))
    to_c, to_d = (ScannerPairEstimate(a, b, (found(a, b, 40, 8.0),)) for a, b in (("a", "c"), ("b", "d")))
    assert set(doubts(AB, weak, CD, to_c, to_d)) == {"c", "d"}


def test_the_conflict_of_most_evidence_moves_the_part() -> None:
    near, far = (
        ScannerPairEstimate(a, "d", (found(a, "d", count, shift),))
        for a, count, shift in (("b", 40, 8.0), ("a", 60, 5.0))
    )
    reason = doubts(AB, BC, CD, near, far)["d"]
    assert reason == "a and d put it 5.0 m elsewhere, with better evidence than c and d have"


def test_better_evidence_for_another_angle_is_a_conflict() -> None:
    """Off by 0.15 m, which is no contradiction, and by 17 degrees, which is one."""
    right = found("b", "d", 40)
    turned = replace(right, T_a_b=se2.retract(right.T_a_b, np.array([0.15, 0.0, 0.3])))
    assert list(doubts(AB, BC, CD, ScannerPairEstimate("b", "d", (turned,)))) == ["d"]
