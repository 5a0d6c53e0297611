"""Covariances of a bundle's solution: of poses and parameters, and of what each view measures."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri

from calgraph.geometry import Array, Index, se_n
from calgraph.rig.bundle.bundle_solver import (
    BOARD_PRIOR_INFORMATION,
    Bundle,
    BundleEquations,
    BundleState,
    MarginalizedViews,
    body_jacobian,
)


def pose_jacobian(bundle: Bundle, state: BundleState) -> Array:
    """(S·6, G) derivatives of all poses, in the root's fixed axes, by the reduced problem's parameters."""
    J = np.zeros((6 * len(bundle.sensors), bundle.parameter_count))
    for s in np.flatnonzero(bundle.body > 0):
        J[6 * s : 6 * s + 6, bundle.pose_columns(int(s))] = body_jacobian(bundle, state, int(s))
    return J


def axis_jacobian(bundle: Bundle, state: BundleState) -> Array:
    """(S, 6, G) derivatives of all poses along and about the axes of their sensors."""
    to_sensor = np.array([np.kron(np.eye(2), T[:3, :3].T) for T in state.T_root_sensor])
    return np.asarray(to_sensor @ pose_jacobian(bundle, state).reshape(len(to_sensor), 6, -1))


def pose_covariance(bundle: Bundle, state: BundleState, equations: BundleEquations) -> Array:
    """Covariance (S·6, S·6) of all sensors' poses in the root's fixed axes; zero for those that are fixed."""
    J = pose_jacobian(bundle, state)
    return np.asarray(J @ equations.covariance @ J.T)


def prior_error_derivatives(bundle: Bundle, state: BundleState, equations: BundleEquations) -> Array:
    """Errors (S·6, E) of all poses by errors of the E extra parameters' stated values, in standard deviations.

    See :class:`calgraph.result.PriorErrors`.
    """
    systematic = slice(6 * bundle.body_count, None)
    of_poses = pose_jacobian(bundle, state) @ equations.covariance
    weights = bundle.prior_weights(state.extra)[systematic]
    return np.asarray(of_poses[:, systematic] * (weights / bundle.prior_stddev[systematic]))


@dataclass(frozen=True, eq=False)
class ViewFactors:
    """Factors ``F`` (V, q, G + 6) of the solution's covariance in the local parameters of one set of views.

    Of lenses with a residual distortion, q is a hundred, and G a hundred for each camera: F is not computed as a
    whole.
    """

    views: MarginalizedViews
    """With the derivatives of the local parameters."""
    of_parameters: Array
    """(n, G) factors of the covariance of the n parameters of the reduced problem that they depend on."""
    of_boards: Array
    """(V, 6, G + 6) of the boards' poses."""

    def multiply(self, M: Array) -> Array:
        """(V, m, G + 6) products ``M @ F`` with matrices (V, m, q)."""
        product = (M @ self.views.J_board) @ self.of_boards
        product[..., :-6] += (M @ self.views.J_sensor) @ self.of_parameters
        return np.asarray(product)

    @property
    def finite(self) -> NDArray[np.bool_]:
        """(V,) whether the factors of each view are finite."""
        of_views = self.views.J_sensor, self.views.J_board, self.of_boards
        return np.asarray(np.all([np.isfinite(one).all(axis=(-2, -1)) for one in of_views], axis=0))


def view_covariance_factors(
    bundle: Bundle,
    equations: BundleEquations,
    linearized: Sequence[MarginalizedViews] | None = None,
    first: int = 0,
) -> list[ViewFactors]:
    """By view set, factors ``F`` (V, q, G + 6) of the solution's covariance in the views' local parameters.

    For two views i and j of one board, also of two sensors, ``F_i @ F_j.T`` is the covariance of their errors. The
    error of a board's pose is ``e - K x``, with x that of the parameters, and e of covariance ``inv(H_board)``.

    Args:
        bundle: the views, of which some may not be part of the solution.
        equations: at the solution.
        linearized: of the bundle's views; those of the solution if left out.
        first: index of the first view set; those before it are left out.
    """
    H, _, K = equations.eliminate_boards()
    # H is regular by its priors. The inverse of a triangle takes a sixth of that of a matrix.
    root = dtrtri(np.linalg.cholesky(H), lower=1)[0].T
    board_root = _inverse_root(equations.H_board + BOARD_PRIOR_INFORMATION * np.eye(6))
    C, size = len(K), len(root)
    by_parameters = (K[..., :-1].reshape(-1, size) @ root).reshape(C, 6, size)
    of_boards = np.concatenate([-by_parameters, board_root], axis=-1)
    return [
        ViewFactors(at, root[bundle.columns(k)], of_boards[bundle.all_views[k].board])
        for k, at in enumerate((linearized or equations.views)[first:], start=first)
    ]


def _inverse_root(A: Array) -> Array:
    """``R`` (..., n, n) with ``R @ R.T`` the inverse of positive definite A, which may be almost singular."""
    values, vectors = np.linalg.eigh(A)
    least = np.finfo(float).eps * values[..., -1:]
    return np.asarray(vectors / np.sqrt(np.maximum(values, least))[..., None, :])


@dataclass(frozen=True, eq=False)
class BoardInformation:
    """Information of one board's views on the parameters that they depend on, the board's pose eliminated."""

    columns: Index
    """(n,) these parameters, of the G of the reduced problem: those of the sensors that detect the board."""
    information: Array
    """(n, n)."""


def information_by_board(bundle: Bundle, equations: BundleEquations) -> Iterator[BoardInformation]:
    """Of each of the C boards in turn; the reduced matrix is their sum and that of the priors.

    One after the other: matrices (C, G, G) of twenty cameras with residual distortions would take 18 GB.
    """
    columns = [bundle.columns(k) for k in range(len(bundle.all_views))]
    derivatives = [at.J_sensor for at in equations.views]
    views_of: list[list[tuple[int, int]]] = [[] for _ in equations.H_board]
    for k, views in enumerate(bundle.all_views):
        for v, board in enumerate(views.board.tolist()):
            views_of[board].append((k, v))
    K = np.linalg.solve(equations.H_board + BOARD_PRIOR_INFORMATION * np.eye(6), equations.H_board_sensor)
    for board, views_of_board in enumerate(views_of):
        depends = np.zeros(bundle.parameter_count, dtype=np.bool_)
        for k, _ in views_of_board:
            depends[columns[k]] = True
        some = np.flatnonzero(depends)
        H = -equations.H_board_sensor[board][:, some].T @ K[board][:, some]
        for k, v in views_of_board:
            J, place = derivatives[k][v], np.searchsorted(some, columns[k])
            H[np.ix_(place, place)] += J.T @ equations.views[k].information[v] @ J
        yield BoardInformation(some, H)


def sum_information(bundle: Bundle, equations: BundleEquations, weights: Array) -> Array:
    """(W, G, G) sums of the information of boards with W weights (W, C)."""
    H = np.zeros((len(weights), bundle.parameter_count, bundle.parameter_count))
    for of_board, one in zip(weights.T, information_by_board(bundle, equations), strict=True):
        for w in np.flatnonzero(of_board):
            H[w][np.ix_(one.columns, one.columns)] += of_board[w] * one.information
    return H


def gradient_by_board(bundle: Bundle, equations: BundleEquations) -> Array:
    """(C, G) gradient of the cost of each board's views by the parameters, the board's pose eliminated.

    The reduced gradient is their sum and that of the priors.
    """
    g = np.zeros((len(equations.H_board), bundle.parameter_count))
    for k, (views, at) in enumerate(zip(bundle.all_views, equations.views, strict=True)):
        J = se_n.transpose(at.J_sensor)
        g[np.ix_(views.board, bundle.columns(k))] += (J @ at.gradient[..., None])[..., 0]
    H_board = equations.H_board + BOARD_PRIOR_INFORMATION * np.eye(6)
    step = np.linalg.solve(H_board, equations.g_board[..., None])
    return np.asarray(g - (se_n.transpose(equations.H_board_sensor) @ step)[..., 0])
