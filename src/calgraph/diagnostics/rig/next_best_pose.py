"""Where to hold the board next: the poses that would make the least certain sensor most certain.

Boards are tried where sensors saw boards before, tilted in all ways, and each is asked how much information what
the sensors would measure of it adds. The most useful one is taken, then the most useful one beside it, and so on.

Source: Krause, Singh, Guestrin, "Near-optimal sensor placements in Gaussian processes", 2008, on greedy choices.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calgraph.diagnostics.rig.pose_description import describe_pose
from calgraph.diagnostics.rig.predicted_observations import predict_observations
from calgraph.diagnostics.verdict import WEAK_STDDEV, axis_names
from calgraph.estimation.rig.board_information import information_by_board
from calgraph.estimation.rig.bundle_solver import Bundle, BundleState, linearize_bundle, pose_jacobian
from calgraph.estimation.rig.covariances import parameter_covariance
from calgraph.estimation.rig.observations import relative_poses
from calgraph.estimation.rig.solution import SolvedBundle
from calgraph.geometry import Array, se3, so3
from calgraph.result import Suggestion

_CANDIDATES = 300
_CHOICES = 3
# A board that shrinks the ellipsoid of errors by less than this, in logarithms of its volume, is not worth a walk.
_WORTH = 0.05
# Boards are tried within this of where boards were, in each direction, m.
_REACH = 0.3
# They are turned away from the sensors by up to this, rad.
_TILT = np.radians(60)


def suggest_board_poses(
    adjusted: SolvedBundle, kinds: Mapping[str, str], size: tuple[float, float], rng: np.random.Generator
) -> tuple[Suggestion, ...]:
    """The next board poses that would help the least certain sensor most, in units of what is called weak.

    Args:
        adjusted: the solution so far.
        kinds: camera, lidar2d or lidar3d, by sensor.
        size: width and height of the board, m.
        rng: draws the boards that are tried.

    Returns:
        Boards in the order of their use, each beside those before it; none where none would help much.
    """
    bundle, solved = adjusted.bundle, adjusted.minimized
    seen = solved.state.T_root_board
    state = replace(solved.state, T_root_board=_draw_candidates(bundle, solved.state, rng))
    sensors = list(zip(bundle.sensors, bundle.views, state.T_root_sensor, strict=True))
    views = tuple(
        predict_observations(
            own, kinds[name], relative_poses(T, seen[own.board]), relative_poses(T, state.T_root_board), size
        )
        for name, own, T in sensors
    )
    looking = replace(bundle.without_outlines(), views=views, priors=())
    gains = information_by_board(looking, linearize_bundle(looking, state))
    turns = np.array([np.kron(np.eye(2), T[:3, :3].T) for T in state.T_root_sensor])
    axes = (turns @ pose_jacobian(bundle, state).reshape(len(turns), 6, -1)).reshape(6 * len(turns), -1)
    V, limits = parameter_covariance(solved.equations), np.tile(np.repeat(WEAK_STDDEV, 3), len(turns))
    found: list[Suggestion] = []
    for _ in range(_CHOICES):
        before = _standard_deviations(axes, V) / limits
        worst = int(np.argmax(before))
        if before[worst] == 0:  # all poses are taken for exact
            break
        own = axes[6 * (worst // 6) :][:6] / limits[:6, None] / min(before[worst], 1.0)
        beside = np.asarray(np.linalg.solve(np.eye(len(V)) + V @ gains, V))
        volume = _log_volume(own, beside)
        best = int(np.argmin(volume))
        if volume[best] > _log_volume(own, V) - _WORTH:
            break
        V = beside[best]
        after = _standard_deviations(axes, V) / limits
        sensor, axis = bundle.sensors[worst // 6], worst % 6
        seeing = {
            name: relative_poses(T, state.T_root_board[best])
            for (name, _, T), own in zip(sensors, views, strict=True)
            if best in own.board
        }
        found.append(
            Suggestion(
                hold=describe_pose(sensor, kinds, seeing),
                sensor=sensor,
                axis=axis_names(kinds[sensor])[axis],
                unit="m" if axis < 3 else "rad",
                stddev=float(before[worst] * limits[worst]),
                expected=float(after[worst] * limits[worst]),
                T_root_board=state.T_root_board[best],
            )
        )
    return tuple(found)


def _standard_deviations(axes: Array, V: Array) -> Array:
    """Standard deviations (..., 6 S) along the sensors' axes for covariances (..., G, G) of the unknowns."""
    return np.asarray(np.sqrt(np.maximum(np.sum((axes @ V) * axes, axis=-1), 0)))


def _log_volume(axes: Array, V: Array) -> Array:
    """Logarithms of the volumes of error ellipsoids (...,), for covariances (..., G, G) of the unknowns.

    Along the axes (6, G), what is far below one does not count. Of a sensor with several open directions, each
    board fixes but one, and no single deviation shrinks before the last one.
    """
    return np.asarray(0.5 * np.linalg.slogdet(np.eye(len(axes)) + axes @ V @ axes.T)[1])


def _draw_candidates(bundle: Bundle, state: BundleState, rng: np.random.Generator) -> Array:
    """``T_root_board`` (K, 4, 4): near boards that were seen, before a sensor that saw them, turned any way."""
    seen = np.array([(s, board) for s, own in enumerate(bundle.views) for board in own.board])
    sensor, board = rng.choice(seen, _CANDIDATES).T
    at = state.T_root_board[board, :3, 3] + rng.uniform(-_REACH, _REACH, (_CANDIDATES, 3))
    z = state.T_root_sensor[sensor, :3, 3] - at
    z /= np.linalg.norm(z, axis=-1, keepdims=True)
    # What is up does not matter to what sensors see; only that it is across the line of sight.
    up = np.eye(3)[np.argmin(np.abs(z), axis=-1)]
    x = np.cross(up, z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    around, tilt = rng.uniform(0, 2 * np.pi, _CANDIDATES), rng.uniform(0, _TILT, _CANDIDATES)
    y = np.cross(z, x)
    turn = tilt[:, None] * (np.cos(around)[:, None] * x + np.sin(around)[:, None] * y)
    return se3.pose(so3.exp(turn) @ np.stack([x, y, z], axis=-1), at)
