"""The joint solution in the frame and by the clock of another sensor than the one that it was solved for."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calgraph.drive.adjustment import Adjustment
from calgraph.drive.measurements import DrivePart
from calgraph.drive.states import BESIDE_POSE, SensorState
from calgraph.geometry import Array, Index, se_n
from calgraph.surfaces.trajectory import SplineTrajectory, Track, fit_spline

# Of parameters, in m, rad and s, for derivatives of the trajectory by them.
_STEP = 1e-5


def change_root(adjusted: Adjustment, root: int) -> Adjustment:
    """The solution with another root, which is first; parts have no measurements any more.

    Args:
        adjusted: the solution; its first sensor is the root.
        root: number of the new one, whose pose is free in all axes.
    """
    S, columns = adjusted.free.shape
    p = columns - BESIDE_POSE
    order = np.array([root, *(k for k in range(S) if k != root)])
    T_new = se_n.inverse(adjusted.states[root].T_root_sensor)
    states = [_restate(adjusted.states[k], T_new, adjusted.states[root].clock_offset) for k in order]
    free = adjusted.free.copy()
    free[[0, root], : p + 1] = free[[root, 0], : p + 1]
    number = np.full(adjusted.free.shape, -1)
    number[adjusted.free] = np.arange(adjusted.free.sum())
    # Errors of all parameters (S, n + d + 6) by those that were free.
    before = np.zeros((S, columns, int(adjusted.free.sum())))
    before[adjusted.free] = np.eye(before.shape[2])
    after = np.stack([_propagate(adjusted.states, before, k, root) for k in order])
    J = after[free[order]]
    # The parameters are as many as before.
    back = np.linalg.inv(J) if adjusted.responses else J
    return replace(
        adjusted,
        states=states,
        parts=[_restate_part(part, adjusted.states[root], order) for part in adjusted.parts],
        covariance=J @ adjusted.covariance @ J.T,
        independent_covariance=J @ adjusted.independent_covariance @ J.T,
        free=free[order],
        shared_cells=adjusted.shared_cells[np.ix_(order, order)],
        residual_rms=adjusted.residual_rms[order],
        point_counts=adjusted.point_counts[order],
        responses=[
            _restate_response(part, response, adjusted, root) @ back
            for part, response in zip(adjusted.parts, adjusted.responses, strict=True)
        ],
    )


def _restate(state: SensorState, T_new_old: Array, clock: float) -> SensorState:
    return replace(state, T_root_sensor=T_new_old @ state.T_root_sensor, clock_offset=state.clock_offset - clock)


def _propagate(states: Sequence[SensorState], errors: Array, k: int, root: int) -> Array:
    """(n + d + 6, P) errors of ``T_r⁻¹ T_k`` and of the clock along the new root's axes, from those of all."""
    T_r, T_k = states[root].T_root_sensor, states[k].T_root_sensor
    n = len(T_r) - 1
    own, of_root = errors[k], errors[root]
    p = own.shape[0] - BESIDE_POSE
    back = se_n.transpose(se_n.rotation(T_r))
    lever = se_n.rotation_jacobian(se_n.translation(T_k) - se_n.translation(T_r))
    moved = own.copy()
    moved[:n] = back @ (own[:n] - of_root[:n] - lever @ of_root[n:p])
    turned = own[n:p] - of_root[n:p]
    moved[n:p] = back @ turned if n == 3 else turned
    moved[p] = own[p] - of_root[p]
    return np.asarray(moved)


def _restate_part(part: DrivePart, root: SensorState, order: Index) -> DrivePart:
    """The part with the trajectory of the new root by its clock, and points in the new order of sensors."""
    spline: SplineTrajectory = part.trajectory
    track = _track_root(spline, root, _list_knots(spline) + root.clock_offset)
    start, end = float(track.times[0]), float(track.times[-1])
    return DrivePart([part.points[k] for k in order], fit_spline(track, start, end, spline.spacing))


def _list_knots(spline: SplineTrajectory) -> Array:
    """Times of the knots, s."""
    return np.linspace(spline.start, spline.end, len(spline.control) - 2)


def _track_root(spline: SplineTrajectory, root: SensorState, times: Array) -> Track:
    """The poses of the new root at times of its clock, s."""
    return Track(times, spline.at(times - root.clock_offset).poses @ root.T_root_sensor)


def _restate_response(part: DrivePart, response: Array, adjusted: Adjustment, root: int) -> Array:
    """(C, P) change of the control points of the new root's trajectory with the parameters that were free."""
    spline, state = part.trajectory, adjusted.states[root]
    knots = _list_knots(spline)
    times = knots + state.clock_offset
    n = spline.reference.poses.shape[-1] - 1
    found = []
    for column, full in zip(response.T * _STEP, np.eye(adjusted.free.size)[adjusted.free.ravel()], strict=True):
        own = _STEP * full.reshape(adjusted.free.shape)[root]
        change = column[: spline.control.size].reshape(spline.control.shape)
        both = [
            _track_root(spline.moved(sign * change), state.moved(sign * own), times).poses for sign in (1.0, -1.0)
        ]
        turned = se_n.log(se_n.transpose(se_n.rotation(both[1])) @ se_n.rotation(both[0]))
        moved = np.concatenate([se_n.translation(both[0]) - se_n.translation(both[1]), turned], axis=1)
        # Both are coordinates of the spline, by whose values its control points are found.
        found.append(np.concatenate([
            _fit_control(some, times, spline.spacing) for some in (moved[:, :n], moved[:, n:])
        ], axis=1).ravel() / (2 * _STEP))  # fmt: skip
    return np.array(found).T


def _fit_control(values: Array, times: Array, spacing: float) -> Array:
    """(C, d) control points of the spline through values (N, d) at knots."""
    d = values.shape[1]
    wide = np.zeros((len(values), 3))
    wide[:, :d] = values
    track = Track(times, se_n.pose(np.tile(np.eye(3), (len(values), 1, 1)), wide))
    return fit_spline(track, float(times[0]), float(times[-1]), spacing).control[:, :d]
