"""Detections of ideal detectors on a simulated robot: measurements with exactly the noise stated in rig.yaml.

Neither images nor clouds are rendered, so a recording takes a fraction of a second, and hundreds of them compare
an estimator's errors with its covariances. Planes, lines and poses are fitted by the library's detectors.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calgraph.captures import CaptureSet, Hold, RecordingTimeline, SensorCapture, SensorTimes, collect_detections
from calgraph.config import Board, Checkerboard, PixelNoise, RangeNoise, Rig
from calgraph.config.settings import DetectionSettings
from calgraph.detection import DetectionResult, PlanePatch, compute_landmarks, to_beams
from calgraph.detection.board_pose import fit_pose
from calgraph.detection.camera import make_board_corners
from calgraph.detection.lidar2d import build_segment
from calgraph.detection.line_plane_fit import fit_line, fit_plane
from calgraph.errors import Rejected
from calgraph.geometry import Array, plane, se3
from calgraph.sensors import CameraModel
from calgraph.simulation.motion import pose_from_placement
from calgraph.simulation.rig_simulation import world_rig
from calgraph.simulation.robot import MountedCamera, MountedScanner, RobotSensor
from calgraph.simulation.solids import RectangleShape, Solid, cast_rays
from calgraph.simulation.truth import GroundTruth
from calgraph.simulation.world import World, ground_truth

_OUTLINE_MARGIN = 0.02
"""Beams this near to the board's outline are left out, as detectors do, m."""
_MIN_BEAMS, _MIN_POINTS, _MIN_RINGS = 5, 20, 3
"""Minimum numbers of beams of a 2-D scanner, of beams and of rings of a 3-D scanner on the board."""
_MIN_GRAZING = 1e-6
"""Minimum cosine between a beam and the board's normal; keeps divisions finite."""
_MIN_RANGE_NOISE, _MIN_ANGLE_NOISE = 1e-4, 1e-5
"""Minimum stated noise, m and rad: a noise of zero gives no finite weight."""
_EDGE_BLUR = 0.002
"""Standard deviation of the board's edges, m: boards are not cut, and beams not collimated, more sharply."""


@dataclass(frozen=True)
class IdealDetectorOptions:
    """Noise of the ideal detectors; the noise of the scanners' ranges is the scenario's."""

    pixel: float = 0.3
    """Standard deviation of a corner in x and in y, pixels."""
    angle: float = 0.0
    """Standard deviation of a beam's direction, rad."""
    scans_per_hold: int = 2
    """Scans or sweeps of each scanner per hold."""
    stated_noise_factor: float = 1.0
    """Noise stated in rig.yaml as a multiple of the true noise."""
    settings: DetectionSettings = DetectionSettings()
    """Of the fits to corners and beams."""


def simulate_detections(
    world: World, seed: int, options: IdealDetectorOptions | None = None
) -> tuple[Rig, CaptureSet, GroundTruth]:
    """Simulates the detections of one recording: corners in view and beams on the board with Gaussian noise.

    Each sensor measures at a random time of the hold. In a disturbed hold some sensors therefore measure the board
    before it slips, and others afterwards.

    Args:
        world: robot and board poses; the same for any number of recordings.
        seed: of the noise, and of the times of measurement.
        options: noise of the detectors.

    Returns:
        The rig with its stated noise, the detections, and the truth with the board's pose in every capture.
    """
    options = options or IdealDetectorOptions()
    rig, t0 = world_rig(world), world.scenario.start_time
    sensors = {
        sensor.name: rig.sensors[sensor.name].model_copy(update={"noise": _stated_noise(sensor, options)})
        for sensor in world.robot
    }
    times = {s.name: SensorTimes(np.zeros(0), 0.0, np.zeros(0), s.frame_id) for s in world.robot}
    holds = [Hold(i, t0 + hold.start, t0 + hold.end) for i, hold in enumerate(world.trajectory.holds)]
    cameras = {s.name: s.camera for s in world.robot if isinstance(s, MountedCamera)}
    rig = rig.model_copy(update={"sensors": sensors})
    captured = collect_detections(
        rig,
        RecordingTimeline(t0, times, np.zeros(0)),
        holds,
        _simulate_observations(world, seed, options),
        cameras,
    )
    return rig, captured, ground_truth(world)


def _simulate_observations(world: World, seed: int, options: IdealDetectorOptions) -> Iterator[SensorCapture]:
    for k, sensor in enumerate(world.robot):
        detect = _detector(sensor, world.scenario.board, options)
        T_sensor_world = se3.inverse(sensor.T_world_sensor)
        for i, hold in enumerate(world.trajectory.holds):
            # Separate generators: a slip in one capture must not change the noise in another.
            rng = np.random.default_rng((world.seed, seed, 1 + k, 1 + i))
            placement = world.trajectory.placement_at(rng.uniform(hold.start, hold.end)) or hold.placement
            yield SensorCapture(i, sensor.name, detect(T_sensor_world @ pose_from_placement(placement), rng))


def _detector(
    sensor: RobotSensor, board: Board, options: IdealDetectorOptions
) -> Callable[[Array, np.random.Generator], DetectionResult]:
    """The detector of a sensor: from a board pose in the sensor frame to a detection."""
    if isinstance(sensor, MountedCamera):
        return partial(_detect_corners, sensor.camera, board, options)
    return partial(_detect_segment if sensor.kind == "lidar2d" else _detect_plane, sensor, board, options)


def _stated_noise(sensor: RobotSensor, options: IdealDetectorOptions) -> PixelNoise | RangeNoise:
    return (
        PixelNoise(pixel=options.stated_noise_factor * options.pixel)
        if isinstance(sensor, MountedCamera)
        else _range_noise(sensor, options)
    )


def _range_noise(scanner: MountedScanner, options: IdealDetectorOptions) -> RangeNoise:
    return RangeNoise(
        range=max(options.stated_noise_factor * scanner.noise.range, _MIN_RANGE_NOISE),
        angle=max(options.stated_noise_factor * options.angle, _MIN_ANGLE_NOISE),
    )


def _detect_corners(
    camera: CameraModel,
    board: Board,
    options: IdealDetectorOptions,
    T_camera_board: Array,
    rng: np.random.Generator,
) -> DetectionResult:
    """The pose of the board from the marks that lie fully in the image."""
    marks = compute_landmarks(board)
    if plane.from_pose(T_camera_board)[3] <= 0:
        return Rejected("the board faces away from the camera")
    true = camera.project(se3.apply(T_camera_board, marks.corners.reshape(-1, 3)))
    in_view = camera.contains(true).reshape(marks.corners.shape[:2]).all(axis=1)
    # A chessboard is only recognised by all of its corners.
    if not (in_view.all() if isinstance(board.pattern, Checkerboard) else in_view.any()):
        return Rejected("no mark of the board lies fully in the image")
    pixels = (true + rng.normal(0.0, options.pixel, true.shape)).reshape(*marks.corners.shape[:2], 2)[in_view]
    corners = marks.corners[in_view]
    sigma, settings = options.stated_noise_factor * options.pixel, options.settings.camera.pose
    pose = fit_pose(marks.ids[in_view], corners, pixels, camera, sigma, settings)
    return pose if isinstance(pose, Rejected) else (make_board_corners(pose, corners, pixels),)


def _detect_plane(
    scanner: MountedScanner,
    board: Board,
    options: IdealDetectorOptions,
    T_sensor_board: Array,
    rng: np.random.Generator,
) -> DetectionResult:
    """The plane through all beams of a 3-D scanner that hit the board."""
    hits = _beams_on_board(scanner, board, T_sensor_board)
    rings = scanner.pattern.rings
    if len(hits) < _MIN_POINTS or (rings is not None and len(np.unique(rings[hits])) < _MIN_RINGS):
        return Rejected(f"only {len(hits)} beams hit the board")
    true = plane.towards_origin(plane.from_pose(T_sensor_board))
    _, points = _simulate_ranges(scanner, hits, true, options, rng)
    noise = _range_noise(scanner, options)
    beams = to_beams(points)
    fit = fit_plane(*beams, noise.range, noise.angle, true, options.settings.scanner.fit)
    if fit is None:
        return Rejected("the beams graze the board")
    middle = points.mean(axis=0)
    center = middle - plane.distance(fit.parameters, middle[None]) * fit.parameters[:3]
    edges = _edge_directions(scanner, board, T_sensor_board, rng)
    return (PlanePatch(fit.parameters, fit.covariance, *beams, center, edges=edges),)


def _detect_segment(
    scanner: MountedScanner,
    board: Board,
    options: IdealDetectorOptions,
    T_sensor_board: Array,
    rng: np.random.Generator,
) -> DetectionResult:
    """The line through all beams of a 2-D scanner that hit the board."""
    hits = _beams_on_board(scanner, board, T_sensor_board)
    if len(hits) < _MIN_BEAMS:
        return Rejected(f"only {len(hits)} beams hit the board")
    true = plane.towards_origin(plane.from_pose(T_sensor_board))
    ranges, _ = _simulate_ranges(scanner, hits, true, options, rng)
    beams, noise = np.tile(hits, options.scans_per_hold), _range_noise(scanner, options)
    angles = scanner.pattern.angles[beams]
    # The cut of the plane n x + d = 0 with z = 0; its normal points at the scanner, the line's away from it.
    start = np.array([np.arctan2(-true[1], -true[0]), true[3] / np.hypot(true[0], true[1])])
    sigmas = np.full_like(ranges, noise.range), np.full_like(ranges, noise.angle)
    fit = fit_line(angles, ranges, *sigmas, start, options.settings.scanner.fit)
    if fit is None:
        return Rejected("the beams graze the board")
    spacing = float(np.diff(scanner.pattern.angles[:2])[0])
    segment = build_segment(angles[[0, len(hits) - 1]], spacing, fit, ranges, scanner.pattern.directions[beams])
    length, least = float(np.linalg.norm(np.diff(segment.endpoints, axis=0))), min(board.size) / 3
    if length < least:
        return Rejected(f"the scan cuts off a corner of the board, {length:.2f} m long")
    return (replace(segment, edges=_edge_directions(scanner, board, T_sensor_board, rng)),)


def _beams_on_board(scanner: MountedScanner, board: Board, T_sensor_board: Array) -> NDArray[np.intp]:
    """Indices of the beams of one sweep that hit the board clear of its outline, within the scanner's range."""
    width, height = board.size
    solid = Solid(RectangleShape(width - 2 * _OUTLINE_MARGIN, height - 2 * _OUTLINE_MARGIN), T_sensor_board)
    ranges = cast_rays([solid], scanner.pattern.origins, scanner.pattern.directions).ranges
    return np.flatnonzero((ranges >= scanner.noise.min_range) & (ranges <= scanner.noise.max_range))


def _edge_directions(
    scanner: MountedScanner, board: Board, T_sensor_board: Array, rng: np.random.Generator
) -> Array:
    """(M, 2, 3) directions of neighbouring beams of which the first hits the board and the second misses it.

    The distance of the outline from either is drawn at random: identical beams of several sweeps at rest would
    give identical edges.
    """
    pattern, half = scanner.pattern, 0.5 * np.array(board.size)
    T_board_sensor = se3.inverse(T_sensor_board)
    origins = se3.apply(T_board_sensor, np.broadcast_to(pattern.origins, pattern.directions.shape))
    along = pattern.directions @ T_board_sensor[:3, :3].T
    reach = -origins[:, 2] / np.where(np.abs(along[:, 2]) < _MIN_GRAZING, np.nan, along[:, 2])
    hit = (origins + reach[:, None] * along)[:, :2]
    ahead = (reach >= scanner.noise.min_range) & (reach <= scanner.noise.max_range)
    on = ahead & np.all(np.abs(hit) <= half, axis=1)
    ends = np.flatnonzero(ahead & ahead[pattern.neighbours] & (on != on[pattern.neighbours]))
    other = pattern.neighbours[ends]
    last, past = np.where(on[ends], ends, other), np.where(on[ends], other, ends)
    step = hit[past] - hit[last]
    # The side of the outline that is crossed first, and where.
    walls = (np.sign(step) * half - hit[last]) / np.where(step == 0, np.nan, step)
    side = np.nanargmin(walls, axis=1)[:, None]
    share = np.take_along_axis(walls, side, axis=1) - rng.uniform(size=(len(ends), 1))
    moved = share * step + rng.normal(0.0, _EDGE_BLUR, (len(ends), 2))
    ends_on_board = np.stack([hit[last] + moved, hit[past] + moved], axis=1)
    at = se3.apply(T_sensor_board, np.concatenate([ends_on_board, np.zeros((len(ends), 2, 1))], axis=-1))
    return np.asarray(at / np.linalg.norm(at, axis=-1, keepdims=True))


def _simulate_ranges(
    scanner: MountedScanner,
    hits: NDArray[np.intp],
    surface: Array,
    options: IdealDetectorOptions,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Ranges (N,) and end points (N, 3) of beams to a plane (4,), sweep after sweep, in the sensor frame, m.

    Beams deviate from their nominal direction by the angle noise; end points use the nominal direction.
    """
    pattern, beams = scanner.pattern, np.tile(hits, options.scans_per_hold)
    error = rng.normal(0.0, options.angle, len(beams))[:, None]
    directions = np.cos(error) * pattern.directions[beams] + np.sin(error) * pattern.sideways[beams]
    origins = np.broadcast_to(pattern.origins, pattern.directions.shape)[beams]
    true = -plane.distance(surface, origins) / (directions @ surface[:3])
    ranges = true + rng.normal(0.0, scanner.noise.range, len(beams))
    return ranges, origins + ranges[:, None] * pattern.directions[beams]
