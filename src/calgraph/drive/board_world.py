"""Start values of boards fixed in the room, and the trajectory that they give where no other sensor does."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calgraph.config import Rig
from calgraph.drive.board_views import PRINT_ERRORS, BoardMeasurements, SharedErrors
from calgraph.drive.sources.camera import CameraSource, models_of
from calgraph.drive.sources.source import Source
from calgraph.geometry import Array, se3, se_n
from calgraph.graph.spanning_tree import walk_tree
from calgraph.surfaces.sensor_states import SensorState
from calgraph.surfaces.trajectory import SplineTrajectory, Track
from calgraph.verdict.lens_parameters import list_lens_errors, readout_error
from calgraph.verdict.parameter_estimates import PriorParameter

# Views with which a board is used in a part: one may be an outlier.
_MIN_VIEWS = 3
# Poses of a board, by single views, that agree with the others: with wrong tilts and odometry's drift, m and rad.
_MAX_SPREAD = 0.3, 0.3
# Time between views of a board within which poses are interpolated, s: accelerations displace by a centimetre.
_MAX_GAP = 0.25
# Standard deviation of what is stated to be exact, relative to its size: it has to be positive.
_EXACT = 1e-9
# Views at one time are averaged over this, s.
_BIN = 0.05


def describe_errors(rig: Rig, used: Sequence[str]) -> tuple[SharedErrors, tuple[PriorParameter, ...], Array]:
    """The errors of lenses and prints: their places, what they are, and prior standard deviations (G,).

    Exact ones have tiny standard deviations. All prints share scale and aspect: they are of one printer, and paper
    swells equally.
    """
    cameras = {used.index(name): camera for name, camera in models_of(rig).items() if name in used}
    lens: dict[int, slice] = {}
    readout: dict[int, int] = {}
    found: list[PriorParameter] = []
    for k, camera in cameras.items():
        prior, first = rig.cameras()[used[k]].uncertainty, len(found)
        found += list_lens_errors(used[k], camera, prior)
        lens[k], readout[k] = slice(first, len(found)), len(found)
        found.append(readout_error(used[k], prior))
    boards = rig.boards if cameras else ()
    priors = [board.uncertainty for board in boards]
    prints = np.zeros((len(boards), PRINT_ERRORS), dtype=np.intp)
    if boards:
        of = "boards" if len(boards) > 1 else "board"
        prints[:, :2] = len(found) + np.arange(2)
        found.append(PriorParameter(of, "print scale", "", max(one.print_scale for one in priors), stated=1.0))
        found.append(PriorParameter(of, "print aspect", "", max(one.print_aspect for one in priors), stated=1.0))
    for b, prior_of_board in enumerate(priors):
        of = f"board {b + 1}" if len(boards) > 1 else "board"
        prints[b, 2:] = len(found) + np.arange(2)
        found += [PriorParameter(of, f"bow {axis}", "m", prior_of_board.bow) for axis in "xy"]
    half_sizes = np.array([board.size for board in boards]).reshape(-1, 2) / 2
    found = [replace(one, prior_stddev=max(one.prior_stddev, _EXACT)) for one in found]
    stddev = np.array([one.prior_stddev for one in found])
    return SharedErrors(cameras, lens, readout, prints, half_sizes), tuple(found), stddev


def measure_boards(
    sources: Sequence[Source], states: Sequence[SensorState], trajectory: SplineTrajectory, errors: SharedErrors
) -> list[BoardMeasurements]:
    """The views of boards during a trajectory, with start poses of the boards by them; one object or none."""
    views = [
        (k, view)
        for k, (source, state) in enumerate(zip(sources, states, strict=True))
        if isinstance(source, CameraSource)
        for view in source.views
        # Clocks may shift a view out of the part; it is left out then.
        if trajectory.start <= view.time - state.clock_offset <= trajectory.end
    ]
    by_board: dict[int, list[Array]] = {}
    for k, view in views:
        T_world_root = trajectory.at(np.array([view.time - states[k].clock_offset])).poses[0]
        T = T_world_root @ states[k].T_root_sensor @ view.T_camera_board
        by_board.setdefault(view.board, []).append(T)
    poses = {b: _average(np.array(some)) for b, some in by_board.items() if len(some) >= _MIN_VIEWS}
    kept = [(k, view) for k, view in views if view.board in poses]
    return [BoardMeasurements.of_views(kept, poses, errors)] if kept else []


def _average(poses: Array) -> Array:
    """The mean of poses (N, 4, 4) that agree with the one which most agree with."""
    some = poses[:: max(len(poses) // 100, 1)]
    distance = np.linalg.norm(some[:, None, :3, 3] - poses[None, :, :3, 3], axis=-1) / _MAX_SPREAD[0]
    turn = se_n.rotation_angle(np.swapaxes(some[:, None, :3, :3], -1, -2) @ poses[None, :, :3, :3])
    cost = np.minimum(distance**2 + (turn / _MAX_SPREAD[1]) ** 2, 1.0)
    near = poses[cost[np.argmin(cost.sum(axis=1))] < 1.0]
    return se3.pose(se_n.nearest_rotation(near[:, :3, :3].mean(axis=0)), near[:, :3, 3].mean(axis=0))


def chain_boards(sources: Mapping[int, CameraSource], states: Mapping[int, SensorState]) -> Track | None:
    """The trajectory of the root by its clock, in the world of the boards that cameras detect one after another.

    Boards are connected where two of them are detected at one time, by any cameras. Others are left out.

    Args:
        sources: cameras by number of the sensor.
        states: their start values.
    """
    by_board: dict[int, list[tuple[float, Array]]] = {}
    for k, source in sources.items():
        for view in source.views:
            T_board_root = se3.inverse(states[k].T_root_sensor @ view.T_camera_board)
            by_board.setdefault(view.board, []).append((view.time - states[k].clock_offset, T_board_root))
    tracks = {b: _merge(some) for b, some in by_board.items() if len(some) >= _MIN_VIEWS}
    if not tracks:
        return None
    first = max(tracks, key=lambda b: len(tracks[b].times))
    pairs = {(a, b): _compare(tracks[a], tracks[b]) for a in tracks for b in tracks if a < b}
    ranked = sorted((len(found), *pair) for pair, found in pairs.items() if len(found) >= _MIN_VIEWS)[::-1]
    edges = [(a, b) for _, a, b in ranked]
    T_world_board = {first: np.eye(4)}
    for step in walk_tree(max(tracks) + 1, edges, [first]):
        a, b = edges[step.edge]
        T_a_b = _average(pairs[a, b])
        T_world_board[step.child] = T_world_board[step.parent] @ (
            T_a_b if step.parent == a else se3.inverse(T_a_b)
        )
    return _merge([
        (time, T_world_board[b] @ T)
        for b in T_world_board
        for time, T in zip(tracks[b].times.tolist(), tracks[b].poses, strict=True)
    ])  # fmt: skip


def _merge(poses: Sequence[tuple[float, Array]]) -> Track:
    """Poses in order of time; those of about one time are averaged."""
    times = np.array([time for time, _ in poses])
    T = np.array([one for _, one in poses])
    _, group = np.unique(np.floor(times / _BIN).astype(np.int64), return_inverse=True)
    count = np.bincount(group)
    mean = np.zeros((len(count), 4, 4))
    np.add.at(mean, group, T)
    mean /= count[:, None, None]
    return Track(
        np.bincount(group, times) / count, se3.pose(se_n.nearest_rotation(mean[:, :3, :3]), mean[:, :3, 3])
    )


def _compare(a: Track, b: Track) -> Array:
    """(M, 4, 4) ``T_a_b`` of two boards from the poses of the root in both their frames, at the times of a."""
    after = np.clip(np.searchsorted(b.times, a.times), 1, len(b.times) - 1)
    within = (a.times >= b.times[after - 1]) & (a.times <= b.times[after])
    within &= b.times[after] - b.times[after - 1] <= _MAX_GAP
    return np.asarray(a.poses[within] @ se3.inverse(b.at(a.times[within])))
