"""Least squares over pose graphs: the sparse solvers, and the minimum that they find."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.sparse import csc_array, eye_array, random_array

from calgraph.geometry import Array, se_n
from calgraph.graph import graph_optimization
from calgraph.graph.graph_optimization import optimize_poses, optimize_poses_robustly, solve_sparse
from calgraph.graph.pose_graph import PoseGraph, residuals
from pose_graphs import ANGLE, POSITION, complete, measured, true_poses, with_wrong

BOTH = pytest.mark.parametrize("n", [2, 3])


@pytest.mark.parametrize("nodes", [10, 33, 34, 100, 300], ids=lambda nodes: f"{3 * nodes - 3} unknowns")
def test_sparse_systems_of_any_size_are_solved(rng: np.random.Generator, nodes: int) -> None:
    """Dense factors up to 100 unknowns, sparse ones up to 500, then conjugate gradients: one solution."""
    J = random_array((9 * nodes, 3 * nodes), density=3 / nodes, rng=rng)
    H = csc_array(J.T @ J + 0.1 * eye_array(3 * nodes))
    g, free = rng.normal(size=(nodes, 3)), np.arange(nodes) != 1
    found = solve_sparse(H, g, free, 1e-10)
    rows = np.repeat(free, 3)
    np.testing.assert_allclose((H @ found.ravel())[rows], g[free].ravel(), atol=1e-6)
    assert (found[1] == 0).all()


def test_a_long_chain_is_solved_without_convergence_of_conjugate_gradients(rng: np.random.Generator) -> None:
    """Stiff links between 400 nodes, one of which is held: information travels one link per iteration."""
    n = 1200
    H = csc_array(np.diag(np.full(n, 2.0)) - np.diag(np.ones(n - 3), 3) - np.diag(np.ones(n - 3), -3))
    g = rng.normal(size=(400, 3))
    found = solve_sparse(H, g, np.ones(400, dtype=np.bool_), 1e-10)
    np.testing.assert_allclose(H @ found.ravel(), g.ravel(), atol=1e-6)


def test_without_free_nodes_nothing_moves() -> None:
    H = csc_array(np.eye(6))
    assert (solve_sparse(H, np.ones((2, 3)), np.zeros(2, dtype=np.bool_), 1e-4) == 0).all()


@BOTH
def test_optimized_poses_have_the_least_weighted_squared_error(n: int, rng: np.random.Generator) -> None:
    T = true_poses(6, n, rng)
    graph, weights = measured(T, complete(6), rng, noise=1.0), rng.uniform(0.1, 2.0, 15)
    found = optimize_poses(graph, T, weights)
    k = 3 * n - 3

    def whitened(delta: Array) -> Array:
        moved = se_n.retract(found, np.concatenate([np.zeros(k), delta]).reshape(6, k))
        r = residuals(graph, moved)
        L = np.linalg.cholesky(graph.information * weights[:, None, None])
        return np.asarray(np.einsum("eji,ej->ei", L, r).ravel())

    best = least_squares(whitened, np.zeros(5 * k), xtol=1e-12, ftol=1e-12)
    np.testing.assert_allclose(best.x, 0, atol=2e-5)
    np.testing.assert_allclose(found[0], T[0], atol=1e-12)


def test_nodes_stay_where_their_edges_do_not_determine_them(rng: np.random.Generator) -> None:
    """The edge to node 1 does not measure x, in which it is off by 0.3 m; that to node 3 has no weight."""
    T = np.tile(np.eye(3), (4, 1, 1))
    graph = measured(T, [(0, 1), (0, 2), (0, 3)], rng)
    graph.information[0, 0, 0] = 0.0
    offset = np.array([[0.0, 0.0, 0.0], [0.3, 0.1, 0.0], [0.3, 0.1, 0.0], [0.3, 0.1, 0.0]])
    found = optimize_poses(graph, se_n.retract(T, offset), np.array([1.0, 1.0, 0.0]))
    expected = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.0], [0.3, 0.1]])
    np.testing.assert_allclose(found[:, :2, 2], expected, atol=1e-9)


@BOTH
def test_robust_poses_fit_all_but_the_wrong_edges(n: int, rng: np.random.Generator) -> None:
    """Four of 28 edges are wrong, and the start is off by ten standard deviations of an edge."""
    T = true_poses(8, n, rng)
    wrong = [3, 9, 16, 25]
    graph = with_wrong(measured(T, complete(8), rng, noise=0.1), wrong, rng)
    sigma = np.array([POSITION] * n + [ANGLE] * (1 if n == 2 else 3))
    offset = 10 * sigma * rng.normal(size=(8, len(sigma)))
    offset[0] = 0
    gate = {2: 16.3, 3: 22.5}[n]  # chi-squared, 99.9 %
    found = optimize_poses_robustly(graph, se_n.retract(T, offset), gate)
    best = optimize_poses(graph, T, np.where(np.isin(np.arange(28), wrong), 0.0, 1.0))
    np.testing.assert_allclose(se_n.difference(found, best) / sigma, 0, atol=0.02)


def test_the_last_robust_step_has_geman_mcclure_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two edges of a pair, 1 m apart: at a squared distance equal to the squared scale, a weight of a quarter."""
    monkeypatch.setattr("calgraph.graph.graph_optimization._FIRST_ROBUST_SCALE", 0.25)
    T = np.tile(np.eye(3), (2, 1, 1))
    T_i_j = se_n.retract(T, np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    graph = PoseGraph(2, np.array([[0, 1], [0, 1]]), T_i_j, np.tile(np.eye(3), (2, 1, 1)))
    found = optimize_poses_robustly(graph, T, 4.0)
    np.testing.assert_allclose(found[1, :2, 2], [0.25 / 1.25, 0.0], atol=1e-8)


def test_scales_of_the_robust_loss_are_halved_from_64_to_a_quarter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without steps, the squared distance of an edge stays at the gate."""
    used: list[float] = []

    def record_weight(_graph: PoseGraph, T_root_node: Array, weights: Array) -> Array:
        used.append(float(weights[0]))
        return np.zeros((len(T_root_node), 3))

    monkeypatch.setattr(graph_optimization, "gauss_newton_step", record_weight)
    T = np.tile(np.eye(3), (2, 1, 1))
    graph = PoseGraph(2, np.array([[0, 1]]), se_n.retract(T[:1], np.array([[2.0, 0.0, 0.0]])), np.eye(3)[None])
    optimize_poses_robustly(graph, T, 4.0)
    np.testing.assert_allclose(used, [(1 + 2.0**-k) ** -2 for k in range(6, -3, -1)])
