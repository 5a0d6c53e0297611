"""The joint solution: trajectory, surfaces, poses, clocks and range errors of all sensors of a drive.

For each measured point k of sensor i on surface j,

    r = n_j · (T_wr(t_k - o_i) T_ri ((1 - s_i) ρ_k - β_i) u_k - c_j) - (1, u, v) · (f_j + b_ij)

with the trajectory ``T_wr`` a spline, the flat patch ``f_j`` of a cell (offset and slopes), and the view bias
``b_ij``, by which the patch that one sensor measures differs from that of the others: surfaces are not planes, and
ranges depend on incidence. View biases and surfaces are eliminated by group and cell, then the trajectory of each
part of the drive; what remains are the errors of the sensors. A solution can be given another root.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array, hstack

from calgraph.drive.measurements import DrivePart
from calgraph.drive.points_on_surfaces import (
    Association,
    associate_points,
    collect_points,
    linearize_points,
    locate_points,
)
from calgraph.drive.stated_poses import StatedPose
from calgraph.geometry import Array, Index, se_n
from calgraph.solver.change_tests import PeriodEquations
from calgraph.solver.clustered_covariance import ClusteredScores, label_rings, widen_covariance
from calgraph.surfaces.map_agreement import measure_agreement
from calgraph.surfaces.sensor_states import SensorState, measure_deviations, move_states, number_free
from calgraph.surfaces.surface_elimination import NoiseModel, SurfaceEquations, eliminate_surfaces
from calgraph.surfaces.trajectory import SplineTrajectory
from calgraph.verdict.state_changes import PERIOD, Change, find_changes


@dataclass(frozen=True)
class AdjustmentPriors:
    """Standard deviations of what is known before, by sensor."""

    stddev: Array
    """(S, n + d + 6) in the order of :meth:`SensorState.moved`; 0 of what is fixed, as are pose and clock of
    the root."""
    shared: Array = field(default_factory=lambda: np.zeros(0))
    """(G,) of the unknowns that measurements of all parts share."""
    poses: Mapping[int, StatedPose] = field(default_factory=dict)
    """Of sensors, by number, whose poses are stated."""


@dataclass(frozen=True, eq=False)
class Adjustment:
    """The joint solution."""

    states: Sequence[SensorState]
    parts: Sequence[DrivePart]
    covariance: Array
    """(P, P) of the parameters (S, n + d + 6) that are free, in their order."""
    independent_covariance: Array
    """(P, P) that it would be if the errors of all views were independent."""
    free: NDArray[np.bool_]
    """(S, n + d + 6): which these are."""
    noise: NoiseModel
    """Of the points on surfaces."""
    agreement: Array
    """(S, S) of the maps of two sensors; see :func:`measure_agreement`."""
    point_counts: Array
    """(S,) number of these."""
    squared_step: float
    """Squared last step of the sensors' parameters, in their standard deviations."""
    shared: Array = field(default_factory=lambda: np.zeros(0))
    """(G,) the unknowns that measurements of all parts share,"""
    shared_stddev: Array = field(default_factory=lambda: np.zeros(0))
    """(G,) and their standard deviations."""
    associations: Sequence[Association] = ()
    """By part, the points on surfaces of the last steps."""
    changes: Sequence[Change] = ()
    """Of poses and clocks during the drive, by number of the sensors that were solved for."""
    responses: Sequence[Array] = ()
    """By part, (C', P) change of its unknowns, the control points first, with the free parameters."""

    @property
    def stddev(self) -> Array:
        """(S, n + d + 6) of all parameters; 0 of those that are fixed."""
        stddev = np.zeros(self.free.shape)
        stddev[self.free] = np.sqrt(np.diag(self.covariance))
        return stddev


# Distances from a surface within which points are of it, m, by iteration: from errors of the start to noise.
_GATES = (0.3, 0.2, 0.15, 0.12, 0.1, *[0.09] * 8)
# Iteration from which noise of measurements is estimated again in each, with variances of the trajectory: start
# values have converged.
_REWEIGHTED = 4
# Last steps, on surfaces and points that stay the same: the squared step falls below 0.1 on real scans.
_FIXED_STEPS = 6
# Accelerations of a robot's motion, m/s² and rad/s², which bind the spline where nothing is measured.
_ACCELERATION, _TURN_ACCELERATION = 5.0, 10.0
# Standard deviation with which the middle control point is held, m and rad: it only fixes the world, which
# the poses of sensors do not depend on.
_GAUGE = 1e-3


def adjust_drive(
    parts: Sequence[DrivePart],
    states: Sequence[SensorState],
    priors: AdjustmentPriors,
    progress: Callable[[float], None] = lambda _: None,
) -> Adjustment:
    """Solves for all sensors, surfaces and the trajectory jointly, by Gauss–Newton with surfaces found again.

    Args:
        parts: of the drive.
        states: start values by sensor; the first is the root.
        priors: of these.
        progress: called with the fraction done.
    """
    free = priors.stddev > 0
    start = states
    noise = NoiseModel.at_start(len(states))
    parts = list(parts)
    reduced: list[_Reduced] = []
    count, shared = int(free.sum()), np.zeros(len(priors.shared))
    step: Array = np.zeros(count + len(shared))
    H: Array = np.eye(len(step), dtype=np.float64)
    associations: list[Association] = []
    for k, gate in enumerate(_GATES):
        # The last steps are on the same surfaces, so that they converge.
        if k < len(_GATES) - _FIXED_STEPS:
            associations = [associate_points(part, states, gate) for part in parts]
        # Its memory, half of all, is free for that of the next ones.
        reduced.clear()
        reduced = [
            _reduce_part(part, states, noise, association, free, shared)
            for part, association in zip(parts, associations, strict=True)
        ]
        information, gradient = _add_priors(priors, states, start, shared)
        H = sum((one.information for one in reduced), np.diag(information))
        g = sum((one.gradient for one in reduced), gradient)
        _add_stated_poses(H, g, states, priors.poses, free)
        step = -np.asarray(np.linalg.solve(H, g), dtype=np.float64)
        shared = shared + step[count:]
        states = move_states(states, free, step[:count])
        parts = [_move_part(part, one.back_substitute(step)) for part, one in zip(parts, reduced, strict=True)]
        if k >= _REWEIGHTED:
            # After the step: residuals and variances of different weights lead to a cycle of noise that grows.
            parts = [_reweight_part(part, one, states, shared) for part, one in zip(parts, reduced, strict=True)]
        noise = noise.estimated_again([one.surfaces for one in reduced])
        progress((k + 1) / len(_GATES))
    covariance = np.asarray(np.linalg.inv(H), dtype=np.float64)
    equations, ends = _release_periods(parts, states, noise, associations, priors, start, shared)
    places: Array = np.array([se_n.translation(state.T_root_sensor) for state in states])
    widened = widen_covariance(covariance, [one.cluster_scores(count) for one in reduced])
    return Adjustment(
        states, parts, widened[:count, :count], covariance[:count, :count], free, noise,
        agreement=measure_agreement([locate_points(part, states) for part in parts]),
        point_counts=np.sum([one.surfaces.white[:, 1] for one in reduced], axis=0),
        squared_step=float(step @ H @ step),
        associations=associations,
        responses=[one.response()[:, :count] for one in reduced],
        shared=shared,
        shared_stddev=np.sqrt(np.diag(widened)[count:]),
        changes=find_changes(equations, free, ends, places),
    )  # fmt: skip


def _add_stated_poses(
    H: Array, g: Array, states: Sequence[SensorState], poses: Mapping[int, StatedPose], free: NDArray[np.bool_]
) -> None:
    """Adds errors of states from stated poses, of the axes that are estimated, in place."""
    columns = number_free(free)
    for k, stated in poses.items():
        error = se_n.difference(states[k].T_root_sensor, stated.T)
        axes = np.flatnonzero(free[k, : len(error)])
        information = np.linalg.inv(stated.covariance[np.ix_(axes, axes)])
        H[np.ix_(columns[k, axes], columns[k, axes])] += information
        g[columns[k, axes]] += information @ error[axes]


def _add_priors(
    priors: AdjustmentPriors, states: Sequence[SensorState], start: Sequence[SensorState], shared: Array
) -> tuple[Array, Array]:
    """Information (P + G,) of priors but stated poses, and the gradient by the deviations from the start."""
    free = priors.stddev > 0
    information = np.concatenate([priors.stddev[free], priors.shared]) ** -2.0
    return information, information * np.concatenate([measure_deviations(states, start)[free], shared])


def _number_periods(part: DrivePart, times: Array, periods: int) -> Index:
    """(N,) the period of each time; what is left of the last one belongs to it."""
    return np.clip((times - part.trajectory.start) // PERIOD, 0, periods - 1).astype(np.intp)


def _release_periods(
    parts: Sequence[DrivePart],
    states: Sequence[SensorState],
    noise: NoiseModel,
    associations: Sequence[Association],
    priors: AdjustmentPriors,
    start: Sequence[SensorState],
    shared: Array,
) -> tuple[PeriodEquations, Array]:
    """The equations with a state of each sensor in each period of all parts, and the ends (K,) of these, s."""
    free = priors.stddev > 0
    counts = [max(int((part.trajectory.end - part.trajectory.start) // PERIOD), 1) for part in parts]
    sensor, period, column = np.nonzero(np.repeat(free[:, None], sum(counts), axis=1))
    own, P, G = len(period), int(free.sum()), len(shared)
    H, g = np.zeros((own + G,) * 2), np.zeros(own + G)
    first = 0
    for part, association, count in zip(parts, associations, counts, strict=True):
        reduced = _reduce_part(part, states, noise, association, free, shared, count)
        rows = np.append(np.flatnonzero((period >= first) & (period < first + count)), np.arange(own, own + G))
        H[np.ix_(rows, rows)] += reduced.information
        g[rows] += reduced.gradient
        first += count
    same = np.append(number_free(free)[sensor, column], np.arange(P, P + G))
    prior = _add_priors(priors, states, start, shared)
    equations = PeriodEquations(H, g, np.append(period, np.full(G, -1)), np.eye(P + G)[same], *prior)
    ends = [
        part.trajectory.start + PERIOD * np.arange(1, count + 1) for part, count in zip(parts, counts, strict=True)
    ]
    return equations, np.concatenate(ends)


@dataclass(frozen=True, eq=False)
class _Reduced:
    """A part of the drive, with surfaces and trajectory eliminated."""

    information: Array
    """(P, P) of the free parameters of sensors."""
    gradient: Array
    """(P,)."""
    factor: tuple[Array, bool]
    """Cholesky factor of the information of the part's C' unknowns: control points, then those of measurements."""
    with_sensors: Array
    """(C', P) information between these and the parameters."""
    part_gradient: Array
    """(C',)."""
    surfaces: SurfaceEquations
    """With statistics of the noise."""
    time: Array
    """(N,) of the points on surfaces, s."""
    place: Array
    """(N, n) of these surfaces, m."""
    ring: Index
    """(N,) of these points, as of :func:`label_rings`."""
    control_size: int
    """Number C of unknowns of the trajectory, which are the first."""

    def response(self) -> Array:
        """(C', P) the change of the part's unknowns with the sensors' parameters."""
        return -np.asarray(cho_solve(self.factor, self.with_sensors), dtype=np.float64)

    def back_substitute(self, step: Array) -> Array:
        """(C',) the change of the part's unknowns that goes with a step of the sensors."""
        change = -cho_solve(self.factor, self.part_gradient + self.with_sensors @ step)
        return np.asarray(change, dtype=np.float64)

    def cluster_scores(self, count: int) -> ClusteredScores:
        """What points contribute to the gradient, first by the parameters of sensors; the trajectory follows."""
        follow = self.response()[: self.control_size]
        along = np.concatenate([follow, np.eye(count, follow.shape[1])])
        return ClusteredScores(self.surfaces.scores.along(along), self.time, self.place, self.ring)


def _move_part(part: DrivePart, change: Array) -> DrivePart:
    """The part with its unknowns changed."""
    size = part.trajectory.control.size
    edges = np.cumsum([size, *(one.unknown_count for one in part.measurements)])
    return replace(
        part,
        trajectory=part.trajectory.moved(change[:size].reshape(part.trajectory.control.shape)),
        measurements=[
            one.moved(some) for one, some in zip(part.measurements, np.split(change, edges)[1:-1], strict=True)
        ],
    )


def _reweight_part(part: DrivePart, reduced: _Reduced, states: Sequence[SensorState], shared: Array) -> DrivePart:
    """The part with measurements whose noise is estimated again."""
    control = np.arange(part.trajectory.control.size)
    first, found = len(control), []
    for one in part.measurements:
        columns = np.concatenate([control, first + np.arange(one.unknown_count)])
        variance_of = partial(_find_variances, reduced.factor, columns)
        found.append(one.reweighted(part.trajectory, states, shared, variance_of))
        first += one.unknown_count
    return replace(part, measurements=found)


def _find_variances(factor: tuple[Array, bool], columns: Index, J: csr_array) -> Array:
    """(M,) of linear functions (M, K) of some of the unknowns with the Cholesky factor of their information."""
    wide = np.zeros((len(factor[0]), J.shape[0]))
    wide[columns] = J.toarray().T
    return np.asarray(np.sum(wide * cho_solve(factor, wide, check_finite=False), axis=0))


def _reduce_part(
    part: DrivePart,
    states: Sequence[SensorState],
    noise: NoiseModel,
    association: Association,
    free: NDArray[np.bool_],
    shared: Array,
    periods: int = 1,
) -> _Reduced:
    """The normal equations of the sensors' free parameters and what parts share, at the present states.

    With several periods, each sensor has parameters of its own in each of them: (S, periods) of its free ones.
    """
    at = linearize_points(part, states, association)
    ring = label_rings(at.sensor, collect_points(part, states, association))
    free = np.repeat(free, periods, axis=0)
    at = replace(at, sensor=at.sensor * periods + _number_periods(part, at.time, periods))
    noise = replace(noise, white=np.repeat(noise.white, periods))
    control = part.trajectory.control
    on_surfaces = eliminate_surfaces(at, len(association.surfaces.keys), noise, free, len(control))
    # Control points, unknowns of measurements, parameters of sensors, and what parts share.
    C = control.size + sum(one.unknown_count for one in part.measurements)
    first_shared = C + int(free.sum())
    H, g = np.zeros((first_shared + len(shared),) * 2), np.zeros(first_shared + len(shared))
    known = np.r_[0 : control.size, C:first_shared]
    H[np.ix_(known, known)], g[known] = on_surfaces.information, on_surfaces.gradient
    _add_motion_prior(H, g, part.trajectory, None if part.size is None else first_shared + part.size)
    _add_measurements(H, g, part, states, free, shared, periods)
    H_c, H_cp, H_p = H[:C, :C], H[:C, C:], H[C:, C:]
    factor = cho_factor(H_c, lower=True, check_finite=False)
    eliminated = cho_solve(factor, np.column_stack([H_cp, g[:C]]), check_finite=False)
    return _Reduced(
        H_p - H_cp.T @ eliminated[:, :-1],
        g[C:] - H_cp.T @ eliminated[:, -1],
        factor, H_cp, g[:C], on_surfaces, at.time, association.surfaces.center[at.surface],
        ring, control.size,
    )  # fmt: skip


def _add_measurements(
    H: Array,
    g: Array,
    part: DrivePart,
    states: Sequence[SensorState],
    free: NDArray[np.bool_],
    shared: Array,
    periods: int,
) -> None:
    """Adds measurements of the trajectory, whose unknowns follow the control points."""
    first = size = part.trajectory.control.size
    for one in part.measurements:
        rows = one.linearize(part.trajectory, states, shared)
        by_sensor = np.zeros((len(rows.residual), *free.shape))
        column = rows.sensor * periods + _number_periods(part, rows.time, periods)
        by_sensor[np.arange(len(column)), column] = rows.by_sensor
        J = hstack(
            [rows.by_control, rows.by_unknown, csr_array(by_sensor[:, free]), csr_array(rows.by_shared)]
        ).tocsr()
        after = first + one.unknown_count
        columns = np.r_[0:size, first:after, len(g) - (J.shape[1] - size - one.unknown_count) : len(g)]
        square = (J.T @ J).tocoo()
        H[columns[square.row], columns[square.col]] += square.data
        g[columns] += J.T @ rows.residual
        first = after


def _add_motion_prior(H: Array, g: Array, trajectory: SplineTrajectory, size: int | None = None) -> None:
    """Adds what is known of accelerations, and holds the middle control point.

    In a world whose relative size is one of the unknowns, accelerations are relative to it: noise of trajectories
    would else make the world smaller.
    """
    control = trajectory.control
    K, columns = control.shape
    n = trajectory.reference.poses.shape[-1] - 1
    stddev = np.repeat([_ACCELERATION, _TURN_ACCELERATION], [n, columns - n]) * trajectory.spacing**2
    second = np.diff(np.eye(K), 2, axis=0)
    squares = second.T @ second
    for c in range(columns):
        H[c : control.size : columns, c : control.size : columns] += squares / stddev[c] ** 2
    gradient = squares @ (control / stddev**2)
    g[: control.size] += gradient.ravel()
    if size is not None:
        gradient[:, n:] = 0.0
        change = float(np.sum(gradient * control))
        H[: control.size, size] -= gradient.ravel()
        H[size, : control.size] -= gradient.ravel()
        H[size, size] += change
        g[size] -= change
    middle = K // 2 * columns + np.arange(columns)
    H[middle, middle] += _GAUGE**-2.0


def change_root(adjusted: Adjustment, root: int) -> Adjustment:
    """The states of all sensors with another root, which is first, and their covariance; without parts.

    Args:
        adjusted: the solution; its first sensor is the root.
        root: number of the new one, whose pose is free in all axes.
    """
    S, columns = adjusted.free.shape
    n = len(adjusted.states[root].T_root_sensor) - 1
    p = n * (n + 1) // 2
    order = [root, *(k for k in range(S) if k != root)]
    of_root = adjusted.states[root]
    T_new = se_n.inverse(of_root.T_root_sensor)
    # Errors of the new parameters by those of the old ones; the old root gets the place of the new one.
    J = np.zeros((S, columns, S, columns))
    for row, k in enumerate(order):
        by_root, by_own = se_n.relative_pose_jacobians(of_root.T_root_sensor, adjusted.states[k].T_root_sensor)
        J[row, p:, k, p:] = np.eye(columns - p)
        J[row, :p, k, :p] = by_own
        J[row, :p, root, :p] += by_root
        J[row, p, root, p] -= 1.0
    free = adjusted.free.copy()
    free[[0, root], : p + 1] = free[[root, 0], : p + 1]
    free = free[order]
    J = J.reshape(free.size, free.size)[np.ix_(free.ravel(), adjusted.free.ravel())]
    return replace(
        adjusted,
        states=[
            replace(
                adjusted.states[k],
                T_root_sensor=T_new @ adjusted.states[k].T_root_sensor,
                clock_offset=adjusted.states[k].clock_offset - of_root.clock_offset,
            )
            for k in order
        ],
        parts=[],
        associations=[],
        responses=[],
        covariance=J @ adjusted.covariance @ J.T,
        independent_covariance=J @ adjusted.independent_covariance @ J.T,
        free=free,
        agreement=adjusted.agreement[np.ix_(order, order)],
        noise=replace(adjusted.noise, white=adjusted.noise.white[order]),
        point_counts=adjusted.point_counts[order],
    )
