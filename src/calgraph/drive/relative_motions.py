"""Relative motions that another program or a gyroscope measured, against the trajectory of the root.

For the motion ``M`` of a sensor between two times and ``D = (W(t₀-o) T)⁻¹ W(t₁-o) T`` of the trajectory ``W``,

    e = ((1 + s) t_D - t_M,  log(R_D R_Mᵀ) + s_r log R_D) + (t₁ - t₀) b + u d_j

in units of the measured motions, or noise would shrink with a scale. ``s`` and ``s_r`` are errors of scale (of
wheels, or of each axis of a gyroscope), ``b`` is the bias of a gyroscope, and ``d_j`` the drift per size ``u`` of
the motion, which is constant for some seconds: errors of odometry persist. What remains is nearly independent and
heavy-tailed (slip).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array, hstack, vstack

from calgraph.drive.measurements import MAX_VARIANCES, LinearRows, VarianceOf, place_sensor, sparse_rows
from calgraph.geometry import Array, Index, se_n, so3
from calgraph.surfaces.sensor_states import SensorState
from calgraph.surfaces.trajectory import SplineTrajectory

# Degrees of freedom of Student's t for errors: wheels slip, trackers lose features.
_FREEDOM = 4.0
# Prior standard deviations: of the circumference of wheels, or the scale of a tracker with one camera; of turns by
# the distance of wheels; of the bias of a gyroscope, rad/s, and of the scale of each of its axes. Data sheets of
# cheap ones state up to 5 °/s and 1 %.
_PATH_SCALE, _TURN_SCALE, _BIAS, _RATE_SCALE = 0.03, 0.03, 0.1, 0.005
# Start values, and least ones, of the standard deviations of motions over a tenth of a second, m and rad, and of
# drifts per size: per mille to per cent of the way. Encoders and optical gyroscopes do not resolve less.
_START_NOISE, _LEAST_NOISE = (0.003, 0.002), (1e-5, 1e-6)
_START_DRIFT = 0.005, 0.002
# Number of drifts for which the start value of their standard deviation counts.
_START_WEIGHT = 4.0
# Time for which the drift is constant, s, and over which its correlation falls to 1/e: slopes, tyres and views of
# features change within some seconds.
_DRIFT_TIME, _CORRELATION_TIME = 2.5, 5.0
_CORRELATION = float(np.exp(-_DRIFT_TIME / _CORRELATION_TIME))
# Metres for which a turn of 1 rad counts in the size of a motion: half the track of a robot.
_ARM = 0.3


@dataclass(frozen=True, eq=False)
class RelativeMotions:
    """Motions of one sensor over K intervals of its clock: :class:`calgraph.drive.measurements.Measurements`."""

    sensor: int
    """Its number."""
    starts: Array
    """(K,) s."""
    ends: Array
    """(K,) s."""
    motions: Array
    """(K, n+1, n+1) ``T_start_end``."""
    axes: Index
    """(A,) those of the n + d components of motions that are measured."""
    sizes: Array
    """(K,) by which drifts are multiplied: metres, or seconds of a gyroscope."""
    block: Index
    """(K,) number of the interval in which the drift is constant."""
    priors: Array
    """(F,) standard deviations of the unknowns that do not change: biases and scales."""
    groups: Index
    """(A,) which axes have one standard deviation of drifts."""
    noise: Array
    """(A,) standard deviation of motions, m and rad."""
    drift: Array
    """(A,) standard deviation of drifts, m and rad per size."""
    unknowns: Array
    """(E,) the F constants, then A drifts of each block."""
    undetermined: Array
    """(n + d,) unit vector of a change of the pose that the motions do not determine, or 0: noise of the
    trajectory would seem to determine it."""

    @property
    def unknown_count(self) -> int:
        """E."""
        return len(self.unknowns)

    def linearize(self, trajectory: SplineTrajectory, states: Sequence[SensorState], shared: Array) -> LinearRows:
        """The A K errors, axis by axis, then the E unknowns against their priors."""
        errors, by_control, by_sensor, design = self.evaluate(trajectory, states[self.sensor])
        residual = errors.T / self.noise[:, None]
        scale = np.ravel(np.sqrt((_FREEDOM + 1) / (_FREEDOM + residual**2)) / self.noise[:, None])
        prior, (columns, size) = self._prior_rows(), (trajectory.control.shape[1], trajectory.control.size)

        def by_axis(J: Array) -> Array:
            return np.asarray(J.swapaxes(0, 1).reshape(len(scale), -1) * scale[:, None])

        ends = [
            sparse_rows(by_axis(J)[:, None], columns * np.tile(first, len(self.axes)), size)
            for first, J in by_control
        ]
        own = np.concatenate([by_axis(design), prior])
        # The unknowns belong to no time.
        time = np.full(len(own), trajectory.start)
        time[: len(scale)] = np.tile(
            (self.starts + self.ends) / 2 - states[self.sensor].clock_offset, len(self.axes)
        )
        return LinearRows(
            np.concatenate([errors.T.ravel() * scale, prior @ self.unknowns]),
            np.full(len(own), self.sensor),
            time,
            csr_array(vstack([sum(ends), csr_array((len(prior), size))])),
            np.pad(by_axis(by_sensor), ((0, len(prior)), (0, 0))),
            csr_array(own),
            np.zeros((len(own), len(shared))),
        )

    def moved(self, step: Array) -> "RelativeMotions":
        """See :class:`calgraph.drive.measurements.Measurements`."""
        return replace(self, unknowns=self.unknowns + step)

    def reweighted(
        self, trajectory: SplineTrajectory, states: Sequence[SensorState], shared: Array, variance_of: VarianceOf
    ) -> "RelativeMotions":
        """Standard deviations from weighted residuals and the variances that remain of them (EM)."""
        rows = self.linearize(trajectory, states, shared)
        A, K, M = len(self.axes), len(self.starts), len(rows.residual)
        # Those of the unknowns, which are last, are not nearly equal.
        chosen = np.union1d(np.arange(0, M, max(M // MAX_VARIANCES, 1)), np.arange(A * K, M))
        variance = variance_of(csr_array(hstack([rows.by_control[chosen], rows.by_unknown[chosen]])))
        expected = rows.residual**2 + variance[np.searchsorted(chosen, np.arange(M), side="right") - 1]
        of_noise = expected[: A * K].reshape(A, K).mean(axis=1)
        # A few drifts of one axis do not determine their spread.
        drifts = expected[A * K + len(self.priors) :].reshape(-1, A) * self.drift**2
        start = _by_axis(_START_DRIFT, self.axes, self._n) ** 2
        same = self.groups[:, None] == self.groups
        of_drift = (same @ drifts.sum(axis=0) + _START_WEIGHT * start) / (
            same.sum(axis=1) * len(drifts) + _START_WEIGHT
        )
        return replace(
            self,
            noise=np.maximum(self.noise * np.sqrt(of_noise), _by_axis(_LEAST_NOISE, self.axes, self._n)),
            drift=np.sqrt(of_drift),
        )

    @property
    def _is_gyroscope(self) -> bool:
        return bool(self.axes.min() >= self._n)

    @property
    def _n(self) -> int:
        return int(self.motions.shape[-1]) - 1

    @property
    def _scaled(self) -> Array:
        """(S, A) 1 where an error of scale concerns an axis."""
        if self._is_gyroscope:
            return np.eye(len(self.axes))
        moves = (self.axes < self._n).astype(np.float64)
        return np.array([moves, 1 - moves][: len(self.priors)])

    def _design(self, predicted: Array) -> Array:
        """(K, A, E) derivatives of the errors by the unknowns, of predicted motions (K, A)."""
        (K, A), F = predicted.shape, len(self.priors)
        design = np.zeros((K, A, len(self.unknowns)))
        design[:, :, F - len(self._scaled) : F] = (predicted[:, None, :] * self._scaled).swapaxes(1, 2)
        if self._is_gyroscope:
            design[:, :, :A] = np.eye(A) * (self.ends - self.starts)[:, None, None]
        for a in range(A):
            design[np.arange(K), a, F + self.block * A + a] = self.sizes
        return design

    def _prior_rows(self) -> Array:
        """(E, E) the unknowns against their priors: each drift, but the first, against the one before."""
        F, A = len(self.priors), len(self.drift)
        blocks = (len(self.unknowns) - F) // A
        rows = np.diag(np.concatenate([1 / self.priors, np.tile(1 / self.drift, blocks)]))
        later, before = np.arange(F + A, len(rows)), np.arange(F, len(rows) - A)
        rows[later, before] = -_CORRELATION * rows[later, later]
        rows[later] /= np.sqrt(1 - _CORRELATION**2)
        return rows

    def evaluate(
        self, trajectory: SplineTrajectory, state: SensorState
    ) -> tuple[Array, tuple[tuple[Index, Array], ...], Array, Array]:
        """Errors (K, A), their derivatives by the control points at both ends, by state and by unknowns.

        The last are (K, A, n + d + 6) and (K, A, E). The derivatives at an end are the first control point
        (K,) and (K, A, 4 (n + d)).
        """
        n = self._n
        before, after = (
            place_sensor(trajectory, times - state.clock_offset, state.T_root_sensor)
            for times in (self.starts, self.ends)
        )
        moved = se_n.inverse(before.poses) @ after.poses
        difference, whole = (se_n.difference(moved, one) for one in (self.motions, np.eye(n + 1)))
        design = self._design(whole[:, self.axes])
        F = len(self.priors)
        scales = self.unknowns[F - len(self._scaled) : F] @ self._scaled
        by_motion = _by_pose(difference)[:, self.axes] + scales[:, None] * _by_pose(whole)[:, self.axes]
        ends = [by_motion @ J for J in se_n.relative_pose_jacobians(before.poses, after.poses)]
        by_state = ends[0] @ before.by_state + ends[1] @ after.by_state
        u = self.undetermined
        by_state[:, :, : len(u)] -= (by_state[:, :, : len(u)] @ u)[:, :, None] * u
        by_control = ((before.first, ends[0] @ before.by_control), (after.first, ends[1] @ after.by_control))
        return difference[:, self.axes] + design @ self.unknowns, by_control, by_state, design


def _by_pose(difference: Array) -> Array:
    """(K, n + d, n + d) derivatives of differences (K, n + d) of poses by the first ones."""
    J = np.zeros((len(difference), *[difference.shape[1]] * 2)) + np.eye(difference.shape[1])
    if difference.shape[1] == 6:
        J[:, 3:, 3:] = so3.left_jacobian_inverse(difference[:, 3:])
    return J


def _by_axis(values: tuple[float, float], axes: Index, n: int) -> Array:
    """(A,) of a value of translations and one of rotations."""
    return np.where(axes < n, *values)


def gather_motions(
    sensor: int, starts: Array, ends: Array, motions: Array, axes: Index, undetermined: Array, *, wheels: bool
) -> RelativeMotions:
    """The motions of a trajectory over intervals, with start values of their noise.

    Args:
        sensor: its number.
        starts: (K,) of the intervals, s.
        ends: (K,).
        motions: (K, n+1, n+1).
        axes: (A,) those of the components that are measured; without translations, of a gyroscope.
        undetermined: (n + d,) see :class:`RelativeMotions`.
        wheels: whether turns have an error of scale, too.
    """
    n = motions.shape[-1] - 1
    t, turn = se_n.translation(motions), se_n.log(se_n.rotation(motions))
    A = len(axes)
    if axes.min() >= n:
        sizes, priors = ends - starts, np.repeat([_BIAS, _RATE_SCALE], A)
    else:
        sizes = np.linalg.norm(t, axis=1) + _ARM * np.linalg.norm(turn, axis=1)
        priors = np.array([_PATH_SCALE, _TURN_SCALE] if wheels else [_PATH_SCALE])
    # Wheels do not measure height, roll and pitch, which are 0 on a plane, and slip ahead more than they turn.
    groups = np.where(axes < n, 0, 1)
    if wheels and n == 3:
        groups = np.array([0, 0, 2, 3, 3, 1])[axes]
    count = max(round((ends[-1] - starts[0]) / _DRIFT_TIME), 1)
    block = np.minimum((count * (starts - starts[0]) / (ends[-1] - starts[0])).astype(np.intp), count - 1)
    return RelativeMotions(
        sensor, starts, ends, motions, axes, sizes, block, priors, groups,
        _by_axis(_START_NOISE, axes, n), _by_axis(_START_DRIFT, axes, n), np.zeros(len(priors) + count * A),
        undetermined,
    )  # fmt: skip
