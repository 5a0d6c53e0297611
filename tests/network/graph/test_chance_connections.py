"""Scanners that only matches by chance connect to the root of a large network."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.errors import Rejected
from calgraph.geometry import se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.graph.cuts import AveragedGraph, find_chance_connections
from calgraph.network.graph.network_initialization import NetworkInitialization, initialize_network
from calgraph.network.pairs.hypothesis_evidence import PoseHypothesis
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate
from calgraph.network.pairs.visibility_map import ScannerObservations
from calgraph.network.tracking.track import ScannerTracks

ONE_METRE = se2.pose(0.0, np.array([1.0, 0.0]))


@pytest.fixture(autouse=True)
def count_chances_of_many_scanners(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if four scanners were many: a weight of evidence of 126 is needed."""
    monkeypatch.setattr("calgraph.network.pairs.hypothesis_evidence._RATE", 1.0)


def found(ends: list[tuple[int, int]], by_chance: list[int], outliers: tuple[int, ...] = ()) -> list[int]:
    """The edges by chance between parts, of a graph of five scanners."""
    count = len(ends)
    graph = PoseGraph(5, np.array(ends), np.tile(np.eye(3), (count, 1, 1)), np.tile(np.eye(3), (count, 1, 1)))
    inliers = ~np.isin(np.arange(count), outliers)
    solution = PoseGraphSolution(np.tile(np.eye(3), (5, 1, 1)), inliers)
    chance: NDArray[np.bool_] = np.isin(np.arange(count), by_chance)
    return np.flatnonzero(find_chance_connections(AveragedGraph(graph, solution, np.ones(count)), chance)).tolist()


ROW = [(0, 1), (1, 2), (2, 3), (3, 4)]


def test_a_part_that_one_match_by_chance_connects_is_found() -> None:
    assert found(ROW, by_chance=[1]) == [1]


def test_several_matches_by_chance_that_agree_do_not_connect_a_scanner() -> None:
    assert found([*ROW, (2, 4)], by_chance=[3, 4]) == [3, 4]


def test_matches_by_chance_beside_others_are_kept() -> None:
    assert found([*ROW, (2, 4)], by_chance=[4]) == []


def test_an_outlier_does_not_connect() -> None:
    assert found([*ROW, (2, 4)], by_chance=[4], outliers=(3,)) == [4]


def initialized(observations: int, clock_stddev: float = np.inf, walls: bool = False) -> NetworkInitialization:
    """Of a row of four scanners, whose last pair alone matches little."""
    h = PoseHypothesis(ONE_METRE, 1e4 * np.eye(3), 200, 1.0, 1.0, 0.1, 0.01, uses_background=False)
    last = replace(h, observations=observations, clock_stddev=clock_stddev, uses_background=walls)
    pairs = {(a, b): ScannerPairEstimate(a, b, (last if b == "d" else h,)) for a, b in ("ab", "bc", "cd")}
    nothing = ScannerObservations.from_tracks(ScannerTracks((), np.zeros((0, 2)), 0.01))
    return initialize_network("a", pairs, dict.fromkeys("abcd", nothing), np.random.default_rng(0))


def test_a_scanner_that_matches_by_chance_is_left_out_with_the_reason() -> None:
    """30 positions have a weight of evidence of 71."""
    found = initialized(observations=30)
    assert found.names == ("a", "b", "c")
    why = found.pairs["c", "d"]
    assert isinstance(why, Rejected)
    assert "only where people walk straight at one speed" in why.reason
    assert "among 4 scanners" in why.reason


@pytest.mark.parametrize(
    "connected",
    [initialized(observations=60), initialized(30, clock_stddev=0.02), initialized(30, walls=True)],
    ids=["evidence", "clock", "walls"],
)
def test_evidence_or_turns_or_walls_connect_a_scanner(connected: NetworkInitialization) -> None:
    assert connected.names == ("a", "b", "c", "d")
