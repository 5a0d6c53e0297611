"""Least squares over a whole graph, sparse: of node poses, and of positions alone under known rotations."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, coo_array, csc_array, eye_array
from scipy.sparse.linalg import LinearOperator, cg, splu

from calgraph.geometry import Array, se_n
from calgraph.graph.pose_graph import Edges, PoseGraph, chi_squared, residuals

# Added to the normal equations, relative to their diagonal's mean: holds what the edges leave open where it is.
_RIDGE = 1e-9
# Steps whose largest component (m or rad) is smaller are the last.
_CONVERGED = 1e-6
# The first robust loss forgives this many times more than the gate, each next half as much.
_FIRST_SCALE = 64.0
# Up to so many unknowns dense matrices are faster; above so many conjugate gradients are tried first.
_SMALL, _LARGE, _ITERATIONS = 100, 500, 300
# Relative precision of a step, which others follow, and of a solution.
_STEP, _FINAL = 1e-4, 1e-10


def gauss_newton_step(graph: PoseGraph, T_root_node: Array, weights: Array) -> Array:
    """One Gauss–Newton step (N, n+d) along the root's fixed axes; zero for the root.

    Args:
        graph: connected by edges with weights.
        T_root_node: (N, n+1, n+1) where to linearise.
        weights: (E,) of the edges' squared residuals.
    """
    i, j = graph.edges.T
    n = graph.dimension
    # In the root's axes the residual moves with node j one to one, and against node i but for its turning arm.
    B = se_n.rotation_adjoint(se_n.rotation(T_root_node))[i]
    W = weights[:, None, None] * (B @ graph.information @ se_n.transpose(B))
    r = (B @ residuals(graph, T_root_node)[..., None])[..., 0]
    J_i = np.zeros_like(W) - np.eye(W.shape[-1])
    arm = se_n.translation(T_root_node)[j] - se_n.translation(T_root_node)[i]
    J_i[:, :n, n:] -= se_n.rotation_jacobian(arm)
    WJ = W @ J_i
    H = _assemble_blocks(graph, se_n.transpose(J_i) @ WJ, se_n.transpose(WJ), W)
    H = csc_array(H + _RIDGE * float(H.diagonal().mean()) * eye_array(H.shape[0]))
    g = np.zeros((graph.count, W.shape[-1]))
    np.add.at(g, i, -np.einsum("eki,ek->ei", WJ, r))
    np.add.at(g, j, -np.einsum("eij,ej->ei", W, r))
    return _solve(H, g, np.arange(graph.count) != graph.root, _STEP)


def optimize_poses(graph: PoseGraph, T_root_node: Array, weights: Array, iterations: int = 10) -> Array:
    """The poses (N, n+1, n+1) of least weighted squared error, near those given (Gauss–Newton)."""
    for _ in range(iterations):
        delta = gauss_newton_step(graph, T_root_node, weights)
        T_root_node = se_n.retract(T_root_node, delta)
        if np.max(np.abs(delta), initial=0.0) < _CONVERGED:
            break
    return T_root_node


def optimize_poses_robustly(graph: PoseGraph, T_root_node: Array, gate: float) -> Array:
    """The poses that fit the edges within the gate best, from a start where noise has added up along a tree.

    Graduated non-convexity: Geman–McClure losses of ever smaller scale (Yang, Antonante, Tzoumas, Carlone,
    RA-L 2020).

    Args:
        graph: connected.
        T_root_node: (N, n+1, n+1) start.
        gate: squared Mahalanobis distance at which edges cease to count.
    """
    scale = _FIRST_SCALE
    while scale >= 0.25:
        chi2 = chi_squared(graph, T_root_node)
        weights = np.asarray((1 + chi2 / (scale * gate)) ** -2)
        T_root_node = se_n.retract(T_root_node, gauss_newton_step(graph, T_root_node, weights))
        scale /= 2
    return T_root_node


def solve_translations(graph: PoseGraph, rotations: Array, weights: Array | None = None) -> Array:
    """Positions (N, n) of least weighted squared error under known rotations, the root at the origin.

    Args:
        graph: connected by edges with weights.
        rotations: (N, n, n) from each node to the root.
        weights: (E,); uniform without.

    Raises:
        CalibrationError: some node is not connected to the root.
    """
    w = np.ones(len(graph.edges)) if weights is None else weights
    graph.select_edges(w > 0).require_connected()
    t = (rotations[graph.edges[:, 0]] @ se_n.translation(graph.T_i_j)[..., None])[..., 0]
    return solve_differences(graph.count, graph.edges, t, w, graph.root)


def solve_differences(count: int, edges: Edges, differences: Array, weights: Array, root: int) -> Array:
    """(N, k) with ``x[j] - x[i] ≈ differences`` (E, k) in weighted least squares, zero at the root."""
    i, j = edges.T
    rows, columns = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
    values = np.concatenate([weights, weights, -weights, -weights])
    H = csc_array(coo_array((values, (rows, columns)), shape=(count, count)))
    g = np.zeros((count, differences.shape[1]))
    np.add.at(g, i, -weights[:, None] * differences)
    np.add.at(g, j, weights[:, None] * differences)
    free = np.arange(count) != root
    return np.concatenate([_solve(H, column[:, None], free, _FINAL) for column in g.T], axis=1)


def _assemble_blocks(graph: PoseGraph, ii: Array, ij: Array, jj: Array) -> csc_array:
    """Sparse symmetric matrix (N k, N k) of the edges' blocks (E, k, k), summed."""
    i, j = graph.edges.T
    k = ii.shape[-1]
    blocks = np.concatenate([ii, ij, se_n.transpose(ij), jj])
    rows = np.concatenate([i, i, j, j])[:, None, None] * k + np.arange(k)[:, None]
    columns = np.concatenate([i, j, i, j])[:, None, None] * k + np.arange(k)
    where = (np.broadcast_to(rows, blocks.shape).ravel(), np.broadcast_to(columns, blocks.shape).ravel())
    return csc_array(coo_array((blocks.ravel(), where), shape=(graph.count * k, graph.count * k)))


def _solve(H: csc_array, g: Array, free: NDArray[np.bool_], precision: float) -> Array:
    """Solution (N, k) of ``H x = g`` for the free nodes (N,), zero for the others; H is (N k, N k), positive."""
    x = np.zeros_like(g)
    if not free.any():
        return x
    each = np.repeat(free, g.shape[1])
    H = csc_array(H[each][:, each])
    solved = _solve_by_conjugate_gradients(H, g[free], precision) if H.shape[0] > _LARGE else None
    if solved is not None:
        x[free] = solved
    elif H.shape[0] <= _SMALL:
        x[free] = np.linalg.solve(H.toarray(), g[free].ravel()).reshape(-1, g.shape[1])
    else:
        # H is symmetric: its own order of elimination and pivots on the diagonal keep the factors sparse.
        factors = splu(H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0)
        x[free] = factors.solve(g[free].ravel()).reshape(-1, g.shape[1])
    return x


def _solve_by_conjugate_gradients(H: csc_array, g: Array, precision: float) -> Array | None:
    """The same; None if that does not converge soon, as in long chains, whose factors are sparse instead.

    Large graphs with many cycles are the other way round: factors fill up, and few iterations suffice.
    """
    blocks = bsr_array(H, blocksize=(g.shape[1], g.shape[1]))
    rows = np.repeat(np.arange(len(g)), np.diff(blocks.indptr))
    inverses = np.linalg.inv(blocks.data[rows == blocks.indices])
    jacobi = LinearOperator(H.shape, lambda v: (inverses @ v.reshape(*g.shape, 1)).ravel(), dtype=np.float64)
    x, missed = cg(blocks, g.ravel(), rtol=precision, maxiter=_ITERATIONS, M=jacobi)
    return None if missed else np.asarray(x.reshape(g.shape), dtype=np.float64)
