"""Rotations of all nodes from relative ones, without poses: L1MC, spectral relaxation, iteratively reweighted L1.

These are the published methods, for comparison; :func:`calgraph.graph.consensus_trees` is the default.
"""

from typing import Literal

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import block_array, csr_array, eye_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.sparse.linalg import eigsh

from calgraph.errors import CalibrationError
from calgraph.geometry import Array, se_n
from calgraph.graph.cycles import Cycle, find_cycle_basis, find_triangles, incidence_matrix
from calgraph.graph.graph_optimization import solve_differences
from calgraph.graph.pose_graph import Edges, PoseGraph

# Up to so many rows all eigenvectors are found at once; above, only the leading ones.
_DENSE = 300
# Residuals (rad) below this weigh alike in reweighted L1; steps below a tenth of it are the last.
_FLOOR = 1e-6
_ITERATIONS = 100
# How often the constraints of rotations in space are linearised.
_LINEARISATIONS = 4


def average_rotations_l1mc(
    graph: PoseGraph, weights: Array | None = None, transitivity: Literal["cycles", "triangles"] = "cycles"
) -> Array:
    """Robust rotation averaging without a start (Quenzel, Papenberg, Behnke, 2016, Algorithm 1).

    Relative rotations are corrected so that they agree around cycles, with the least weighted sum of absolute
    corrections: a linear program. Corrected ones are then chained. Each pair is one unknown here, and alternatives
    of a pair make a cycle of two, so that the paper's symmetry (eq. 20) holds by construction.

    Args:
        graph: connected. In space, constraints are linearised at the corrected rotations, a few times: they are
            the paper's sums of rotation vectors, each turned into the axes of the node where its cycle starts.
        weights: (E,) trust in each edge; uniform without.
        transitivity: ``triangles`` as published, as soft rows of weight 1; ``cycles`` takes a basis of all
            cycles, so that rings are covered, and holds them exactly.

    Returns:
        (N, n, n) rotations from each node to the root.

    Raises:
        CalibrationError: some node is not connected to the root.
    """
    graph.require_connected()
    trust = np.ones(len(graph.edges)) if weights is None else weights
    if transitivity == "cycles":
        cycles, soft = find_cycle_basis(graph.count, graph.edges), False
    else:
        cycles, soft = find_triangles(graph.count, graph.edges), True
    d = 1 if graph.dimension == 2 else 3
    corrections, R_i_j = np.zeros((len(graph.edges), d)), graph.R_i_j
    for _ in range(1 if d == 1 else _LINEARISATIONS):
        A, errors = _linearize_cycles(R_i_j, cycles)
        b = A @ corrections.ravel() - errors
        corrections = _minimize_absolute_sum(A, b, np.repeat(trust, d), soft).reshape(-1, d)
        R_i_j = graph.R_i_j @ se_n.exp(corrections)
    # Where cycles are not held exactly, the least corrected edges are the ones to follow.
    return _chain_along_tree(graph, R_i_j, np.linalg.norm(corrections, axis=1))


def average_rotations_spectral(graph: PoseGraph, weights: Array | None = None) -> Array:
    """Spectral relaxation (Arie-Nachimson et al., "Global motion estimation from point matches", 3DIMPVT 2012).

    Rotations are the leading eigenvectors of the matrix of relative rotations, each block of which is projected on
    SO(n). Exact without noise, but not robust.

    Args:
        graph: connected.
        weights: (E,) trust in each edge; uniform without.

    Returns:
        (N, n, n) rotations from each node to the root.
    """
    graph.require_connected()
    n, count = graph.dimension, graph.count
    w = np.ones(len(graph.edges)) if weights is None else weights
    degree = np.bincount(graph.edges.ravel(), np.repeat(w, 2), minlength=count)
    scale = np.sqrt(np.maximum(degree, np.finfo(np.float64).tiny))
    i, j = graph.edges.T
    blocks = (w / (scale[i] * scale[j]))[:, None, None] * graph.R_i_j
    G = _block_matrix(graph, blocks)
    vectors = np.linalg.eigh(G.toarray())[1][:, -n:] if count * n <= _DENSE else _leading_eigenvectors(G, n)
    # Rows of the eigenvectors are R_node_root times one unknown orthogonal matrix, which may be a reflection.
    M = vectors.reshape(count, n, n)
    if np.sum(np.sign(np.linalg.det(M))) < 0:
        M = M * np.where(np.arange(n) == n - 1, -1.0, 1.0)
    R_node_any = se_n.nearest_rotation(M)
    return np.asarray(R_node_any[graph.root] @ se_n.transpose(R_node_any))


def average_rotations_irls(graph: PoseGraph, start: Array, weights: Array | None = None) -> Array:
    """L1 rotation averaging by iterative reweighting (Chatterjee and Govindu, ICCV 2013).

    Args:
        graph: connected.
        start: (N, n, n) rotations from each node to the root, near enough.
        weights: (E,) trust in each edge; uniform without.

    Returns:
        (N, n, n) rotations from each node to the root.
    """
    graph.require_connected()
    w = np.ones(len(graph.edges)) if weights is None else weights
    i, j = graph.edges.T
    R = start
    for _ in range(_ITERATIONS):
        errors = se_n.log(R[i] @ graph.R_i_j @ se_n.transpose(R[j]))
        reweighted = w / np.maximum(np.linalg.norm(errors, axis=1), _FLOOR)
        delta = solve_differences(graph.count, graph.edges, errors, reweighted, graph.root)
        R = se_n.exp(delta) @ R
        if np.max(np.abs(delta), initial=0.0) < _FLOOR / 10:
            break
    return np.asarray(R[graph.root].T @ R)


def chain_rotations(graph: PoseGraph) -> Array:
    """(N, n, n) rotations from each node to the root along few edges each: a start for others."""
    graph.require_connected()
    return _chain_along_tree(graph, graph.R_i_j, np.zeros(len(graph.edges)))


def _linearize_cycles(R_i_j: Array, cycles: tuple[Cycle, ...]) -> tuple[csr_array, Array]:
    """What corrections do to the cycles' errors: sparse (C d, E d), and the errors (C d,) themselves, rad.

    The errors are wrapped, which takes the multiples of 2π out (Algorithm 1, last rows of b).
    """
    d = 1 if R_i_j.shape[-1] == 2 else 3
    if d == 1:
        A = incidence_matrix(cycles, len(R_i_j))
        summed = A @ se_n.log(R_i_j)[:, 0]
        return A, np.asarray(np.angle(np.exp(1j * summed)), dtype=np.float64)
    rows, columns, blocks, errors = [], [], [], np.zeros((len(cycles), d))
    for c, cycle in enumerate(cycles):
        R = np.eye(3)
        for e, way in cycle:
            # Corrected edges are R_i_j exp(x), about j's axes: there a walk forwards ends, a backward one begins.
            after = R @ (R_i_j[e] if way > 0 else R_i_j[e].T)
            rows.append(c)
            columns.append(int(e))
            blocks.append(after if way > 0 else -R)
            R = after
        errors[c] = se_n.log(R)
    where = np.array(rows, dtype=np.intp), np.array(columns, dtype=np.intp)
    A = _sparse_blocks(*where, np.array(blocks).reshape(-1, 3, 3), len(cycles), len(R_i_j))
    return A, errors.ravel()


def _minimize_absolute_sum(A: csr_array, b: Array, weights: Array, soft: bool) -> Array:
    """The x of least weighted sum of |x| with ``A x = b``, or of that and |A x - b| where soft.

    Args:
        A: (M, V) sparse.
        b: (M,).
        weights: (V,) not negative.
        soft: whether rows may be missed, at weight 1.
    """
    if not A.shape[0]:
        return np.zeros(A.shape[1])
    costs, parts = [weights, weights], [A, -A]
    if soft:
        slack = eye_array(A.shape[0])
        costs, parts = [*costs, np.ones(2 * A.shape[0])], [*parts, slack, -slack]
    solution = linprog(
        np.concatenate(costs), A_eq=block_array([parts], format="csc"), b_eq=b, bounds=(0, None), method="highs"
    )
    if solution.x is None:
        raise CalibrationError(f"L1 rotation averaging found no solution: {solution.message}")
    return np.asarray(solution.x[: A.shape[1]] - solution.x[A.shape[1] : 2 * A.shape[1]], dtype=np.float64)


def _chain_along_tree(graph: PoseGraph, R_i_j: Array, distrust: Array) -> Array:
    """Rotations (N, n, n) along the spanning tree of the least distrusted edges (E,)."""
    i, j = graph.edges.T
    # The tree routine takes stored zeros for missing edges, and keeps one value for alternatives: their best.
    value = 1.0 + distrust
    order = np.lexsort((value, graph.pair_of_edge))
    best = order[np.unique(graph.pair_of_edge[order], return_index=True)[1]]
    edge_of = {(int(a), int(b)): int(e) for e in best for a, b in ((i[e], j[e]), (j[e], i[e]))}
    shape = (graph.count, graph.count)
    tree = minimum_spanning_tree(csr_array((value[best], (i[best], j[best])), shape=shape))
    nodes, before = breadth_first_order(tree, graph.root, directed=False)
    R = np.zeros((graph.count, *R_i_j.shape[1:])) + np.eye(R_i_j.shape[-1])
    for node in nodes[1:]:
        parent = int(before[node])
        e = edge_of[parent, int(node)]
        R[node] = R[parent] @ (R_i_j[e] if i[e] == parent else R_i_j[e].T)
    return R


def _block_matrix(graph: PoseGraph, blocks: Array) -> csr_array:
    """Sparse symmetric matrix (N n, N n) with the blocks (E, n, n) at (i, j), summed over alternatives."""
    i, j = graph.edges.T
    rows, columns = np.concatenate([i, j]), np.concatenate([j, i])
    return _sparse_blocks(
        rows, columns, np.concatenate([blocks, se_n.transpose(blocks)]), graph.count, graph.count
    )


def _sparse_blocks(rows: Edges, columns: Edges, blocks: Array, height: int, width: int) -> csr_array:
    """Sparse matrix of square blocks (B, k, k) at block rows and columns (B,), summed where several coincide."""
    k = blocks.shape[-1]
    r = np.broadcast_to(rows[:, None, None] * k + np.arange(k)[:, None], blocks.shape)
    c = np.broadcast_to(columns[:, None, None] * k + np.arange(k), blocks.shape)
    return csr_array((blocks.ravel(), (r.ravel(), c.ravel())), shape=(height * k, width * k))


def _leading_eigenvectors(G: csr_array, n: int) -> Array:
    """The n eigenvectors of largest eigenvalue, from a fixed start, so that results repeat."""
    start = np.random.default_rng(0).normal(size=G.shape[0])
    return np.asarray(eigsh(G, k=n, which="LA", v0=start)[1], dtype=np.float64)
