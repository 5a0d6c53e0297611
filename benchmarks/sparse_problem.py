"""The bundle's cost as a sparse least-squares problem, for solvers that know nothing of boards and sensors.

Robust weights act on whole corners, which no general solver offers. So residuals are stretched such that half
their sum of squares is the robust cost.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from calgraph.geometry import Array, Index, so3
from calgraph.geometry.se3 import relative_pose_jacobians
from calgraph.rig.bundle.bundle_solver import HUBER_THRESHOLD, Bundle, BundleState, retract_state
from calgraph.rig.bundle.observations import LinearizedResiduals, relative_poses


@dataclass(frozen=True, eq=False)
class SparseProblem:
    """A bundle without view bias and outlines, by steps (G + 6 C,) of its parameters and boards from a start."""

    bundle: Bundle
    start: BundleState

    @property
    def unknowns(self) -> int:
        """How many."""
        return self.bundle.parameter_count + 6 * len(self.start.T_root_board)

    def residuals(self, x: Array) -> Array:
        """(N,): of measurements, and of systematic parameters from their prior means."""
        threshold = HUBER_THRESHOLD
        measured = [stretched(r, J, threshold)[0].ravel() for r, J, _ in self._views(x)]
        extra = self._state(x).extra
        return np.concatenate([*measured, extra / self._prior_stddev])

    def jacobian(self, x: Array) -> csr_array:
        """(N, G + 6 C)."""
        data, columns, rows, first = [], [], [], 0
        for r, J, column in self._views(x):
            stretch = stretched(r, J, HUBER_THRESHOLD)[1].reshape(-1, J.shape[-1])
            data.append(stretch.ravel())
            columns.append(np.repeat(column, r.shape[1], axis=0).ravel())
            rows.append(np.repeat(first + np.arange(len(stretch)), J.shape[-1]))
            first += len(stretch)
        of_prior = 6 * self.bundle.body_count + np.arange(len(self._prior_stddev))
        data.append(1 / self._prior_stddev)
        columns.append(of_prior)
        rows.append(first + np.arange(len(of_prior)))
        indices = np.concatenate(rows), np.concatenate(columns)
        return csr_array((np.concatenate(data), indices), shape=(first + len(of_prior), self.unknowns))

    @property
    def _prior_stddev(self) -> Array:
        return np.array([one.prior_stddev for one in self.bundle.extra_parameters])

    def _state(self, x: Array) -> BundleState:
        steps = np.split(x, [self.bundle.parameter_count])
        return retract_state(self.bundle, self.start, steps[0], steps[1].reshape(-1, 6))

    def _views(self, x: Array) -> Iterator[tuple[Array, Array, Index]]:
        """By sensor: residuals (N, k), derivatives (N, k, 12 + e) by steps of x, and their columns (N, 12 + e)."""
        state, turns = self._state(x), _turned(x, self.bundle)
        for sensor, views in enumerate(self.bundle.views):
            T_root_board = state.T_root_board[views.board]
            T_root_sensor = np.broadcast_to(state.T_root_sensor[sensor], T_root_board.shape)
            extra = self.bundle.extra_indices(sensor)
            rows = views.linearize(relative_poses(state.T_root_sensor[sensor], T_root_board), state.extra[extra])
            view = np.repeat(np.arange(len(views.board)), np.diff(views.start, append=len(rows.residual)))
            by_relative = _by_local_parameters(rows) @ rows.local_jacobian[view]
            by_pose = np.concatenate(relative_pose_jacobians(T_root_sensor, T_root_board), axis=-1)
            J = np.concatenate([by_relative[..., :6] @ by_pose[view], by_relative[..., 6:]], axis=-1)
            moving = self.bundle.pose_columns(sensor)
            # The root's columns do not exist: zeros in those of another sensor.
            J[..., :6] *= len(moving) > 0
            of_sensor = moving if len(moving) else np.arange(6)
            of_board = self.bundle.parameter_count + 6 * views.board[:, None] + np.arange(6)
            column = np.column_stack(
                [
                    np.tile(of_sensor, (len(views.board), 1)),
                    of_board,
                    np.tile(extra + 6 * self.bundle.body_count, (len(views.board), 1)),
                ]
            )[view]
            for part in (slice(3, 6), slice(9, 12)):
                J[..., part] = J[..., part] @ turns[column[:, part.start]]
            yield rows.residual, J, column


def _by_local_parameters(rows: LinearizedResiduals) -> Array:
    """(N, k, q) derivatives by all local parameters, those of rings included."""
    N, k, q = rows.jacobian.shape
    J = np.zeros((N, k, rows.local_jacobian.shape[1]))
    J[..., :q] = rows.jacobian
    if rows.ring is not None:
        J[np.arange(N), :, q + rows.ring] = rows.jacobian[..., rows.ring_column]
    return J


def stretched(residual: Array, jacobian: Array, threshold: float) -> tuple[Array, Array]:
    """Residuals (N, k), and derivatives (N, k, p), whose squares are twice Huber's cost of their norms."""
    size = np.linalg.norm(residual, axis=1)[:, None]
    far = np.maximum(size, threshold)
    length = np.sqrt(2 * threshold * (far - threshold / 2))
    ratio = np.where(size > threshold, length / far, 1.0)
    slope = np.where(size > threshold, threshold / length, 1.0)
    unit = residual / np.maximum(size, 1e-300)
    along = np.sum(unit[..., None] * jacobian, axis=1, keepdims=True)
    return ratio * residual, ratio[..., None] * jacobian + ((slope - ratio) * unit)[..., None] * along


def _turned(x: Array, bundle: Bundle) -> Array:
    """(G + 6 C, 3, 3) by the first column of a rotation's step, how the rotation moves with it: left Jacobians."""
    turns = np.zeros((len(x), 3, 3))
    for pose in range((len(x) - len(bundle.extra_parameters)) // 6):
        first = 6 * pose + 3 + (len(bundle.extra_parameters) if pose >= bundle.body_count else 0)
        turns[first] = np.linalg.inv(so3.left_jacobian_inverse(x[first : first + 3]))
    return turns
