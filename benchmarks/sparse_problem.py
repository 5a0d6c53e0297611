"""The bundle's cost as a sparse least-squares problem, for solvers that know nothing of boards and sensors.

Robust weights act on whole corners, which no general solver offers. So residuals are stretched such that half
their sum of squares is the robust cost.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from calgraph.estimation.rig.bundle_solver import Bundle, BundleState, retract_state
from calgraph.estimation.rig.observations import relative_poses
from calgraph.geometry import Array, Index, so3
from calgraph.geometry.se3 import relative_pose_jacobians


@dataclass(frozen=True, eq=False)
class SparseProblem:
    """A bundle without sway and own unknowns, by steps (G + 6 C,) of sensors and boards from a start."""

    bundle: Bundle
    start: BundleState

    @property
    def unknowns(self) -> int:
        """How many."""
        return self.bundle.parameter_count + 6 * len(self.start.T_root_board)

    def residuals(self, x: Array) -> Array:
        """(N,)."""
        threshold = self.bundle.settings.huber_threshold
        return np.concatenate([stretched(r, J, threshold)[0].ravel() for r, J, _, _ in self._views(x)])

    def jacobian(self, x: Array) -> csr_array:
        """(N, G + 6 C)."""
        turns = _turned(x)
        data, columns = [], []
        for r, J, sensor, board in self._views(x):
            stretch = stretched(r, J, self.bundle.settings.huber_threshold)[1].reshape(-1, J.shape[-1])
            moving = self.bundle.pose_columns(sensor)
            # The root's columns do not exist: zeros in those of another sensor.
            stretch[:, :6] *= len(moving) > 0
            own = np.broadcast_to(moving if len(moving) else np.arange(6), (len(r), 6))
            of_board = self.bundle.parameter_count + 6 * board[:, None] + np.arange(6)
            column = np.repeat(np.concatenate([own, of_board], axis=1), r.shape[1], axis=0)
            for part in (slice(3, 6), slice(9, 12)):
                turn = turns[column[:, part.start] // 3]
                stretch[:, part] = (stretch[:, None, part] @ turn)[:, 0]
            data.append(stretch)
            columns.append(column)
        values, indices = np.concatenate(data), np.concatenate(columns)
        rows = 12 * np.arange(len(values) + 1)
        return csr_array((values.ravel(), indices.ravel(), rows), shape=(len(values), self.unknowns))

    def _views(self, x: Array) -> Iterator[tuple[Array, Array, int, Index]]:
        """By sensor: residuals (N, k), derivatives (N, k, 12) by sensor and board, the sensor, and boards (N,)."""
        steps = np.split(x, [self.bundle.parameter_count])
        state = retract_state(self.bundle, self.start, steps[0], steps[1].reshape(-1, 6))
        for sensor, views in enumerate(self.bundle.views):
            T_root_board = state.T_root_board[views.board]
            T_root_sensor = np.broadcast_to(state.T_root_sensor[sensor], T_root_board.shape)
            rows = views.linearize(relative_poses(state.T_root_sensor[sensor], T_root_board), state.extra[:0])
            by_pose = np.concatenate(relative_pose_jacobians(T_root_sensor, T_root_board), axis=-1)
            view = np.repeat(np.arange(len(views.board)), np.diff(views.start, append=len(rows.residual)))
            yield rows.residual, rows.jacobian @ (rows.local_jacobian @ by_pose)[view], sensor, views.board[view]


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


def _turned(x: Array) -> Array:
    """How rotations move with steps: left Jacobians (2 n, 3, 3), at odd places, of n poses' rotation steps."""
    steps = x.reshape(-1, 3)
    return np.asarray(np.linalg.inv(so3.left_jacobian_inverse(steps)))
