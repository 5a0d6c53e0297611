"""Averaging of pose graphs in the plane and in space: exact without noise, robust against outlier edges."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.errors import CalibrationError
from calgraph.geometry import se_n
from calgraph.graph.cycles import find_cycle_basis
from calgraph.graph.pose_graph import PoseGraph
from calgraph.graph.tree_consensus import average_poses
from pose_graphs import ANGLE, POSITION, WHEEL, complete, measured, ring, true_poses, with_wrong

BOTH = pytest.mark.parametrize("n", [2, 3])


@BOTH
@pytest.mark.parametrize("edges", [ring(8), complete(6), WHEEL], ids=["ring", "complete", "wheel"])
def test_consensus_is_exact_without_noise(n: int, edges: list[tuple[int, int]], rng: np.random.Generator) -> None:
    T = true_poses(1 + max(max(e) for e in edges), n, rng)
    found = average_poses(measured(T, edges, rng), rng)
    assert_allclose(found.T_root_node, T, atol=1e-6)


@BOTH
def test_consensus_leaves_out_the_wrong_edges(n: int, rng: np.random.Generator) -> None:
    T = true_poses(8, n, rng)
    wrong = [0, 5, 6, 9, 12, 17, 18, 20, 23, 24, 27]  # 11 of 28; every node keeps four right ones or more
    graph = with_wrong(measured(T, complete(8), rng, noise=1.0), wrong, rng)
    assert np.flatnonzero(~average_poses(graph, rng).inliers).tolist() == wrong


@BOTH
def test_consensus_takes_one_alternative_of_a_pair(n: int, rng: np.random.Generator) -> None:
    T = true_poses(6, n, rng)
    twice = [*complete(6), *((j, i) for i, j in complete(6))]  # the second of each pair is wrong, either way round
    graph = with_wrong(measured(T, twice, rng, noise=1.0), list(range(15, 30)), rng)
    found = average_poses(graph, rng)
    assert found.inliers.tolist() == [True] * 15 + [False] * 15


@BOTH
def test_of_two_answers_that_as_many_edges_support_the_more_trusted_one_is_taken(
    n: int, rng: np.random.Generator
) -> None:
    # A square of right edges; two more, trusted by less, agree on another place for node 2.
    right, other = true_poses(4, n, rng), true_poses(4, n, rng)
    sides = measured(right, [(0, 1), (1, 2), (2, 3), (3, 0)], rng, noise=0.5)
    other[[0, 1]] = right[[0, 1]]
    astray = measured(other, [(0, 2), (1, 2)], rng, noise=0.5)
    graph = PoseGraph(
        4,
        np.concatenate([sides.edges, astray.edges]),
        np.concatenate([sides.T_i_j, astray.T_i_j]),
        np.concatenate([sides.information, astray.information]),
    )
    found = average_poses(graph, rng, np.array([0.7] * 4 + [0.5] * 2))
    assert found.inliers.tolist() == [True] * 4 + [False] * 2


@BOTH
def test_of_two_alternatives_that_agree_one_is_counted(n: int, rng: np.random.Generator) -> None:
    T = true_poses(4, n, rng)
    graph = measured(T, [*complete(4), (0, 1)], rng, noise=0.5)
    inliers = average_poses(graph, rng).inliers
    assert inliers[0] + inliers[6] == 1


@BOTH
def test_refined_poses_are_better_than_one_path_of_noisy_edges(n: int, rng: np.random.Generator) -> None:
    T = true_poses(12, n, rng)
    found = average_poses(measured(T, complete(12), rng, noise=1.0), rng)
    error = se_n.difference(found.T_root_node, T)
    # Eleven paths to each node, some of which turn about far nodes: about 5 cm · sqrt(2 / 12), and 0.7° likewise.
    assert np.sqrt(np.mean(error[1:, n:] ** 2)) < 0.6 * ANGLE


@BOTH
def test_consensus_expresses_poses_in_any_root(n: int, rng: np.random.Generator) -> None:
    T = true_poses(6, n, rng)
    g = measured(T, complete(6), rng)
    found = average_poses(PoseGraph(g.count, g.edges, g.T_i_j, g.information, root=2), rng)
    assert_allclose(found.T_root_node, se_n.inverse(T[2]) @ T, atol=1e-6)


def test_two_hundred_nodes_are_found_in_spite_of_wrong_edges(rng: np.random.Generator) -> None:
    T = true_poses(200, 2, rng, size=60.0)
    edges = [(k, (k + step) % 200) for k in range(200) for step in (1, 2, 5, 11, 40)]
    wrong = rng.permutation(1000)[:200].tolist()
    graph = with_wrong(measured(T, edges, rng, noise=1.0), wrong, rng)
    error = se_n.difference(average_poses(graph, rng).T_root_node, T)
    assert np.max(np.linalg.norm(error[:, :2], axis=1)) < 1.0


@BOTH
def test_loosened_edges_have_the_covariance_of_both_errors(n: int, rng: np.random.Generator) -> None:
    graph = measured(true_poses(3, n, rng), ring(3), rng).with_error_floor(0.12, 0.0)
    expected = [1 / (0.05**2 + 0.12**2)] * n + [ANGLE**-2] * (1 if n == 2 else 3)
    assert_allclose(graph.information[0], np.diag(expected), rtol=1e-9)


def test_loosened_edges_leave_open_what_they_left_open(rng: np.random.Generator) -> None:
    graph = measured(true_poses(2, 2, rng), [(0, 1)], rng)
    hinge = PoseGraph(2, graph.edges, graph.T_i_j, np.diag([400.0, 400.0, 0.0])[None])
    assert_allclose(hinge.with_error_floor(0.0, 0.01).information, hinge.information)


@BOTH
def test_edges_that_are_too_confident_agree_once_loosened(n: int, rng: np.random.Generator) -> None:
    T = true_poses(6, n, rng)
    graph = measured(T, complete(6), rng, noise=1.0)
    sure = PoseGraph(6, graph.edges, graph.T_i_j, graph.information * 1e4)
    assert average_poses(sure, rng).inliers.sum() < 15
    assert average_poses(sure.with_error_floor(POSITION, ANGLE), rng).inliers.sum() == 15


@BOTH
def test_one_node_stands_at_the_root(n: int, rng: np.random.Generator) -> None:
    nothing = np.zeros((0, n + 1, n + 1)), np.zeros((0, 3 * n - 3, 3 * n - 3))
    none = PoseGraph(1, np.zeros((0, 2), dtype=np.intp), *nothing)
    assert_allclose(average_poses(none, rng).T_root_node, np.eye(n + 1)[None])


def test_nodes_that_nothing_reaches_are_named(rng: np.random.Generator) -> None:
    graph = measured(true_poses(5, 2, rng), [(0, 1), (1, 2), (3, 4)], rng)
    with pytest.raises(CalibrationError, match="nodes 3, 4 to node 0"):
        average_poses(graph, rng)


def test_a_ring_is_one_cycle_as_long_as_the_ring() -> None:
    (cycle,) = find_cycle_basis(8, np.array(ring(8)))
    assert len(cycle) == 8


def test_a_wheel_has_its_triangles_for_a_basis() -> None:
    assert [len(c) for c in find_cycle_basis(9, np.array(WHEEL))] == [3] * 8


def test_alternatives_are_cycles_of_two() -> None:
    assert [len(c) for c in find_cycle_basis(2, np.array([(0, 1), (1, 0), (0, 1)]))] == [2, 2]


def test_poses_around_every_cycle_multiply_to_the_identity(rng: np.random.Generator) -> None:
    pairs = np.array(complete(12), dtype=np.intp)[rng.permutation(66)[:40]]
    graph = measured(true_poses(12, 3, rng), pairs, rng)
    for cycle in find_cycle_basis(12, pairs):
        T = np.eye(4)
        for e, way in cycle:
            T = T @ (graph.T_i_j[e] if way > 0 else se_n.inverse(graph.T_i_j[e]))
        assert_allclose(T, np.eye(4), atol=1e-9)


def test_a_basis_has_one_independent_cycle_for_every_edge_beyond_a_tree(rng: np.random.Generator) -> None:
    pairs = np.array(complete(15), dtype=np.intp)[rng.permutation(105)[:50]]
    basis = find_cycle_basis(15, pairs)
    matrix = np.zeros((len(basis), 50))
    for row, cycle in zip(matrix, basis, strict=True):
        row[cycle[:, 0]] = cycle[:, 1]
    assert np.linalg.matrix_rank(matrix) == len(basis) == 50 - 15 + 1


@pytest.mark.parametrize(("n", "limit"), [(2, 4.033), (3, 4.739)])
def test_an_edge_is_an_inlier_within_the_gate_of_chi_squared(
    n: int, limit: float, rng: np.random.Generator
) -> None:
    """99.9 % of three or six degrees of freedom: distances of 4.03 and 4.74 standard deviations."""
    T = true_poses(3, n, rng)
    g = measured(T, [(0, 1), (1, 2), (0, 2)], rng)
    information = g.information * np.array([1e6, 1e6, 1.0])[:, None, None]
    for factor in (0.97, 1.03):
        T_i_j = g.T_i_j.copy()
        T_i_j[2, 0, n] += factor * limit * POSITION
        found = average_poses(PoseGraph(3, g.edges, T_i_j, information), rng)
        assert found.inliers.tolist() == [True, True, factor < 1]


@pytest.mark.parametrize(("count", "listed"), [(10, ""), (11, " ...")])
def test_the_first_ten_nodes_that_no_edge_reaches_are_named(count: int, listed: str) -> None:
    nothing = np.zeros((0, 3, 3))
    graph = PoseGraph(count + 1, np.zeros((0, 2), dtype=np.intp), nothing, nothing)
    with pytest.raises(CalibrationError, match=rf"nodes 1, 2, 3, 4, 5, 6, 7, 8, 9, 10{listed} to node 0"):
        graph.require_connected()
