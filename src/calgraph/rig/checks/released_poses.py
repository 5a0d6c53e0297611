"""What each view of a sensor contributes to a step of its pose, and the statistics of steps at all times."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array, Index, se_n
from calgraph.rig.bundle.bundle_solver import BOARD_PRIOR_INFORMATION, Bundle, BundleEquations, BundleState

# Prior information (m⁻², rad⁻²) on a step: makes directions that no view measures invertible.
_STEP_PRIOR_INFORMATION = 1.0


@dataclass(frozen=True, eq=False)
class StepStatistics:
    """Score statistics of steps in the pose of one sensor, after each of some of its views."""

    first_after: Index
    """(T,) index of the sensor's first view after the step."""
    squared: Array
    """(T,) squared Mahalanobis distance of the step from zero: χ² with six degrees of freedom without one."""
    step: Array
    """(T, 6) most likely step in the root's fixed axes."""


@dataclass(frozen=True, eq=False)
class ReleasedPose:
    """What each view of a sensor contributes to the normal equations of a step, with its board eliminated."""

    information: Array
    """(V, 6, 6) on the step,"""
    coupling: Array
    """(V, 6, G) between the step and the reduced problem's parameters,"""
    score: Array
    """(V, 6) and gradient, at the solution without a step."""
    covariance: Array
    """(G, G) of these parameters."""

    def score_steps(self, min_views: int, order: Index | None = None) -> StepStatistics:
        """The statistics of steps between at least ``min_views`` views each, for views in an order (V,)."""
        views = np.arange(len(self.score)) if order is None else order
        first_after = np.arange(min_views, len(views) - min_views + 1)
        if not len(first_after):
            return StepStatistics(first_after, np.zeros(0), np.zeros((0, 6)))
        squared, step = self._solve_steps(
            *(_sum_from(one[views])[first_after] for one in (self.information, self.coupling, self.score))
        )
        return StepStatistics(first_after, squared, step)

    def score_without_any_one(self, first_after: int) -> float:
        """The least statistic of a step if any one view counts as on its other side.

        That of a bump remains large; that of an outlier among few views does not.
        """
        after = np.arange(len(self.score)) >= first_after
        sums = (
            tuple(
                of_views[side].sum(axis=0) - of_views[side]
                for of_views in (self.information, self.coupling, self.score)
            )
            for side in (after, ~after)
        )
        return min(float(self._solve_steps(*one)[0].min()) for one in sums)

    def _solve_steps(self, information: Array, coupling: Array, score: Array) -> tuple[Array, Array]:
        """The squared Mahalanobis distances (T,) and the steps (T, 6) of sums over the views after each step."""
        information = information - coupling @ self.covariance @ se_n.transpose(coupling)
        information = (information + se_n.transpose(information)) / 2 + _STEP_PRIOR_INFORMATION * np.eye(6)
        step: Array = np.asarray(-np.linalg.solve(information, score[..., None])[..., 0], dtype=np.float64)
        return np.asarray(-np.sum(score * step, axis=-1)), step


def release_poses(
    bundle: Bundle, state: BundleState, equations: BundleEquations, weights: Sequence[Array]
) -> list[ReleasedPose]:
    """The contributions of all views to steps in the pose of every sensor, the root included.

    The pose of one sensor is released in the views after the step: the gradient by these six parameters at the
    solution without them, with all other parameters eliminated, predicts the step. A board contributes to the
    steps before it, so that sums over boards in order of time give all times together.

    Source: Rao, "Large sample tests of statistical hypotheses concerning several parameters", 1948.

    Args:
        bundle: sensors' views in order of time, without outlines.
        state: its solution.
        equations: at the solution.
        weights: (S,) of each view (V,), in [0, 1], to bound the influence of outliers.

    Returns:
        (S,) by sensor.
    """
    G, boards = bundle.parameter_count, len(state.T_root_board)
    H = np.diag(bundle.prior_weights(state.extra) * bundle.prior_stddev**-2)
    g = H.diagonal() * np.concatenate([np.zeros(6 * bundle.body_count), state.extra])
    H_board = np.tile(BOARD_PRIOR_INFORMATION * np.eye(6), (boards, 1, 1))
    board_parameters = np.zeros((boards, 6, G + 1))
    for k, (views, at, w) in enumerate(zip(bundle.views, equations.views, weights, strict=True)):
        columns, Jt, Jt_board = bundle.columns(k), se_n.transpose(at.J_sensor), se_n.transpose(at.J_board)
        A, b = w[:, None, None] * at.information, w[:, None, None] * at.gradient[..., None]
        H[np.ix_(columns, columns)] += (Jt @ A @ at.J_sensor).sum(axis=0)
        g[columns] += (Jt @ b)[..., 0].sum(axis=0)
        H_board[views.board] += Jt_board @ A @ at.J_board
        board_parameters[np.ix_(views.board, np.arange(6), columns)] += Jt_board @ A @ at.J_sensor
        board_parameters[views.board, :, -1] += (Jt_board @ b)[..., 0]
    eliminated = np.linalg.solve(H_board, board_parameters)
    rows = boards * 6
    both = board_parameters[..., :-1].reshape(rows, G).T @ eliminated.reshape(rows, G + 1)
    inverse = np.asarray(np.linalg.inv(H - both[:, :-1]), dtype=np.float64)
    estimate = -inverse @ (g - both[:, -1])
    released = []
    for k, (views, at, w) in enumerate(zip(bundle.views, equations.views, weights, strict=True)):
        T_root_sensor = np.broadcast_to(state.T_root_sensor[k], (len(views.board), 4, 4))
        by_pose, _ = se_n.relative_pose_jacobians(T_root_sensor, state.T_root_board[views.board])
        J = at.local_jacobian[..., :6] @ by_pose
        JtA = w[:, None, None] * se_n.transpose(J) @ at.information
        to_board = JtA @ at.J_board
        information = JtA @ J - to_board @ np.linalg.solve(H_board[views.board], se_n.transpose(to_board))
        coupled = -to_board @ eliminated[views.board]
        coupled[..., bundle.columns(k)] += JtA @ at.J_sensor
        coupled[..., -1] += w[:, None] * (se_n.transpose(J) @ at.gradient[..., None])[..., 0]
        score = coupled[..., -1] + coupled[..., :-1] @ estimate
        released.append(ReleasedPose(information, coupled[..., :-1], score, inverse))
    return released


def _sum_from(of_views: Array) -> Array:
    """(V, ...) sums over each view and all after it."""
    return np.asarray(np.cumsum(of_views[::-1], axis=0)[::-1])
