from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import Array, diagonal_blocks, se2
from calgraph.graph.pose_graph import PoseGraph
from calgraph.network.graph.network_graph import (
    average_network,
    build_network_graph,
    compute_joint_covariance,
    edge_evidence,
    edge_weights,
    published_weights,
)
from calgraph.network.pairs.hypothesis_evidence import PoseHypothesis
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate


def pose_covariances(graph: PoseGraph, T_root_node: Array) -> Array:
    """The (N, 3, 3) blocks on the diagonal of the joint covariance."""
    return diagonal_blocks(compute_joint_covariance(graph, T_root_node), 3)


def hypothesis(x: float, sigma: float = 0.01, observations: int = 100, share: float = 1.0) -> PoseHypothesis:
    T = se2.pose(0.0, np.array([x, 0.0]))
    return PoseHypothesis(
        T,
        np.eye(3) / sigma**2,
        observations,
        chance_observations=0.0,
        matched_share=share,
        cost=0.1,
        model_error=0.01,
        uses_background=False,
    )


def test_alternatives_of_a_pair_are_edges_of_one_pair() -> None:
    pairs = [
        ScannerPairEstimate("a", "b", (hypothesis(1), hypothesis(2))),
        ScannerPairEstimate("b", "c", (hypothesis(1),)),
    ]
    graph, names = build_network_graph("a", pairs)
    assert names == ("a", "b", "c")
    np.testing.assert_array_equal(graph.edges, [[0, 1], [0, 1], [1, 2]])
    assert len(np.unique(graph.pair_of_edge)) == 2


def test_only_what_is_connected_to_the_root_is_in_the_graph() -> None:
    graph, names = build_network_graph("a", [ScannerPairEstimate("b", "c", (hypothesis(1),))])
    assert names == ("a",)
    assert len(graph.edges) == 0


def test_published_weights_grow_with_the_matched_time_and_share() -> None:
    pairs = [
        ScannerPairEstimate(
            "a", "b", (hypothesis(1, observations=50), hypothesis(2, observations=150, share=0.5))
        ),
        ScannerPairEstimate("x", "y", (hypothesis(1),)),
        ScannerPairEstimate("b", "c", (hypothesis(1, observations=450),)),
    ]
    _, names = build_network_graph("a", pairs)
    # Five seconds have half the full weight; what is not connected to the root has no edge.
    np.testing.assert_allclose(published_weights(names, pairs), [0.5, 0.6, 0.9])


def test_walls_count_as_positions_in_published_weights() -> None:
    pairs = [ScannerPairEstimate("a", "b", (replace(hypothesis(1, observations=100), uses_background=True),))]
    np.testing.assert_allclose(published_weights(("a", "b"), pairs), [200 / 250])


def test_evidence_grows_with_matches_and_with_their_accuracy() -> None:
    """A log likelihood ratio for each match, and a constant for walls."""
    precise, coarse = hypothesis(1, observations=20, share=0.5), replace(hypothesis(1), model_error=0.1)
    walls = replace(precise, uses_background=True)
    pairs = [ScannerPairEstimate("a", "b", (precise, walls, coarse))]
    per_match = np.log(0.15 / np.hypot([0.01, 0.1], 0.01))
    expected = [10 * per_match[0], 10 * per_match[0] + 260, 100 * per_match[1]]
    np.testing.assert_allclose(edge_evidence(("a", "b"), pairs), expected)


def test_weights_are_half_at_the_evidence_of_a_perfect_fit_of_five_seconds() -> None:
    np.testing.assert_allclose(edge_weights(np.array([0.0, 130.0, 390.0])), [0.0, 0.5, 0.75])


def chain(sigma_x: float, sigma_theta: float) -> tuple[PoseGraph, np.ndarray]:
    """Three scanners in a row, a metre apart."""
    T = se2.pose(np.zeros(2), np.tile([1.0, 0.0], (2, 1)))
    information = np.tile(np.diag([sigma_x**-2, sigma_x**-2, sigma_theta**-2]), (2, 1, 1))
    poses = se2.pose(np.zeros(3), np.array([[0.0, 0], [1, 0], [2, 0]]))
    return PoseGraph(3, np.array([[0, 1], [1, 2]]), T, information), poses


def test_covariance_adds_up_along_a_chain() -> None:
    graph, poses = chain(0.01, 0.02)
    spread = pose_covariances(graph, poses)
    np.testing.assert_allclose(spread[0], 0)
    np.testing.assert_allclose(np.diag(spread[1]), [0.01**2, 0.01**2, 0.02**2], rtol=1e-6)
    # The first turn moves the last scanner sideways by its arm of one metre.
    np.testing.assert_allclose(np.diag(spread[2]), [2 * 0.01**2, 2 * 0.01**2 + 0.02**2, 2 * 0.02**2], rtol=1e-6)


def test_covariance_agrees_with_composition() -> None:
    graph, poses = chain(0.01, 0.02)
    pair = np.diag([0.01**2, 0.01**2, 0.02**2])
    composed = se2.compose_covariance(poses[1], pair, pair, np.array([1.0, 0.0]))
    np.testing.assert_allclose(pose_covariances(graph, poses)[2], composed, rtol=1e-6)


def complete(error: float, sigma: float, rng: np.random.Generator) -> tuple[PoseGraph, np.ndarray]:
    """Ten scanners that all see each other, pairs off by as much as ``error`` (m) though they claim ``sigma``."""
    T = se2.pose(rng.uniform(-np.pi, np.pi, 10), rng.uniform(-5, 5, (10, 2)))
    T = se2.inverse(T[0]) @ T
    edges = np.column_stack(np.triu_indices(10, 1))
    off = np.array([1, 1, 0.2]) * error * rng.normal(size=(len(edges), 3))
    T_i_j = se2.retract(se2.inverse(T[edges[:, 0]]) @ T[edges[:, 1]], off)
    information = np.tile(np.diag([1, 1, 25]) / sigma**2, (len(edges), 1, 1))
    return PoseGraph(10, edges, T_i_j, information), T


@pytest.mark.parametrize(("error", "sigma"), [(0.02, 0.004), (0.01, 0.01), (0.005, 0.001)])
def test_covariances_grow_with_what_pairs_are_off_beyond_their_own(error: float, sigma: float) -> None:
    values = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        graph, T = complete(error, sigma, rng)
        found, loosened = average_network(graph, rng)
        spread = pose_covariances(loosened.select_edges(found.inliers), found.T_root_node)
        off = se2.difference(found.T_root_node, T)[1:]
        values.append(np.mean([e @ np.linalg.solve(C, e) / 3 for e, C in zip(off, spread[1:], strict=True)]))
    # Errors of all nodes share the root's: the mean over 30 graphs has a standard deviation of about 0.1.
    assert 0.6 < np.mean(values) < 1.4


def test_a_single_pair_is_given_the_usual_error_beyond_its_noise() -> None:
    graph, _ = build_network_graph("a", [ScannerPairEstimate("a", "b", (hypothesis(1, sigma=0.001),))])
    found, loosened = average_network(graph, np.random.default_rng(0))
    sd = np.sqrt(np.diag(pose_covariances(loosened, found.T_root_node)[1]))
    np.testing.assert_allclose(sd, [0.02, 0.02, 0.004], rtol=0.05)


def test_covariances_add_up_along_a_chain_of_turned_scanners() -> None:
    T_a_b, T_b_c = se2.pose(0.7, np.array([3.0, 1.0])), se2.pose(-0.4, np.array([2.0, -1.5]))
    covariance_ab, covariance_bc = np.diag([4e-4, 1e-4, 9e-6]), np.diag([1e-4, 2.5e-3, 1e-6])
    graph = PoseGraph(
        3,
        np.array([[0, 1], [1, 2]]),
        np.array([T_a_b, T_b_c]),
        np.linalg.inv(np.array([covariance_ab, covariance_bc])),
    )
    found = pose_covariances(graph, np.array([np.eye(3), T_a_b, T_a_b @ T_b_c]))
    # An error of the first rotation moves c about b.
    arm = T_a_b[:2, :2] @ T_b_c[:2, 2]
    by_first, by_second = np.eye(3), np.eye(3)
    by_first[:2, 2] = -arm[1], arm[0]
    by_second[:2, :2] = T_a_b[:2, :2]
    expected = by_first @ covariance_ab @ by_first.T + by_second @ covariance_bc @ by_second.T
    np.testing.assert_allclose(found[1], covariance_ab, atol=1e-9)
    np.testing.assert_allclose(found[2], expected, atol=1e-9)
