"""Published rotation averaging: exact without noise, and as robust against outlier edges as published."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.geometry import Array, se_n
from calgraph.graph.averaging import (
    average_rotations_irls,
    average_rotations_l1mc,
    average_rotations_spectral,
    chain_rotations,
    find_triangles,
    solve_translations,
)
from calgraph.graph.pose_graph import PoseGraph
from pose_graphs import WHEEL, complete, measured, ring, true_poses, with_wrong

BOTH = pytest.mark.parametrize("n", [2, 3])


def by_irls(graph: PoseGraph) -> Array:
    return average_rotations_irls(graph, chain_rotations(graph))


def by_triangles(graph: PoseGraph) -> Array:
    return average_rotations_l1mc(graph, transitivity="triangles")


METHODS = pytest.mark.parametrize(
    "method", [average_rotations_l1mc, by_triangles, average_rotations_spectral, by_irls, chain_rotations]
)
ROBUST = pytest.mark.parametrize("method", [average_rotations_l1mc, by_triangles, by_irls])
Method = Callable[[PoseGraph], Array]


@BOTH
@METHODS
@pytest.mark.parametrize("edges", [ring(8), complete(6), WHEEL], ids=["ring", "complete", "wheel"])
def test_rotations_are_exact_without_noise(
    n: int, method: Method, edges: list[tuple[int, int]], rng: np.random.Generator
) -> None:
    T = true_poses(1 + max(max(e) for e in edges), n, rng)
    assert_allclose(method(measured(T, edges, rng)), se_n.rotation(T), atol=1e-6)


@BOTH
@METHODS
def test_rotations_are_expressed_in_any_root(n: int, method: Method, rng: np.random.Generator) -> None:
    T = true_poses(6, n, rng)
    g = measured(T, complete(6), rng)
    R = method(PoseGraph(g.count, g.edges, g.T_i_j, g.information, root=4))
    assert_allclose(R, se_n.rotation(se_n.inverse(T[4]) @ T), atol=1e-6)


@BOTH
@ROBUST
def test_one_wrong_edge_among_triangles_does_not_turn_anything(
    n: int, method: Method, rng: np.random.Generator
) -> None:
    T = true_poses(9, n, rng)
    graph = with_wrong(measured(T, WHEEL, rng), [11], rng)
    assert np.max(se_n.rotation_angle(method(graph) @ se_n.transpose(se_n.rotation(T)))) < 1e-4


@BOTH
def test_spectral_relaxation_gives_way_to_one_wrong_edge(n: int, rng: np.random.Generator) -> None:
    T = true_poses(9, n, rng)
    graph = with_wrong(measured(T, WHEEL, rng), [11], rng)
    assert np.max(
        se_n.rotation_angle(average_rotations_spectral(graph) @ se_n.transpose(se_n.rotation(T)))
    ) > np.radians(1)


@BOTH
def test_weights_decide_which_edge_of_a_ring_gives_way(n: int, rng: np.random.Generator) -> None:
    T = true_poses(8, n, rng)
    graph = with_wrong(measured(T, ring(8), rng), [3], rng)
    weights = np.where(np.arange(8) == 3, 0.1, 1.0)
    assert_allclose(average_rotations_l1mc(graph, weights), se_n.rotation(T), atol=1e-6)


def test_reweighting_reaches_the_least_absolute_sum_and_no_less(rng: np.random.Generator) -> None:
    T = true_poses(7, 2, rng)
    graph = measured(T, complete(7), rng, noise=1.0)
    i, j = graph.edges.T

    def objective(R: Array) -> float:
        return float(np.sum(se_n.rotation_angle(R[i] @ graph.R_i_j @ se_n.transpose(R[j]))))

    assert_allclose(objective(by_irls(graph)), objective(average_rotations_l1mc(graph)), rtol=1e-4)


@BOTH
def test_positions_are_exact_without_noise(n: int, rng: np.random.Generator) -> None:
    T = true_poses(8, n, rng)
    assert_allclose(
        solve_translations(measured(T, ring(8), rng), se_n.rotation(T)), se_n.translation(T), atol=1e-8
    )


@BOTH
def test_an_edge_without_weight_moves_nothing(n: int, rng: np.random.Generator) -> None:
    T = true_poses(9, n, rng)
    graph = with_wrong(measured(T, WHEEL, rng), [5], rng)
    found = solve_translations(graph, se_n.rotation(T), (np.arange(16) != 5).astype(float))
    assert_allclose(found, se_n.translation(T), atol=1e-8)


def test_a_ring_has_no_triangles() -> None:
    assert find_triangles(8, np.array(ring(8))) == ()


def test_a_wheel_has_a_triangle_for_each_spoke() -> None:
    assert len(find_triangles(9, np.array(WHEEL))) == 8
