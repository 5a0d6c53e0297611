"""Next best board poses: those that reduce the uncertainty of the least certain sensor most.

Candidates are sampled near recorded boards, tilted in all directions. Each is evaluated by the information of the
observations that the sensors are predicted to make. The best one is selected, then the best one in addition to it.

Source: Krause, Singh, Guestrin, "Near-optimal sensor placements in Gaussian processes", 2008, on greedy choices.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, pairwise

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Tolerance
from calgraph.config.settings import DiagnosticsSettings, VerdictSettings
from calgraph.geometry import Array, Index, se3, so3
from calgraph.result import Calibration, SensorPose, Suggestion, Verdict
from calgraph.result.sensor_pose import stddev_along_axes
from calgraph.rig.bundle.bundle_solver import Bundle, BundleState, linearize_bundle
from calgraph.rig.bundle.corner_observations import CornerObservations
from calgraph.rig.bundle.covariances import BoardInformation, axis_jacobian, information_by_board
from calgraph.rig.bundle.observations import BoardViews, relative_poses
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.rig.bundle.solution import RigSolution, SolvedBundle
from calgraph.sensors.kinds import KINDS
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
    settings: DiagnosticsSettings,
    *,
    up: Array | None = None,
    is_reachable: Callable[[Array], NDArray[np.bool_]] | None = None,
) -> tuple[Suggestion, ...]:
    """Board poses that reduce the uncertainty of the least certain sensor most, relative to the tolerance.

    Args:
        solved: the current solution.
        kinds: kind by sensor.
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

    def predict(chosen: Index) -> Iterator[BoardInformation]:
        return predict_board_information(solved, kinds, size, candidates[chosen])

    def find_sensors(chosen: int) -> list[str]:
        predictions = _predict_views(bundle, current, kinds, size, candidates[chosen : chosen + 1])
        return [name for name, views in zip(bundle.sensors, predictions, strict=True) if len(views.board)]

    return select_board_poses(
        solved, kinds, tolerance, settings.verdict, candidates, predict, find_sensors, settings.rig.suggestions
    )


def select_board_poses(
    solved: SolvedBundle,
    kinds: Mapping[str, str],
    tolerance: Tolerance,
    settings: VerdictSettings,
    candidates: Array,
    predict: Callable[[Index], Iterable[BoardInformation]],
    find_sensors: Callable[[int], Sequence[str]],
    count: int,
) -> tuple[Suggestion, ...]:
    """The candidates that reduce the uncertainty of the least certain sensor most, one after the other.

    Args:
        solved: the current solution.
        kinds: kind by sensor.
        tolerance: the largest acceptable error of poses.
        settings: of verdicts.
        candidates: ``T_root_board`` (K, 4, 4).
        predict: the information of candidates with some indices.
        find_sensors: the sensors that detect the candidate with an index.
        count: number of poses at most.
    """
    if not len(candidates):
        return ()
    bundle, current = solved.bundle, solved.minimized.state
    sensors = len(bundle.sensors)
    axes = axis_jacobian(bundle, current).reshape(6 * sensors, -1)
    V, limits = solved.minimized.equations.covariance, np.tile(max_good_stddev(tolerance, settings), sensors)
    kept = _keep_first(predict(np.arange(len(candidates))))
    others = np.arange(len(kept), len(candidates))
    suggestions: list[Suggestion] = []
    for _ in range(count):
        before = _standard_deviations(axes, V) / limits
        worst = int(np.argmax(before))
        sensor, axis = divmod(worst, 6)
        if before[worst] == 0:  # no pose is estimated
            break
        scaled = axes[6 * sensor :][:6] / limits[:6, None] / min(before[worst], 1.0)
        pose, along = np.flatnonzero(scaled.any(axis=0)), V @ scaled.T
        predicted = chain(kept, predict(others) if len(others) else ())
        volume = _log_volume(
            np.array([scaled[:, pose] @ _multiply_covariance_with(one, V, pose, along) for one in predicted])
        )
        best = int(np.argmin(volume))
        if volume[best] > _log_volume(scaled @ along) - _MIN_SUGGESTION_GAIN:
            break
        (added,) = predict(np.array([best]))
        V = _multiply_covariance_with(added, V, np.arange(len(V)), V)
        after = _standard_deviations(axes, V) / limits
        name, detecting = bundle.sensors[sensor], find_sensors(best)
        T_sensor_board = {
            by: relative_poses(T, candidates[best])
            for by, T in zip(bundle.sensors, current.T_root_sensor, strict=True)
            if by in detecting
        }
        suggestions.append(
            Suggestion(
                hold=describe_pose(name, kinds, T_sensor_board),
                sensor=name,
                axis=axis_names(kinds[name])[axis],
                unit="m" if axis < 3 else "rad",
                stddev=float(before[worst] * limits[worst]),
                expected=float(after[worst] * limits[worst]),
                T_root_board=candidates[best],
            )
        )
    return tuple(suggestions)


# Numbers in the information of candidates that is kept for further poses, 80 MB: of all candidates of most rigs.
_KEPT_NUMBERS = 10_000_000


def _keep_first(predicted: Iterable[BoardInformation]) -> list[BoardInformation]:
    """The first ones, as many as are kept: to predict them again takes most of the time of a suggestion."""
    kept: list[BoardInformation] = []
    room = _KEPT_NUMBERS
    for one in predicted:
        room -= one.information.size
        if room < 0:
            break
        kept.append(one)
    return kept


# Numbers in the information of the views of candidates that are predicted together, 80 MB, of which the solver has
# several copies. All candidates of most rigs; twenty cameras with a residual distortion have 0.4e6 for each one.
_BATCH_NUMBERS = 1e7


def predict_board_information(
    solved: SolvedBundle, kinds: Mapping[str, str], size: tuple[float, float], candidates: Array
) -> Iterator[BoardInformation]:
    """Of the views that the sensors are predicted to have of each candidate (K, 4, 4).

    Args:
        solved: the current solution.
        kinds: kind by sensor.
        size: width and height of the board, m.
        candidates: ``T_root_board``.
    """
    bundle, current = solved.bundle, solved.minimized.state
    numbers = sum((6 + views.parameters.index.shape[1]) ** 2 for views in bundle.views)
    together = max(int(_BATCH_NUMBERS / numbers), 1)
    for batch in np.split(candidates, range(together, len(candidates), together)):
        views = _predict_views(bundle, current, kinds, size, batch)
        predicted = replace(bundle.without_outlines(), views=views, priors=())
        # Of sensors and prints without errors: others would make outliers of the predicted observations.
        state = replace(current, T_root_board=batch, extra=np.zeros_like(current.extra))
        yield from information_by_board(predicted, linearize_bundle(predicted, state))


def _predict_views(
    bundle: Bundle, current: BundleState, kinds: Mapping[str, str], size: tuple[float, float], candidates: Array
) -> tuple[BoardViews, ...]:
    """(S,) of each sensor, those that it is predicted to have of candidates (K, 4, 4)."""
    return tuple(
        predict_observations(
            observed,
            kinds[name],
            relative_poses(T, current.T_root_board[observed.board]),
            relative_poses(T, candidates),
            size,
        )
        for name, observed, T in zip(bundle.sensors, bundle.views, current.T_root_sensor, strict=True)
    )


def _multiply_covariance_with(added: BoardInformation, V: Array, rows: Index, product: Array) -> Array:
    """Rows (n,) of the product ``W @ M`` (n, m): W is what a covariance V becomes with a board's information.

    Few of the parameters are the board's, and the others need not be solved for: for a hundred parameters of each
    of twenty cameras, that takes a hundredth of the time. No difference of large covariances is taken.

    Args:
        added: of the board.
        V: (G, G).
        rows: (n,) of W.
        product: (G, m) ``V @ M``.
    """
    some = np.union1d(added.columns, rows)
    ratio = np.eye(len(some))
    ratio[:, np.searchsorted(some, added.columns)] += V[np.ix_(some, added.columns)] @ added.information
    return np.asarray(np.linalg.solve(ratio, product[some])[np.searchsorted(some, rows)])


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
    bundle: Bundle, state: BundleState, rng: np.random.Generator, up: Array | None = None
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


# A camera's axes are right, down, forward.
_CAMERA_TO_SCANNER_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def axes_of(kind: str) -> Array:
    """(3, 3) rotation from the axes of a sensor to forward, left, up: the axes of a scanner."""
    return _CAMERA_TO_SCANNER_AXES if KINDS[kind].optical else np.eye(3)


# rad (7.5°); smaller angles are not mentioned, as angles are rounded to 5°.
_MIN_DESCRIPTION_ANGLE = float(np.radians(7.5))
# m; smaller heights relative to the sensor are not mentioned: an operator holds a board no more precisely.
_MIN_DESCRIPTION_HEIGHT = 0.15


def describe_pose(sensor: str, kinds: Mapping[str, str], T_sensor_board: Mapping[str, Array]) -> str:
    """Describes a board pose relative to a sensor, or to the nearest one if that sensor does not detect the board.

    Args:
        sensor: the sensor whose pose the board improves.
        kinds: kind by sensor.
        T_sensor_board: (4, 4) for every sensor that detects the board.

    Returns:
        A phrase such as ``hold the board 2.1 m from laser, 30° to its left, tilted back by 40°``.
    """
    if sensor not in T_sensor_board:
        sensor = min(T_sensor_board, key=lambda name: float(np.linalg.norm(T_sensor_board[name][:3, 3])))
    axes = axes_of(kinds[sensor])
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


# Points along each side of a board that represent all beams on it; their weights add up to the number of beams.
_GRID = 7


# Shortest intersection of scan plane and board that is predicted to be detected, as a share of the shorter side.
MIN_SEGMENT_SHARE = 1 / 3


def predict_observations(
    views: BoardViews, kind: str, T_detected: Array, T_candidate: Array, size: tuple[float, float]
) -> BoardViews:
    """Noise-free views of those candidate boards that the sensor is predicted to detect.

    Args:
        views: the views that the sensor has recorded.
        kind: of the sensor.
        T_detected: ``T_sensor_board`` (V, 4, 4) of these views.
        T_candidate: ``T_sensor_board`` (K, 4, 4) of the candidates.
        size: width and height of the board, m.
    """
    visible = np.flatnonzero(_is_in_view(T_detected, T_candidate))
    if isinstance(views, CornerObservations):
        return _predict_corners(views, visible, T_candidate)
    assert isinstance(views, RangeObservations)
    if KINDS[kind].detects == "line":
        return _predict_scan_lines(views, visible, T_candidate, size)
    return _predict_patches(views, visible, T_detected, T_candidate, size)


# rad (65°); maximum angle between the board normal and the line of sight at which a detection is predicted.
MAX_PREDICTED_TILT = float(np.radians(65))
# rad (12°); a sensor is predicted to detect boards within this angle of one that it detected.
_MAX_BEARING_CHANGE = float(np.radians(12))
# The same for the ratio of distances: the density of points changes by 1.3² = 1.7, within what detection accepts.
_MAX_DISTANCE_RATIO = 1.3


def _is_in_view(T_detected: Array, T_candidate: Array) -> NDArray[np.bool_]:
    """(K,) which candidates face the sensor, near the bearing and distance of a detected board."""
    detected, center = T_detected[:, :3, 3], T_candidate[:, :3, 3]
    detected_distance, distance = np.linalg.norm(detected, axis=-1), np.linalg.norm(center, axis=-1)
    facing = -np.sum(center * T_candidate[:, :3, 2], axis=-1) > np.cos(MAX_PREDICTED_TILT) * distance
    same_bearing = center @ detected.T > np.cos(_MAX_BEARING_CHANGE) * distance[:, None] * detected_distance
    same_distance = np.abs(np.log(distance[:, None] / detected_distance)) < np.log(_MAX_DISTANCE_RATIO)
    return np.asarray(facing & np.any(same_bearing & same_distance, axis=-1), dtype=np.bool_)


def _predict_corners(views: CornerObservations, visible: Index, T_candidate: Array) -> CornerObservations:
    """The corners of the view with the most, for boards that lie within the image as a whole."""
    counts = np.diff(views.start, append=len(views.pixels))
    if not len(counts):
        return views
    most = views.select(np.full(len(visible), np.argmax(counts)))
    points = se3.apply(T_candidate[visible], most.printed.nominal.reshape(len(visible), counts.max(), 3))
    pixels = views.camera.project(points.reshape(-1, 3))
    inside = np.all(views.camera.contains(pixels).reshape(points.shape[:2]), axis=1)
    return replace(most, board=visible, pixels=pixels).select(np.flatnonzero(inside))


def _predict_patches(
    views: RangeObservations, visible: Index, T_detected: Array, T_candidate: Array, size: tuple[float, float]
) -> RangeObservations:
    """Beams of a 3-D scanner over the whole board, of the density in solid angle of its recorded views."""
    counts = views.counts
    density = float(np.median(counts / _solid_angle(T_detected, size))) if len(counts) else 0.0
    steps = (np.arange(_GRID) + 0.5) / _GRID - 0.5
    x, y = np.meshgrid(size[0] * steps, size[1] * steps)
    grid = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return _predict_beams(
        views,
        visible,
        T_candidate,
        np.tile(grid, (len(visible), 1, 1)),
        density * _solid_angle(T_candidate[visible], size),
    )


def _solid_angle(T_sensor_board: Array, size: tuple[float, float]) -> Array:
    """(V,) sr, for a board that is small relative to its distance."""
    center = T_sensor_board[:, :3, 3]
    distance = np.linalg.norm(center, axis=-1)
    return np.asarray(size[0] * size[1] * np.abs(np.sum(center * T_sensor_board[:, :3, 2], axis=-1)) / distance**3)


def _predict_scan_lines(
    views: RangeObservations, visible: Index, T_candidate: Array, size: tuple[float, float]
) -> RangeObservations:
    """Beams of a 2-D scanner along its intersection with the board, of the angular density of its views."""
    ends, length = _intersect_scan_plane(T_candidate[visible], size)
    detected = length > MIN_SEGMENT_SHARE * min(size)
    visible, ends = visible[detected], ends[detected]
    fraction = ((np.arange(_GRID) + 0.5) / _GRID)[:, None]
    points = ends[:, :1] + fraction * (ends[:, 1:] - ends[:, :1])
    bounds = [*views.start, len(views.ranges)]
    spans = [_angular_span(views.directions[a:b]) for a, b in pairwise(bounds)]
    density = float(np.median(np.diff(bounds) / np.maximum(spans, 1e-3))) if spans else 0.0
    edges = se3.apply(T_candidate[visible], ends)
    return _predict_beams(
        views, visible, T_candidate, points, density * np.array([_angular_span(pair) for pair in edges])
    )


def _intersect_scan_plane(T_sensor_board: Array, size: tuple[float, float]) -> tuple[Array, Array]:
    """Ends (V, 2, 3) of the intersections of boards with a sensor's plane z = 0, and lengths (V,), or 0."""
    gradient = T_sensor_board[:, 2, :2]
    steepness = np.maximum(np.linalg.norm(gradient, axis=-1), 1e-9)[:, None]
    nearest = -T_sensor_board[:, 2, 3:4] * gradient / steepness**2
    along = gradient[:, ::-1] * [-1, 1] / steepness
    half = np.array(size) / 2
    slope = np.where(np.abs(along) < 1e-9, 1e-9, along)
    crossings = np.sort(np.stack([(-half - nearest) / slope, (half - nearest) / slope]), axis=0)
    first, last = crossings[0].max(axis=-1), crossings[1].min(axis=-1)
    length = np.maximum(last - first, 0)
    flat = nearest[:, None] + np.stack([first, first + length], axis=-1)[..., None] * along[:, None]
    return np.concatenate([flat, np.zeros((len(flat), 2, 1))], axis=-1), length


def _angular_span(directions: Array) -> float:
    """The angle in the scan plane that directions (N, 3) cover, rad."""
    x, y = directions[:, :2].sum(axis=0)
    angles = np.arctan2(x * directions[:, 1] - y * directions[:, 0], x * directions[:, 0] + y * directions[:, 1])
    return float(np.ptp(angles))


def _predict_beams(
    views: RangeObservations, visible: Index, T_candidate: Array, points_board: Array, counts: Array
) -> RangeObservations:
    """Beams to points (V, n, 3) of the boards, weighted as ``counts`` (V,) beams."""
    points = se3.apply(T_candidate[visible], points_board).reshape(-1, 3)
    ranges = np.linalg.norm(points, axis=-1)
    each = points_board.shape[1]
    beams = views.with_beams(visible, np.arange(len(visible)) * each, points / ranges[:, None], ranges)
    beams = beams.update_noise(T_candidate[visible], views.noise_scale)
    return replace(beams, sigma=beams.sigma * np.sqrt(each / np.repeat(np.maximum(counts, 1e-6), each)))


def add_drifts(
    suggestions: Sequence[Suggestion],
    kinds: Mapping[str, str],
    before: RigSolution,
    after: RigSolution,
    serial_correlation: float,
) -> tuple[Suggestion, ...]:
    """Suggestions with standard deviations like those of the published poses.

    Args:
        suggestions: by the equations of the solution alone.
        kinds: by sensor.
        before: the solution without drifts,
        after: and with them, which a further capture leaves as they are.
        serial_correlation: the factor of variances that is in ``after`` as well.
    """

    def variance(solution: RigSolution, one: Suggestion) -> float:
        stddev = stddev_along_axes(solution.T_root_sensor[one.sensor], solution.covariance[one.sensor])
        return float(stddev[axis_names(kinds[one.sensor]).index(one.axis)] ** 2)

    added = [variance(after, one) - serial_correlation * variance(before, one) for one in suggestions]
    return tuple(
        replace(
            one,
            stddev=float(np.sqrt(max(serial_correlation * one.stddev**2 + by_drifts, 0.0))),
            expected=float(np.sqrt(max(serial_correlation * one.expected**2 + by_drifts, 0.0))),
        )
        for one, by_drifts in zip(suggestions, added, strict=True)
    )


def add_suggestions(calibration: Calibration, suggestions: Sequence[Suggestion]) -> Calibration:
    """The calibration with the suggested board poses.

    Args:
        calibration: poses and verdicts.
        suggestions: see :func:`calgraph.rig.checks.next_best_pose.suggest_board_poses`.
    """
    remedied = {one.sensor for one in calibration.evidence.remedies}
    return replace(
        calibration,
        sensors=tuple(
            one if one.name in remedied else _add_advice(one, suggestions) for one in calibration.sensors
        ),
        evidence=replace(calibration.evidence, suggestions=tuple(suggestions)),
    )


def _add_advice(sensor: SensorPose, suggestions: Sequence[Suggestion]) -> SensorPose:
    """The sensor with the first pose suggested for it in its verdict, unless it is good."""
    first = next((s for s in suggestions if s.sensor == sensor.name), None)
    if first is None or sensor.verdict.grade == "good":
        return sensor
    return replace(sensor, verdict=Verdict(sensor.verdict.grade, f"{sensor.verdict.reason}; first {first.hold}"))
