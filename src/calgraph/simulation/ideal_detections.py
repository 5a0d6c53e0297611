"""Detections of ideal detectors on a simulated robot: measurements with exactly the noise stated in rig.yaml.

Neither images nor clouds are rendered, so a recording takes a fraction of a second, and hundreds of them compare
an estimator's errors with its covariances. Planes, lines and poses are fitted by the library's detectors.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from calgraph.boards.board_pose import fit_pose
from calgraph.boards.camera import make_board_corners
from calgraph.boards.detections import DetectionResult, PlanePatch, to_beams
from calgraph.boards.landmarks import compute_landmarks
from calgraph.config import Board, Checkerboard, PixelNoise, RangeNoise, Rig
from calgraph.config.settings import DetectionSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, plane, se3
from calgraph.rig.captures.detect import CaptureSet, SensorCapture, collect_detections
from calgraph.rig.captures.holds import Hold
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes
from calgraph.rig.detection.lidar2d import build_segment
from calgraph.rig.detection.line_plane_fit import fit_line, fit_plane
from calgraph.sensors import CameraModel
from calgraph.simulation.ideal_beams import IdealBeams
from calgraph.simulation.model_errors import BoardErrors, CameraErrors, ModelErrors
from calgraph.simulation.motion import pose_from_placement
from calgraph.simulation.rig_simulation import world_rig
from calgraph.simulation.robot import MountedCamera, MountedScanner, RobotSensor
from calgraph.simulation.truth import GroundTruth
from calgraph.simulation.world import World, ground_truth

_MIN_BEAMS, _MIN_POINTS, _MIN_RINGS = 5, 20, 3
"""Minimum numbers of beams of a 2-D scanner, of beams and of rings of a 3-D scanner on the board."""
_MIN_RANGE_NOISE, _MIN_ANGLE_NOISE = 1e-4, 1e-5
"""Minimum stated noise, m and rad: a noise of zero gives no finite weight."""


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

    def stated_noise(self, sensor: RobotSensor) -> PixelNoise | RangeNoise:
        """The noise of a sensor in rig.yaml."""
        if isinstance(sensor, MountedCamera):
            return PixelNoise(pixel=self.stated_noise_factor * self.pixel)
        return _range_noise(sensor, self)


def simulate_detections(
    world: World, seed: int, options: IdealDetectorOptions | None = None, errors: ModelErrors | None = None
) -> tuple[Rig, CaptureSet, GroundTruth]:
    """Simulates the detections of one recording: corners in view and beams on the board with Gaussian noise.

    Each sensor measures at a random time of the hold. In a disturbed hold some sensors therefore measure the board
    before it slips, and others afterwards.

    Args:
        world: robot and board poses; the same for any number of recordings.
        seed: of the noise, and of the times of measurement.
        options: noise of the detectors.
        errors: in which the world differs from the rig; they do not change the noise.

    Returns:
        The rig with its stated noise, the detections, and the ground truth with the board's pose in every
        capture. After a bump it is the pose of the sensor at the end.

    Raises:
        InputError: the errors do not fit the sensors.
    """
    options, errors = options or IdealDetectorOptions(), errors or ModelErrors()
    errors.check(world.robot)
    rig, t0 = world_rig(world), world.scenario.start_time
    sensors = {
        sensor.name: rig.sensors[sensor.name].model_copy(update={"noise": options.stated_noise(sensor)})
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
        _simulate_observations(world, seed, options, errors),
        cameras,
    )
    at_end = [replace(s, T_world_sensor=errors.of_sensor(s).pose(s.T_world_sensor, 1.0)) for s in world.robot]
    return rig, captured, ground_truth(replace(world, robot=tuple(at_end)))


def _simulate_observations(
    world: World, seed: int, options: IdealDetectorOptions, errors: ModelErrors
) -> Iterator[SensorCapture]:
    for k, sensor in enumerate(world.robot):
        detect = make_ideal_detector(sensor, world.scenario.board, options, errors)
        of_sensor = errors.of_sensor(sensor)
        messages = 1 if isinstance(sensor, MountedCamera) else options.scans_per_hold
        for i, hold in enumerate(world.trajectory.holds):
            # Separate generators: a slip in one capture must not change the noise in another.
            rng = np.random.default_rng((world.seed, seed, 1 + k, 1 + i))
            placement = world.trajectory.placement_at(rng.uniform(hold.start, hold.end)) or hold.placement
            done = i / len(world.trajectory.holds)
            motion = _draw_motion(errors.board, of_sensor.delay, messages, (world.seed, seed, k, i))
            T_world_board = se3.retract(pose_from_placement(placement), motion)
            T_world_sensor = of_sensor.pose(sensor.T_world_sensor, done)
            yield SensorCapture(i, sensor.name, detect(se3.inverse(T_world_sensor) @ T_world_board, done, rng))


def _draw_motion(board: BoardErrors, delay: float, messages: int, key: tuple[int, int, int, int]) -> Array:
    """(M, 6) displacement of the board in each message of one sensor in one capture, along the world's axes."""
    seed, run, sensor, capture = key
    tremor = np.random.default_rng((seed, run, 1 + sensor, 1 + capture, 1)).standard_normal((messages, 6))
    velocity = np.random.default_rng((seed, run, 0, 1 + capture)).standard_normal(3)
    motion = tremor * np.repeat([board.tremor, board.tremor_rotation], 3)
    motion[:, :3] += board.speed * delay * velocity / np.linalg.norm(velocity)
    return np.asarray(motion)


def make_ideal_detector(
    sensor: RobotSensor, board: Board, options: IdealDetectorOptions, errors: ModelErrors
) -> Callable[[Array, float, np.random.Generator], DetectionResult]:
    """The detector of a sensor.

    It maps the board's pose (M, 4, 4) in the sensor frame in each message, and the share of the captures before
    this one, to a detection.
    """
    if isinstance(sensor, MountedCamera):
        lens = errors.of_camera(sensor.name)
        return partial(_detect_corners, sensor.camera, lens, board, errors.board, options)
    beams = IdealBeams(sensor, errors.of_scanner(sensor.name), board, errors.board, options.angle)
    return partial(_detect_segment if sensor.kind == "lidar2d" else _detect_plane, beams, options)


def _range_noise(scanner: MountedScanner, options: IdealDetectorOptions) -> RangeNoise:
    return RangeNoise(
        range=max(options.stated_noise_factor * scanner.noise.range, _MIN_RANGE_NOISE),
        angle=max(options.stated_noise_factor * options.angle, _MIN_ANGLE_NOISE),
    )


def _detect_corners(
    stated: CameraModel,
    errors: CameraErrors,
    board: Board,
    board_errors: BoardErrors,
    options: IdealDetectorOptions,
    T_camera_board: Array,
    done: float,
    rng: np.random.Generator,
) -> DetectionResult:
    """The pose of the board from the marks that lie fully in the image."""
    marks, camera = board_errors.true_landmarks(board), errors.true_camera(stated)
    if plane.from_pose(T_camera_board[0])[3] <= 0:
        return Rejected("the board faces away from the camera")
    true = camera.project(se3.apply(T_camera_board[0], marks.corners.reshape(-1, 3))) + errors.shift(done)
    in_view = camera.contains(true).reshape(marks.corners.shape[:2]).all(axis=1)
    # A chessboard is only recognised by all of its corners.
    if not (in_view.all() if isinstance(board.pattern, Checkerboard) else in_view.any()):
        return Rejected("no mark of the board lies fully in the image")
    pixels = (true + rng.normal(0.0, options.pixel, true.shape)).reshape(*marks.corners.shape[:2], 2)[in_view]
    corners = compute_landmarks(board).corners[in_view]
    sigma = options.stated_noise_factor * options.pixel
    pose = fit_pose(marks.ids[in_view], corners, pixels, stated, sigma)
    return pose if isinstance(pose, Rejected) else (make_board_corners(pose, corners, pixels),)


def _detect_plane(
    beams: IdealBeams, options: IdealDetectorOptions, T_sensor_board: Array, _done: float, rng: np.random.Generator
) -> DetectionResult:
    """The plane through all beams of a 3-D scanner that hit the board."""
    hits, rings = beams.on_board(T_sensor_board[0]), beams.stated.rings
    if len(hits) < _MIN_POINTS or (rings is not None and len(np.unique(rings[hits])) < _MIN_RINGS):
        return Rejected(f"only {len(hits)} beams hit the board")
    start = plane.towards_origin(plane.from_pose(T_sensor_board[0]))
    _, points = beams.measure(hits, T_sensor_board, rng)
    noise = _range_noise(beams.scanner, options)
    ranges, directions = to_beams(points)
    fit = fit_plane(ranges, directions, noise.range, noise.angle, start)
    if fit is None:
        return Rejected("the beams graze the board")
    middle = points.mean(axis=0)
    center = middle - plane.distance(fit.parameters, middle[None]) * fit.parameters[:3]
    edges = beams.edge_directions(T_sensor_board[0], rng)
    return (PlanePatch(fit.parameters, fit.covariance, ranges, directions, center, edges=edges),)


def _detect_segment(
    beams: IdealBeams, options: IdealDetectorOptions, T_sensor_board: Array, _done: float, rng: np.random.Generator
) -> DetectionResult:
    """The line through all beams of a 2-D scanner that hit the board."""
    hits, pattern = beams.on_board(T_sensor_board[0]), beams.stated
    if len(hits) < _MIN_BEAMS:
        return Rejected(f"only {len(hits)} beams hit the board")
    surface = plane.towards_origin(plane.from_pose(T_sensor_board[0]))
    ranges, _ = beams.measure(hits, T_sensor_board, rng)
    measured, noise = np.tile(hits, len(T_sensor_board)), _range_noise(beams.scanner, options)
    angles = pattern.angles[measured]
    # The cut of the plane n x + d = 0 with z = 0; its normal points at the scanner, the line's away from it.
    start = np.array([np.arctan2(-surface[1], -surface[0]), surface[3] / np.hypot(surface[0], surface[1])])
    sigmas = np.full_like(ranges, noise.range), np.full_like(ranges, noise.angle)
    fit = fit_line(angles, ranges, *sigmas, start)
    if fit is None:
        return Rejected("the beams graze the board")
    spacing = float(np.diff(pattern.angles[:2])[0])
    segment = build_segment(angles[[0, len(hits) - 1]], spacing, fit, ranges, pattern.directions[measured])
    length, least = float(np.linalg.norm(np.diff(segment.endpoints, axis=0))), min(beams.board.size) / 3
    if length < least:
        return Rejected(f"the scan cuts off a corner of the board, {length:.2f} m long")
    return (replace(segment, edges=beams.edge_directions(T_sensor_board[0], rng)),)
