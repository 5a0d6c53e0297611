"""Start values of boards fixed in the room, and the trajectory that they give where no other sensor does."""

from collections.abc import Mapping, Sequence

import numpy as np

from calgraph.config import Rig
from calgraph.drive.board_views import BoardMeasurements, SharedErrors
from calgraph.drive.sources.camera import CameraSource, models_of
from calgraph.drive.sources.source import Source
from calgraph.drive.states import SensorState
from calgraph.geometry import Array, se3, se_n
from calgraph.sensors.lens_errors import displacement_at_corner
from calgraph.surfaces.trajectory import SplineTrajectory, Track

# Views with which a board is used in a part: one may be an outlier.
_MIN_VIEWS = 3
# Poses of a board, by single views, that agree with the others: with wrong tilts and odometry's drift, m and rad.
_MAX_SPREAD = 0.3, 0.3
# Time between views of a board within which poses are interpolated, s: accelerations displace by a centimetre.
_MAX_GAP = 0.25
# Views at one time are averaged over this, s.
_BIN = 0.05


def describe_errors(rig: Rig, used: Sequence[str]) -> tuple[SharedErrors, Array]:
    """The errors of lenses and prints, and their prior standard deviations (G,), 0 replaced by a tiny number.

    All prints share scale and aspect: they are of one printer, and paper swells alike.
    """
    cameras = {used.index(name): camera for name, camera in models_of(rig).items() if name in used}
    lens: dict[int, slice] = {}
    readout: dict[int, int] = {}
    stddev: list[float] = []
    for k, camera in cameras.items():
        prior = rig.cameras()[used[k]].uncertainty
        effect = np.maximum(displacement_at_corner(camera), 1e-9)
        first = len(stddev)
        stddev += [prior.focal_length, prior.pixel_aspect, *[prior.principal_point] * 2]
        stddev += (prior.distortion / effect).tolist()
        lens[k], readout[k] = slice(first, len(stddev)), len(stddev)
        stddev.append(prior.readout_time)
    boards = rig.boards
    first = len(stddev)
    if boards:
        stddev += [max(board.uncertainty.print_scale for board in boards)]
        stddev += [max(board.uncertainty.print_aspect for board in boards)]
    prints = np.zeros((len(boards), 4), dtype=np.intp)
    for b, board in enumerate(boards):
        prints[b] = first, first + 1, len(stddev), len(stddev) + 1
        stddev += [board.uncertainty.bow] * 2
    half_sizes = np.array([board.size for board in boards]).reshape(-1, 2) / 2
    # Millionths of what is known to be exact.
    return SharedErrors(cameras, lens, readout, prints, half_sizes), np.maximum(stddev, 1e-9)


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
    """The trajectory of the root by its clock, in the world of the boards that cameras see one after another.

    Boards are connected where two of them are seen at one time, by whatever cameras. Others are left out.

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
    T_world_board = {first: np.eye(4)}
    pairs = {(a, b): _compare(tracks[a], tracks[b]) for a in tracks for b in tracks if a < b}
    while True:
        links = [
            (len(found), a, b)
            for (a, b), found in pairs.items()
            if (a in T_world_board) != (b in T_world_board) and len(found) >= _MIN_VIEWS
        ]
        if not links:
            break
        _, a, b = max(links)
        T_a_b = _average(pairs[a, b])
        if a in T_world_board:
            T_world_board[b] = T_world_board[a] @ T_a_b
        else:
            T_world_board[a] = T_world_board[b] @ se3.inverse(T_a_b)
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
