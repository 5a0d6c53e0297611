"""Averaging of pairs: published rotation averagings, then positions by least squares, chosen by name."""

from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import block_array, coo_array, csc_array, csr_array, eye_array
from scipy.sparse.linalg import eigsh

from calgraph.config.settings import AveragingMethod
from calgraph.errors import CalibrationError
from calgraph.geometry import Array, se_n
from calgraph.graph.cycles import Cycle, find_cycle_basis, incidence_matrix, list_incident_edges
from calgraph.graph.graph_optimization import assemble_blocks, solve_sparse
from calgraph.graph.pose_graph import Edges, PoseAveraging, PoseGraph, PoseGraphSolution
from calgraph.graph.random_trees import compute_tree_poses
from calgraph.graph.spanning_tree import find_minimum_tree
from calgraph.solver.ransac import select_best_of_groups


def select_averaging(method: AveragingMethod) -> PoseAveraging | None:
    """The averaging of pairs; None for the consensus."""
    return None if method == "consensus" else partial(average_poses_by_rotations, method=method)


RotationAveraging = Literal["l1mc", "triangles", "spectral", "irls"]

# Weight of an outlier edge, which keeps the graph connected.
_OUTLIER_WEIGHT = 1e-6


# rad (5°); edges that differ more from the averaged rotations are outliers: above the noise of pairs (0.2 to 2°),
# and small compared with the error of wrong ones.
_MAX_INLIER_ANGLE = float(np.radians(5))


def average_poses_by_rotations(
    graph: PoseGraph, weights: Array | None = None, method: RotationAveraging = "l1mc"
) -> PoseGraphSolution:
    """Poses of all nodes: rotations by a published averaging, translations over the edges whose rotations agree.

    Args:
        graph: connected.
        weights: (E,) of the edges, 0..1; uniform if None.
        method: ``l1mc`` over a basis of all cycles, or over ``triangles`` alone as published; ``spectral``;
            ``irls``.

    Raises:
        CalibrationError: some node is not connected to the root; it is named.
    """
    if method == "spectral":
        R = average_rotations_spectral(graph, weights)
    elif method == "irls":
        R = average_rotations_irls(graph, chain_rotations(graph), weights)
    else:
        R = average_rotations_l1mc(graph, weights, "cycles" if method == "l1mc" else "triangles")
    i, j = graph.edges.T
    angle = se_n.rotation_angle(R[i] @ graph.R_i_j @ se_n.transpose(R[j]))
    inliers = select_best_of_groups((angle / _MAX_INLIER_ANGLE) ** 2, graph.pair_of_edge)
    edge_weights = np.where(inliers, 1.0, _OUTLIER_WEIGHT) * (1.0 if weights is None else weights)
    return PoseGraphSolution(se_n.pose(R, solve_translations(graph, R, edge_weights)), inliers)


def solve_translations(graph: PoseGraph, rotations: Array, weights: Array | None = None) -> Array:
    """Positions (N, n) of least weighted squared error for fixed rotations, the root at the origin.

    Args:
        graph: connected by edges with weights.
        rotations: (N, n, n) from each node to the root.
        weights: (E,) of the edges; uniform if None.

    Raises:
        CalibrationError: some node is not connected to the root.
    """
    w = np.ones(len(graph.edges)) if weights is None else weights
    graph.select_edges(w > 0).require_connected()
    t = (rotations[graph.edges[:, 0]] @ se_n.translation(graph.T_i_j)[..., None])[..., 0]
    return solve_differences(graph, t, w)


# Up to this number of rows, all eigenvectors are computed by a dense solver; above, the leading ones only.
_MAX_DENSE = 300
# Residuals (rad) below this have the same weight in reweighted L1, which ends with steps of a tenth of it.
_MIN_RESIDUAL = 1e-6
# Limit on reweightings, which hardly ever binds.
_MAX_ITERATIONS = 100
# Relative residual of the linear systems.
_TOLERANCE = 1e-10


# Linearizations of the cycle constraints of rotations in space: each error is of second order in the last
# correction.
_LINEARIZATIONS = 4


def average_rotations_l1mc(
    graph: PoseGraph, weights: Array | None = None, transitivity: Literal["cycles", "triangles"] = "cycles"
) -> Array:
    """Robust rotation averaging without start values (Quenzel, Papenberg, Behnke, 2016, Algorithm 1).

    Relative rotations are corrected so that they are consistent around cycles, with the least weighted sum of
    absolute corrections: a linear program. Corrected rotations are then chained. Each pair is one unknown, and
    alternatives of a pair make a cycle of two, so that the symmetry of the paper (eq. 20) holds by construction.

    Args:
        graph: connected. In space, constraints are linearized at the corrected rotations, a few times: they are
            the paper's sums of rotation vectors, each turned into the axes of the node where its cycle starts.
        weights: (E,) of the edges; uniform if None.
        transitivity: ``triangles`` as published, as soft rows of weight 1; ``cycles`` uses a basis of all
            cycles, which covers rings, as exact constraints.

    Returns:
        (N, n, n) rotations from each node to the root.

    Raises:
        CalibrationError: some node is not connected to the root.
    """
    graph.require_connected()
    weights = np.ones(len(graph.edges)) if weights is None else weights
    if transitivity == "cycles":
        cycles, soft = find_cycle_basis(graph.count, graph.edges), False
    else:
        cycles, soft = find_triangles(graph.count, graph.edges), True
    d = 1 if graph.dimension == 2 else 3
    corrections, R_i_j = np.zeros((len(graph.edges), d)), graph.R_i_j
    for _ in range(1 if d == 1 else _LINEARIZATIONS):
        A, errors = _linearize_cycles(R_i_j, cycles)
        b = A @ corrections.ravel() - errors
        corrections = _minimize_absolute_sum(A, b, np.repeat(weights, d), soft).reshape(-1, d)
        R_i_j = graph.R_i_j @ se_n.exp(corrections)
    # With soft constraints, the least corrected edges are the most consistent.
    return _chain_along_tree(graph, R_i_j, np.linalg.norm(corrections, axis=1))


def average_rotations_spectral(graph: PoseGraph, weights: Array | None = None) -> Array:
    """Spectral relaxation (Arie-Nachimson et al., "Global motion estimation from point matches", 3DIMPVT 2012).

    Rotations are the leading eigenvectors of the matrix of relative rotations, each block of which is projected on
    SO(n). Exact without noise, but not robust.

    Args:
        graph: connected.
        weights: (E,) of the edges; uniform if None.

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
    # Blocks (E, n, n) at (i, j), transposed at (j, i); those of alternatives are summed.
    both_ways = np.concatenate([blocks, se_n.transpose(blocks)])
    G = csr_array(assemble_blocks(np.concatenate([i, j]), np.concatenate([j, i]), both_ways, count, count))
    if count * n <= _MAX_DENSE:
        vectors = np.linalg.eigh(G.toarray())[1][:, -n:]
    else:
        # From a fixed start, so that results repeat.
        start = np.random.default_rng(0).normal(size=G.shape[0])
        vectors = np.asarray(eigsh(G, k=n, which="LA", v0=start)[1], dtype=np.float64)
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
        start: (N, n, n) rotations from each node to the root, near the solution.
        weights: (E,) of the edges; uniform if None.

    Returns:
        (N, n, n) rotations from each node to the root.
    """
    graph.require_connected()
    w = np.ones(len(graph.edges)) if weights is None else weights
    i, j = graph.edges.T
    R = start
    for _ in range(_MAX_ITERATIONS):
        errors = se_n.log(R[i] @ graph.R_i_j @ se_n.transpose(R[j]))
        reweighted = w / np.maximum(np.linalg.norm(errors, axis=1), _MIN_RESIDUAL)
        delta = solve_differences(graph, errors, reweighted)
        R = se_n.exp(delta) @ R
        if np.max(np.abs(delta), initial=0.0) < _MIN_RESIDUAL / 10:
            break
    return np.asarray(R[graph.root].T @ R)


def chain_rotations(graph: PoseGraph) -> Array:
    """(N, n, n) rotations from each node to the root along shallow trees, as start values."""
    graph.require_connected()
    return _chain_along_tree(graph, graph.R_i_j, np.zeros(len(graph.edges)))


def find_triangles(count: int, edges: Edges) -> tuple[Cycle, ...]:
    """All cycles of three edges, the constraints of the paper."""
    adjacency = list_incident_edges(count, edges)
    triangles = []
    for a in range(count):
        for b, ab, ab_direction in adjacency[a]:
            for c, bc, bc_direction in adjacency[b] if b > a else ():
                closing = (edge for edge in adjacency[c] if edge[0] == a) if c > b else ()
                triangles += [
                    np.array([(ab, ab_direction), (bc, bc_direction), (ca, direction)], dtype=np.intp)
                    for _, ca, direction in closing
                ]
    return tuple(triangles)


def solve_differences(graph: PoseGraph, differences: Array, weights: Array) -> Array:
    """(N, k) with ``x[j] - x[i] ≈ differences`` (E, k) in least squares with weights (E,), zero at the root."""
    i, j = graph.edges.T
    rows, columns = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
    values = np.concatenate([weights, weights, -weights, -weights])
    H = csc_array(coo_array((values, (rows, columns)), shape=(graph.count, graph.count)))
    g = np.zeros((graph.count, differences.shape[1]))
    np.add.at(g, i, -weights[:, None] * differences)
    np.add.at(g, j, weights[:, None] * differences)
    free = np.arange(graph.count) != graph.root
    return np.concatenate([solve_sparse(H, column[:, None], free, _TOLERANCE) for column in g.T], axis=1)


def _linearize_cycles(R_i_j: Array, cycles: tuple[Cycle, ...]) -> tuple[csr_array, Array]:
    """Derivatives of the cycles' errors by the corrections, sparse (C d, E d), and the errors (C d,), rad.

    The errors are wrapped, which removes multiples of 2π (Algorithm 1, last rows of b).
    """
    d = 1 if R_i_j.shape[-1] == 2 else 3
    if d == 1:
        A = incidence_matrix(cycles, len(R_i_j))
        summed = A @ se_n.log(R_i_j)[:, 0]
        return A, np.asarray(np.angle(np.exp(1j * summed)), dtype=np.float64)
    rows, columns, blocks, errors = [], [], [], np.zeros((len(cycles), d))
    for c, cycle in enumerate(cycles):
        R = np.eye(3)
        for e, direction in cycle:
            # Corrected edges are R_i_j exp(x), about the axes of j: the end of a forward edge, the start of a
            # reversed one.
            after = R @ (R_i_j[e] if direction > 0 else R_i_j[e].T)
            rows.append(c)
            columns.append(int(e))
            blocks.append(after if direction > 0 else -R)
            R = after
        errors[c] = se_n.log(R)
    where = np.array(rows, dtype=np.intp), np.array(columns, dtype=np.intp)
    A = assemble_blocks(*where, np.array(blocks).reshape(-1, 3, 3), len(cycles), len(R_i_j))
    return csr_array(A), errors.ravel()


def _minimize_absolute_sum(A: csr_array, b: Array, weights: Array, soft: bool) -> Array:
    """The x of least weighted sum of |x| subject to ``A x = b``, or with |A x - b| added to the sum if soft.

    Args:
        A: (M, V) sparse.
        b: (M,).
        weights: (V,) not negative.
        soft: whether the rows are soft constraints of weight 1.
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


def _chain_along_tree(graph: PoseGraph, R_i_j: Array, cost: Array) -> Array:
    """Rotations (N, n, n) along the spanning tree of least costs (E,) of the edges."""
    # SciPy treats stored zeros as missing edges.
    in_tree = find_minimum_tree(graph, 1.0 + cost)
    rotations = replace(graph, T_i_j=se_n.pose(R_i_j, np.zeros((len(R_i_j), graph.dimension))))
    return se_n.rotation(compute_tree_poses(rotations.select_edges(in_tree), np.ones((1, graph.count - 1)))[0])
