"""Sparse least squares over a pose graph."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, coo_array, csc_array, eye_array
from scipy.sparse.linalg import LinearOperator, cg, splu

from calgraph.geometry import Array, se_n
from calgraph.graph.pose_graph import PoseGraph, chi_squared, residuals

# Ridge relative to the mean of the diagonal of the normal equations: zero step along unobserved directions.
_RIDGE = 1e-9
# Largest component of a step (m or rad) at which the iteration has converged.
_MIN_STEP = 1e-6
# Limit on Gauss–Newton steps: three to five suffice from the poses of inliers.
_MAX_ITERATIONS = 10
# Numbers of unknowns: up to the first, dense factors are the fastest; above the second, conjugate gradients.
_MAX_DENSE, _MIN_ITERATIVE = 100, 500
# Limit on conjugate gradients: graphs that need more, as long chains do, have sparse factors instead.
_MAX_GRADIENTS = 300
# Relative residual of the linear system for a step that others follow, and for a final solution.
_STEP_TOLERANCE, _FINAL_TOLERANCE = 1e-4, 1e-10


def gauss_newton_step(graph: PoseGraph, T_root_node: Array, weights: Array) -> Array:
    """One Gauss–Newton step (N, n+d) along the root's fixed axes; zero for the root.

    Args:
        graph: connected by edges with weights.
        T_root_node: (N, n+1, n+1) where to linearise.
        weights: (E,) of the edges' squared residuals.
    """
    H, g = build_normal_equations(graph, T_root_node, weights)
    H = csc_array(H + _RIDGE * float(H.diagonal().mean()) * eye_array(H.shape[0]))
    return -solve_sparse(H, g, np.arange(graph.count) != graph.root, _STEP_TOLERANCE)


def optimize_poses(graph: PoseGraph, T_root_node: Array, weights: Array) -> Array:
    """Poses (N, n+1, n+1) of least weighted squared error, by Gauss–Newton from given start poses."""
    for _ in range(_MAX_ITERATIONS):
        delta = gauss_newton_step(graph, T_root_node, weights)
        T_root_node = se_n.retract(T_root_node, delta)
        if np.max(np.abs(delta), initial=0.0) < _MIN_STEP:
            break
    return T_root_node


# Scale of the first robust loss of a refined tree, relative to the gate of squared distances: at eight times the
# gate's distance, an edge still has a quarter of its weight. Each next scale is half of it (graduated
# non-convexity).
_FIRST_ROBUST_SCALE = 64.0
# Minimum of these scales: an edge at the gate has then a weight of 1/25.
_LAST_ROBUST_SCALE = 0.25


def optimize_poses_robustly(graph: PoseGraph, T_root_node: Array, gate: float) -> Array:
    """Poses (N, n+1, n+1) that fit the edges within the gate, from start poses along a tree.

    Graduated non-convexity: Geman–McClure losses of ever smaller scale (Yang, Antonante, Tzoumas, Carlone,
    RA-L 2020).

    Args:
        graph: connected.
        T_root_node: (N, n+1, n+1) start.
        gate: squared Mahalanobis distance of an inlier.
    """
    scale = _FIRST_ROBUST_SCALE
    while scale >= _LAST_ROBUST_SCALE:
        chi2 = chi_squared(graph, T_root_node)
        weights = np.asarray((1 + chi2 / (scale * gate)) ** -2)
        T_root_node = se_n.retract(T_root_node, gauss_newton_step(graph, T_root_node, weights))
        scale /= 2
    return T_root_node


def build_normal_equations(graph: PoseGraph, T_root_node: Array, weights: Array) -> tuple[csc_array, Array]:
    """The sparse matrix (N (n+d), N (n+d)) and the gradient (N, n+d) in the root's fixed axes.

    Args:
        graph: its edges are the residuals.
        T_root_node: (N, n+1, n+1) where to linearize.
        weights: (E,) of the edges' squared residuals.
    """
    r = residuals(graph, T_root_node)
    J = np.stack(se_n.relative_pose_jacobians(*np.swapaxes(T_root_node[graph.edges], 0, 1)), axis=1)
    WJ = (weights[:, None, None] * graph.information)[:, None] @ J
    g = np.zeros((graph.count, r.shape[-1]))
    np.add.at(g, graph.edges, np.einsum("evki,ek->evi", WJ, r))
    blocks = se_n.transpose(J)[:, :, None] @ WJ[:, None]
    k = r.shape[-1]
    rows, columns = np.repeat(graph.edges, 2, axis=1).ravel(), np.tile(graph.edges, 2).ravel()
    return csc_array(assemble_blocks(rows, columns, blocks.reshape(-1, k, k), graph.count, graph.count)), g


def assemble_blocks(
    rows: NDArray[np.intp], columns: NDArray[np.intp], blocks: Array, height: int, width: int
) -> coo_array:
    """Sparse matrix of square blocks (B, k, k) at block rows and columns (B,), summed where several coincide."""
    k = blocks.shape[-1]
    i = np.broadcast_to(rows[:, None, None] * k + np.arange(k)[:, None], blocks.shape)
    j = np.broadcast_to(columns[:, None, None] * k + np.arange(k), blocks.shape)
    return coo_array((blocks.ravel(), (i.ravel(), j.ravel())), shape=(height * k, width * k))


def solve_sparse(H: csc_array, g: Array, free: NDArray[np.bool_], tolerance: float) -> Array:
    """Solution (N, k) of ``H x = g`` for the free nodes (N,), zero for the others; H is (N k, N k), positive."""
    x = np.zeros_like(g)
    if not free.any():
        return x
    rows = np.repeat(free, g.shape[1])
    H = csc_array(H[rows][:, rows])
    solution = _solve_by_conjugate_gradients(H, g[free], tolerance) if H.shape[0] > _MIN_ITERATIVE else None
    if solution is not None:
        x[free] = solution
    elif H.shape[0] <= _MAX_DENSE:
        x[free] = np.linalg.solve(H.toarray(), g[free].ravel()).reshape(-1, g.shape[1])
    else:
        # H is symmetric: a symmetric elimination order with diagonal pivots keeps the factors sparse.
        factors = splu(H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0)
        x[free] = factors.solve(g[free].ravel()).reshape(-1, g.shape[1])
    return x


def _solve_by_conjugate_gradients(H: csc_array, g: Array, tolerance: float) -> Array | None:
    """Solution of ``H x = g``; None without convergence, as in long chains, whose factors are sparse instead.

    Large graphs with many cycles have dense factors, but need few iterations.
    """
    blocks = bsr_array(H, blocksize=(g.shape[1], g.shape[1]))
    rows = np.repeat(np.arange(len(g)), np.diff(blocks.indptr))
    inverses = np.linalg.inv(blocks.data[rows == blocks.indices])
    jacobi = LinearOperator(H.shape, lambda v: (inverses @ v.reshape(*g.shape, 1)).ravel(), dtype=np.float64)
    x, failure = cg(blocks, g.ravel(), rtol=tolerance, maxiter=_MAX_GRADIENTS, M=jacobi)
    return None if failure else np.asarray(x.reshape(g.shape), dtype=np.float64)
