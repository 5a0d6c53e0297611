"""The joint solution in the frame and by the clock of another sensor than the one that it was solved for."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calgraph.drive.adjustment import Adjustment
from calgraph.drive.measurements import DrivePart
from calgraph.drive.states import SensorState
from calgraph.geometry import Array, Index, se_n
from calgraph.surfaces.trajectory import SplineTrajectory, Track, fit_spline


def change_root(adjusted: Adjustment, root: int) -> Adjustment:
    """The solution with another root, which is first; parts have no measurements any more.

    Args:
        adjusted: the solution; its first sensor is the root.
        root: number of the new one, whose pose is free in all axes.
    """
    S, columns = adjusted.free.shape
    p = columns - 3
    order = np.array([root, *(k for k in range(S) if k != root)])
    T_new = se_n.inverse(adjusted.states[root].T_root_sensor)
    states = [_restate(adjusted.states[k], T_new, adjusted.states[root].clock_offset) for k in order]
    free = adjusted.free.copy()
    free[0, : p + 1], free[root, : p + 1] = free[root, : p + 1], free[0, : p + 1]
    number = np.full(adjusted.free.shape, -1)
    number[adjusted.free] = np.arange(adjusted.free.sum())
    # Errors of all parameters (S, n + d + 3) by those that were free.
    before = np.zeros((S, columns, int(adjusted.free.sum())))
    before[adjusted.free] = np.eye(before.shape[2])
    after = np.stack([_propagate(adjusted.states, before, k, root) for k in order])
    J = after[free[order]]
    return replace(
        adjusted,
        states=states,
        parts=[_restate_part(part, adjusted.states[root], order) for part in adjusted.parts],
        covariance=J @ adjusted.covariance @ J.T,
        free=free[order],
        shared_cells=adjusted.shared_cells[np.ix_(order, order)],
        residual_rms=adjusted.residual_rms[order],
        point_counts=adjusted.point_counts[order],
    )


def _restate(state: SensorState, T_new_old: Array, clock: float) -> SensorState:
    return replace(state, T_root_sensor=T_new_old @ state.T_root_sensor, clock_offset=state.clock_offset - clock)


def _propagate(states: Sequence[SensorState], errors: Array, k: int, root: int) -> Array:
    """(n + d + 3, P) errors of ``T_r⁻¹ T_k`` and of the clock along the new root's axes, from those of all."""
    T_r, T_k = states[root].T_root_sensor, states[k].T_root_sensor
    n = len(T_r) - 1
    own, of_root = errors[k], errors[root]
    p = own.shape[0] - 3
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
    times = np.linspace(spline.start, spline.end, len(spline.control) - 2)
    track = Track(times + root.clock_offset, spline.at(times).poses @ root.T_root_sensor)
    start, end = float(track.times[0]), float(track.times[-1])
    return DrivePart([part.points[k] for k in order], fit_spline(track, start, end, spline.spacing))
