"""Next best board poses: those that reduce the uncertainty of the least certain sensor most.

Candidates are sampled near recorded boards, tilted in all directions. Each is evaluated by the information of the
observations that the sensors are predicted to make. The best one is selected, then the best one in addition to it.

Source: Krause, Singh, Guestrin, "Near-optimal sensor placements in Gaussian processes", 2008, on greedy choices.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Tolerance
from calgraph.config.settings import DiagnosticsSettings
from calgraph.geometry import Array, se3, so3
from calgraph.result import Suggestion
from calgraph.rig.bundle.board_information import information_by_board
from calgraph.rig.bundle.bundle_solver import Bundle, BundleState, linearize_bundle, pose_jacobian
from calgraph.rig.bundle.covariances import parameter_covariance
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.rig.checks.predicted_observations import predict_observations
from calgraph.verdict.grades import axis_names, max_good_stddev

# Minimum decrease of the log volume of the error ellipsoid for a pose to be suggested: 5 % of one standard
# deviation, what one more capture gives in addition to ten similar ones.
_MIN_SUGGESTION_GAIN = 0.05


def suggest_board_poses(
    solved: SolvedBundle,
    kinds: Mapping[str, str],
    size: tuple[float, float],
    rng: np.random.Generator,
    tolerance: Tolerance,
    settings: DiagnosticsSettings = DiagnosticsSettings(),
    *,
    up: Array | None = None,
    is_reachable: Callable[[Array], NDArray[np.bool_]] | None = None,
) -> tuple[Suggestion, ...]:
    """Board poses that reduce the uncertainty of the least certain sensor most, relative to the tolerance.

    Args:
        solved: the current solution.
        kinds: camera, lidar2d or lidar3d, by sensor.
        size: width and height of the board, m.
        rng: draws the candidates.
        tolerance: the largest acceptable error of poses.
        settings: of the candidates, of predicted detections, and of verdicts.
        up: (3,) direction in the root's frame towards which the upper edge of boards is held; any if left out.
        is_reachable: (K,) which of candidates ``T_root_board`` (K, 4, 4) can be suggested; all if left out.

    Returns:
        Poses in the order of selection, each in addition to those before; none where no pose has a relevant gain.
    """
    bundle, current = solved.bundle, solved.minimized.state
    candidates = _draw_candidates(bundle, current, rng, up)
    if is_reachable:
        candidates = candidates[is_reachable(candidates)]
    if not len(candidates):
        return ()
    # Predicted observations are those of sensors and prints without errors: others would make outliers of them.
    state = replace(current, T_root_board=candidates, extra=np.zeros_like(current.extra))
    sensors = list(zip(bundle.sensors, bundle.views, state.T_root_sensor, strict=True))
    views = tuple(
        predict_observations(
            observed,
            kinds[name],
            relative_poses(T, current.T_root_board[observed.board]),
            relative_poses(T, state.T_root_board),
            size,
        )
        for name, observed, T in sensors
    )
    predicted = replace(bundle.without_outlines(), views=views, priors=())
    information = information_by_board(predicted, linearize_bundle(predicted, state))
    to_sensor = np.array([np.kron(np.eye(2), T[:3, :3].T) for T in state.T_root_sensor])
    axes = (to_sensor @ pose_jacobian(bundle, state).reshape(len(to_sensor), 6, -1)).reshape(
        6 * len(to_sensor), -1
    )
    V, limits = (
        parameter_covariance(solved.minimized.equations),
        np.tile(max_good_stddev(tolerance, settings.verdict), len(to_sensor)),
    )
    suggestions: list[Suggestion] = []
    for _ in range(settings.rig.suggestions):
        before = _standard_deviations(axes, V) / limits
        worst = int(np.argmax(before))
        sensor, axis = divmod(worst, 6)
        if before[worst] == 0:  # no pose is estimated
            break
        scaled = axes[6 * sensor :][:6] / limits[:6, None] / min(before[worst], 1.0)
        # The covariance with a candidate, along the six axes only: all of it takes four times as long.
        ratio = np.eye(len(V)) + V @ information
        volume = _log_volume(scaled @ np.linalg.solve(ratio, V @ scaled.T))
        best = int(np.argmin(volume))
        if volume[best] > _log_volume(scaled @ V @ scaled.T) - _MIN_SUGGESTION_GAIN:
            break
        V = np.asarray(np.linalg.solve(ratio[best], V))
        after = _standard_deviations(axes, V) / limits
        name = bundle.sensors[sensor]
        T_sensor_board = {
            by: relative_poses(T, state.T_root_board[best])
            for (by, _, T), observed in zip(sensors, views, strict=True)
            if best in observed.board
        }
        suggestions.append(
            Suggestion(
                hold=describe_pose(name, kinds, T_sensor_board),
                sensor=name,
                axis=axis_names(kinds[name])[axis],
                unit="m" if axis < 3 else "rad",
                stddev=float(before[worst] * limits[worst]),
                expected=float(after[worst] * limits[worst]),
                T_root_board=state.T_root_board[best],
            )
        )
    return tuple(suggestions)


def _standard_deviations(axes: Array, V: Array) -> Array:
    """Standard deviations (..., 6 S) along the sensors' axes for covariances (..., G, G) of the unknowns."""
    return np.asarray(np.sqrt(np.maximum(np.sum((axes @ V) * axes, axis=-1), 0)))


def _log_volume(covariances: Array) -> Array:
    """Logarithms of the volumes of error ellipsoids (...,), for covariances (..., 6, 6).

    Standard deviations far below one do not contribute. The volume is compared, since of several unobserved
    directions each board determines one, and the largest deviation falls with the last board only.
    """
    return np.asarray(0.5 * np.linalg.slogdet(np.eye(covariances.shape[-1]) + covariances)[1])


# Board poses tried for a suggestion; the best of 300 random poses is within the best 1 % with a probability of 95
# %.
_CANDIDATE_POSES = 300
# m; candidates are within this distance, along each axis, of recorded board positions, where a person can stand.
_CANDIDATE_RADIUS = 0.3
# rad (60°); maximum tilt of candidates from the line of sight. Tags are decoded reliably up to about this angle.
_MAX_CANDIDATE_TILT = float(np.radians(60))


def _draw_candidates(
    bundle: Bundle,
    state: BundleState,
    rng: np.random.Generator,
    up: Array | None = None,
) -> Array:
    """``T_root_board`` (K, 4, 4): near recorded boards, facing a sensor that detected them, with random tilts."""
    count, radius = _CANDIDATE_POSES, _CANDIDATE_RADIUS
    detected = np.array([(s, board) for s, views in enumerate(bundle.views) for board in views.board])
    sensor, board = rng.choice(detected, count).T
    position = state.T_root_board[board, :3, 3] + rng.uniform(-radius, radius, (count, 3))
    z = state.T_root_sensor[sensor, :3, 3] - position
    z /= np.linalg.norm(z, axis=-1, keepdims=True)
    # The roll of the board about the line of sight does not matter: any axis across it serves.
    x = np.cross(np.eye(3)[np.argmin(np.abs(z), axis=-1)] if up is None else up, z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    azimuth, tilt = rng.uniform(0, 2 * np.pi, count), rng.uniform(0, _MAX_CANDIDATE_TILT, count)
    y = np.cross(z, x)
    phi = tilt[:, None] * (np.cos(azimuth)[:, None] * x + np.sin(azimuth)[:, None] * y)
    return se3.pose(so3.exp(phi) @ np.stack([x, y, z], axis=-1), position)


# Rotation from the axes of a camera to forward, left, up: the axes of a scanner.
_CAMERA_TO_SCANNER_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


# rad (7.5°); the same for angles, which are rounded to 5°.
_MIN_DESCRIPTION_ANGLE = float(np.radians(7.5))
# m; smaller heights relative to the sensor are not mentioned: an operator holds a board no more precisely.
_MIN_DESCRIPTION_HEIGHT = 0.15


def describe_pose(sensor: str, kinds: Mapping[str, str], T_sensor_board: Mapping[str, Array]) -> str:
    """Describes a board pose relative to a sensor, or to the nearest one if that sensor does not detect the board.

    Args:
        sensor: the sensor whose pose the board improves.
        kinds: camera, lidar2d or lidar3d, by sensor.
        T_sensor_board: (4, 4) for every sensor that detects the board.

    Returns:
        A phrase such as ``hold the board 2.1 m from laser, 30° to its left, tilted back by 40°``.
    """
    if sensor not in T_sensor_board:
        sensor = min(T_sensor_board, key=lambda name: float(np.linalg.norm(T_sensor_board[name][:3, 3])))
    axes = _CAMERA_TO_SCANNER_AXES if kinds[sensor] == "camera" else np.eye(3)
    center, normal = axes @ T_sensor_board[sensor][:3, 3], axes @ T_sensor_board[sensor][:3, 2]
    distance, bearing = np.hypot(center[0], center[1]), np.degrees(np.arctan2(center[1], center[0]))
    forward = center[:2] / distance
    left = np.array([-forward[1], forward[0]])
    turned = np.degrees(np.arctan2(normal[:2] @ left, -normal[:2] @ forward))
    tilted = np.degrees(np.arcsin(np.clip(normal[2], -1, 1)))
    least_angle = np.degrees(_MIN_DESCRIPTION_ANGLE)
    is_ahead = abs(bearing) < least_angle
    parts = [f"hold the board {distance:.1f} m {'in front of' if is_ahead else 'from'} {sensor}"]
    if not is_ahead:
        parts.append(f"{_round_to_five(bearing)} to its {'left' if bearing > 0 else 'right'}")
    if abs(center[2]) >= _MIN_DESCRIPTION_HEIGHT:
        parts.append(f"{abs(center[2]):.1f} m {'above' if center[2] > 0 else 'below'} it")
    if abs(turned) >= least_angle:
        side = "left" if turned > 0 else "right"
        parts.append(f"turned {_round_to_five(turned)} to the {side} as viewed from the sensor")
    if abs(tilted) >= least_angle:
        parts.append(f"tilted {'back' if tilted > 0 else 'forward'} by {_round_to_five(tilted)}")
    return ", ".join(parts)


def _round_to_five(degrees: float) -> str:
    return f"{5 * round(abs(degrees) / 5)}°"
