"""Cycles of pose graphs: shortest ones through every edge, their consistency, and the support of edges."""

import numpy as np
import pytest
from scipy.stats import chi2

from calgraph.graph.cycles import check_consistency, edge_support, find_cycles_through_edges, incidence_matrix
from calgraph.graph.pose_graph import PoseGraph
from pose_graphs import WHEEL, complete, measured, ring, true_poses, with_wrong


def make_rings(count: int, length: int, n: int, rng: np.random.Generator, ratio: float) -> PoseGraph:
    """Rings without common nodes, with ``ratio`` times the stated errors; every other edge reversed."""
    edges = [(length * k + i, length * k + j) for k in range(count) for i, j in ring(length)]
    edges = [(j, i) if e % 2 else (i, j) for e, (i, j) in enumerate(edges)]
    noise = 0.02  # small, so that first-order covariances hold
    graph = measured(true_poses(count * length, n, rng), edges, rng, noise)
    return PoseGraph(graph.count, graph.edges, graph.T_i_j, graph.information * (ratio / noise) ** 2)


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("length", [2, 3, 6])
@pytest.mark.parametrize("ratio", [1.0, 2.0])
def test_the_share_of_consistent_cycles_is_that_of_chi_squared(
    n: int, length: int, ratio: float, rng: np.random.Generator
) -> None:
    """At the 99.9 % limit; 78 or 53 % of cycles whose errors are twice the stated ones."""
    graph = make_rings(1000, length, n, rng, ratio)
    rows = np.arange(length)
    cycles = [
        np.column_stack([length * k + rows, np.where((length * k + rows) % 2, -1, 1)]).astype(np.intp)
        for k in range(1000)
    ]
    dof = {2: 3, 3: 6}[n]
    expected = chi2.cdf(chi2.isf(0.001, dof) / ratio**2, dof)
    assert check_consistency(graph, cycles).mean() == pytest.approx(expected, abs=0.003 if ratio == 1 else 0.05)


def test_support_is_the_share_of_consistent_cycles_and_one_half_more_of_two() -> None:
    """Of four nodes in all four triangles, with one wrong edge: (consistent + 1/2) / (cycles + 1)."""
    rng = np.random.default_rng(1)
    graph = with_wrong(measured(true_poses(4, 2, rng), complete(4), rng), [0], rng)  # 01, 02, 03, 12, 13, 23
    triangles = [
        [(0, 1), (3, 1), (1, -1)],
        [(0, 1), (4, 1), (2, -1)],
        [(1, 1), (5, 1), (2, -1)],
        [(3, 1), (5, 1), (4, -1)],
    ]
    support = edge_support(graph, [np.array(cycle, dtype=np.intp) for cycle in triangles])
    np.testing.assert_allclose(support, [0.5 / 3, 0.5, 0.5, 0.5, 0.5, 2.5 / 3])


def test_an_edge_without_cycles_has_a_support_of_one_half(rng: np.random.Generator) -> None:
    graph = measured(true_poses(2, 2, rng), [(0, 1)], rng)
    np.testing.assert_allclose(edge_support(graph, []), [0.5])


def test_every_edge_of_a_wheel_is_in_a_triangle_of_each_round(rng: np.random.Generator) -> None:
    """Rim edges are in one triangle; each spoke is in two, which are found in different rounds."""
    graph = measured(true_poses(9, 2, rng), WHEEL, rng)
    cycles = find_cycles_through_edges(graph, 12, rng)
    assert len(cycles) == 12 * 16
    assert {len(cycle) for cycle in cycles} == {3}
    assert [int(cycle[0, 0]) for cycle in cycles[:16]] == list(range(16))
    assert len({frozenset(cycle[:, 0].tolist()) for cycle in cycles}) == 8


def test_cycles_do_not_return_over_an_alternative_of_their_edge(rng: np.random.Generator) -> None:
    graph = measured(true_poses(4, 2, rng), [*ring(4), (1, 0)], rng)
    assert {len(cycle) for cycle in find_cycles_through_edges(graph, 1, rng)} == {4}
    tree = measured(true_poses(3, 2, rng), [(0, 1), (1, 2), (2, 1)], rng)
    assert find_cycles_through_edges(tree, 2, rng) == ()


def test_incidence_has_the_directions_of_edges() -> None:
    cycles = [np.array([(0, 1), (2, -1)], dtype=np.intp), np.array([(1, 1), (2, 1), (3, -1)], dtype=np.intp)]
    np.testing.assert_array_equal(incidence_matrix(cycles, 4).toarray(), [[1, 0, -1, 0], [0, 1, 1, -1]])
