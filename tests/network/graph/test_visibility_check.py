"""Places in a network that are refuted by people who would have passed unnoticed, and what is done about them."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.errors import Rejected
from calgraph.geometry import Array, se2
from calgraph.graph.pose_graph import PoseGraphSolution
from calgraph.network.graph import cuts
from calgraph.network.graph.cuts import (
    AveragedGraph,
    VisibilityConflict,
    _compare_detections,
    find_visibility_conflict,
)
from calgraph.network.graph.network_graph import build_network_graph
from calgraph.network.graph.network_initialization import NetworkInitialization, initialize_network
from calgraph.network.pairs.hypothesis_evidence import PoseHypothesis
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate
from calgraph.network.pairs.visibility_map import ScannerObservations
from calgraph.network.tracking.track import ScannerTracks, Track

NAMES = ("a", "b", "c", "d")
T = {name: se2.pose(0.4 * k, np.array([3.0 * k, -2.0 * (k % 2)])) for k, name in enumerate(NAMES)}
"""T_a_scanner; d is last in a row."""
ELSEWHERE = se2.pose(2.0, np.array([1.0, 5.0]))
"""A wrong T_a_d among the other scanners."""


def sights(seconds: float = 20.0) -> dict[str, ScannerObservations]:
    """Of scanners in one hall that all saw one walk, until d's recording ended."""
    return {
        name: ScannerObservations.from_tracks(followed(name, seconds if name == "d" else 20.0)) for name in NAMES
    }


def followed(name: str, seconds: float) -> ScannerTracks:
    """What a scanner followed of a walk to and fro through the hall."""
    times = np.arange(0.0, seconds, 0.1)
    places = np.column_stack([4 + 3 * np.sin(0.3 * times), 2 * np.sin(0.7 * times + 0.5)])
    x = se2.apply(se2.inverse(T[name]), places)
    track = Track(times, x, np.gradient(x, 0.1, axis=0), np.tile(0.02**2 * np.eye(2), (len(x), 1, 1)), period=0)
    angle = np.linspace(-np.pi, np.pi, 720)
    return ScannerTracks((track,), 20 * np.column_stack([np.cos(angle), np.sin(angle)]), 0.01)


def hypothesis(T_a_b: Array, observations: int) -> PoseHypothesis:
    return PoseHypothesis(T_a_b, 1e4 * np.eye(3), observations, 1.0, 1.0, 0.1, 0.01, uses_background=False)


def right(a: str, b: str, observations: int = 200) -> PoseHypothesis:
    return hypothesis(se2.inverse(T[a]) @ T[b], observations)


ROW = {
    ("a", "b"): ScannerPairEstimate("a", "b", (right("a", "b"),)),
    ("b", "c"): ScannerPairEstimate("b", "c", (right("b", "c"),)),
}


def judged(T_a_d: Array, seen: dict[str, ScannerObservations]) -> VisibilityConflict | None:
    """What is refuted with d somewhere."""
    pairs = [*ROW.values(), ScannerPairEstimate("a", "d", (hypothesis(T_a_d, 200),))]
    graph, names = build_network_graph("a", pairs)
    poses = np.array([T_a_d if name == "d" else T[name] for name in names])
    averaged = PoseGraphSolution(poses, np.ones(3, dtype=np.bool_))
    return find_visibility_conflict(
        AveragedGraph(graph, averaged, np.full(3, 200.0)), [seen[name] for name in names]
    )


def test_nothing_is_refuted_where_all_are_in_their_places() -> None:
    assert judged(T["d"], sights()) is None


def test_a_scanner_among_others_who_saw_nobody_where_it_did_is_refuted() -> None:
    found = judged(ELSEWHERE, sights())
    assert found
    assert found.part.tolist() == [False, False, True, False]  # d is the third of the graph
    assert found.edges.tolist() == [False, False, True]
    assert found.missed_share > 0.8


def test_it_is_not_if_it_saw_hardly_anything() -> None:
    assert judged(ELSEWHERE, sights(0.8)) is None


def test_of_several_cuts_the_weakest_is_refuted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a stronger one misses more: a wrong edge misplaces whole parts, relative to the others."""

    class Detections:
        def count_across(self, part: NDArray[np.bool_]) -> tuple[int, int]:
            return 100, 70 if part.tolist() == [False, False, False, True] else 90

    monkeypatch.setattr(cuts, "_compare_detections", lambda *_: Detections())
    chain = [ScannerPairEstimate(a, b, (right(a, b),)) for a, b in pairwise(NAMES)]
    graph, names = build_network_graph("a", chain)
    solution = PoseGraphSolution(np.array([T[name] for name in names]), np.ones(3, dtype=np.bool_))
    found = find_visibility_conflict(AveragedGraph(graph, solution, np.array([300.0, 200.0, 100.0])), [])
    assert found
    assert found.edges.tolist() == [False, False, True]
    assert found.missed_share == 0.7


def test_a_refuted_hypothesis_gives_way_to_another_one(rng: np.random.Generator) -> None:
    rivals = ScannerPairEstimate("a", "d", (hypothesis(ELSEWHERE, 200), right("a", "d", 40)))
    sure = initialize_network("a", ROW | {("a", "d"): rivals}, sights(), rng)
    found = dict(zip(sure.names, sure.solution.T_root_node, strict=True))
    np.testing.assert_allclose(found["d"], T["d"], atol=1e-6)
    left = sure.pairs["a", "d"]
    assert isinstance(left, ScannerPairEstimate)
    assert [h.observations for h in left.hypotheses] == [40]


def test_a_scanner_whose_only_place_is_refuted_is_left_out_and_told_why(rng: np.random.Generator) -> None:
    sure = initialize_network(
        "a", ROW | {("a", "d"): ScannerPairEstimate("a", "d", (hypothesis(ELSEWHERE, 200),))}, sights(), rng
    )
    assert sure.names == ("a", "b", "c")
    why = sure.pairs["a", "d"]
    assert isinstance(why, Rejected)
    assert "of the people in their open view" in why.reason


MIDDLE = se2.pose(0.0, np.array([4.0, 0.0]))
TURNED = MIDDLE @ se2.pose(np.radians(9), np.zeros(2)) @ se2.inverse(MIDDLE) @ T["d"]
"""A wrong T_a_d under which d saw others about where they were: turned about the middle of the walk."""


def outvoted(
    weak: Array, better: Array, seen: dict[str, ScannerObservations], rng: np.random.Generator
) -> NetworkInitialization:
    """Two weak pairs agree on ``T_a_d``; a single one with better evidence contradicts."""
    two = {(a, "d"): ScannerPairEstimate(a, "d", (hypothesis(se2.inverse(T[a]) @ weak, 30),)) for a in ("a", "c")}
    rival = ScannerPairEstimate("b", "d", (hypothesis(se2.inverse(T["b"]) @ better, 40),))
    return initialize_network("a", {**ROW, **two, ("b", "d"): rival}, seen, rng)


def test_a_scanner_is_put_where_better_evidence_has_it_if_others_saw_the_same_there(
    rng: np.random.Generator,
) -> None:
    sure = outvoted(TURNED, T["d"], sights(), rng)
    found = dict(zip(sure.names, sure.solution.T_root_node, strict=True))
    np.testing.assert_allclose(found["d"], T["d"], atol=1e-6)
    assert sure.pairs["a", "d"] == sure.pairs["c", "d"] == Rejected("contradicts better evidence")


def test_it_is_left_out_if_they_did_not(rng: np.random.Generator) -> None:
    sure = outvoted(T["d"], ELSEWHERE, sights(), rng)
    assert sure.names == ("a", "b", "c")
    assert {type(sure.pairs[a, "d"]) for a in ("a", "b", "c")} == {Rejected}


def test_so_it_is_if_too_little_was_seen(rng: np.random.Generator) -> None:
    assert outvoted(TURNED, T["d"], sights(0.8), rng).names == ("a", "b", "c")


def test_the_missed_share_is_that_of_the_expected_detections() -> None:
    found = judged(ELSEWHERE, sights())
    assert found
    poses = np.array([ELSEWHERE if name == "d" else T[name] for name in ("a", "b", "d", "c")])
    expected, missed = _compare_detections([sights()[n] for n in ("a", "b", "d", "c")], poses).count_across(
        found.part
    )
    assert found.missed_share == missed / expected


@pytest.mark.parametrize(("seconds", "step"), [(100.0, 1), (300.0, 2)])
def test_long_recordings_are_subsampled(seconds: float, step: int) -> None:
    """Beyond 2000 ticks of 0.1 s to every second one, and so on."""
    observations = [ScannerObservations.from_tracks(followed(name, seconds)) for name in NAMES]
    detections = _compare_detections(observations, np.array([T[name] for name in NAMES]))
    assert detections.step == step
    assert detections.count == sum(len(one.samples.tick[one.samples.tick % step == 0]) for one in observations)
