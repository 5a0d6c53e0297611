"""Detections of ideal detectors on a simulated robot: measurements with exactly the noise stated in rig.yaml.

Neither images nor clouds are rendered, so a recording takes a fraction of a second, and hundreds of them compare
an estimator's errors with its covariances. Planes, lines and poses are fitted by the library's detectors.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from calgraph.boards.board_beams import MIN_BEAMS, MIN_POINTS, MIN_RINGS, find_beams_on_board, find_crossings
from calgraph.boards.board_pose import fit_pose
from calgraph.boards.camera import make_board_corners
from calgraph.boards.detections import DetectionResult, PlanePatch, to_beams
from calgraph.boards.printed_boards import compute_landmarks, select_marks_in_view
from calgraph.config import Board, PixelNoise, RangeNoise, Rig
from calgraph.config.settings import DetectionSettings
from calgraph.errors import InputError, Rejected
from calgraph.geometry import Array, Index, plane, se3, so3
from calgraph.rig.captures.detect import CaptureSet, SensorCapture, collect_detections
from calgraph.rig.captures.holds import Hold
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes
from calgraph.rig.checks.next_best_pose import MIN_SEGMENT_SHARE
from calgraph.rig.detection.lidar2d import build_segment
from calgraph.rig.detection.line_plane_fit import fit_line, fit_plane
from calgraph.sensors import CameraModel
from calgraph.sensors.beam_pattern import BeamPattern
from calgraph.simulation.motion import pose_from_placement
from calgraph.simulation.rig_simulation import world_rig
from calgraph.simulation.robot import MountedCamera, MountedScanner, RobotSensor
from calgraph.simulation.truth import GroundTruth
from calgraph.simulation.world import World, ground_truth
from rig_errors import BoardErrors, CameraErrors, ModelErrors, ScannerErrors

_EDGE_BLUR = 0.002
"""Standard deviation of the board's edges, m: boards are not cut, and beams not collimated, more sharply."""


@dataclass(frozen=True, eq=False)
class IdealBeams:
    """The beams of one scanner and the board that they measure."""

    scanner: MountedScanner
    """As stated."""
    errors: ScannerErrors
    board: Board
    """As stated."""
    board_errors: BoardErrors
    angle_noise: float
    """Standard deviation of a beam's direction, rad."""

    @property
    def stated(self) -> BeamPattern:
        """The beams in the directions that messages state."""
        return self.scanner.pattern

    @cached_property
    def true(self) -> BeamPattern:
        """The beams in their true directions."""
        return self.errors.true_pattern(self.stated)

    def on_board(self, T_sensor_board: Array) -> Index:
        """Indices of the beams of one sweep that hit the board clear of its outline, within range."""
        return find_beams_on_board(self.true, T_sensor_board, self._true_size, self._limits)

    @property
    def _true_size(self) -> tuple[float, float]:
        return self.board_errors.true_size(self.board)

    @property
    def _limits(self) -> tuple[float, float]:
        return self.scanner.noise.min_range, self.scanner.noise.max_range

    def measure(self, hits: Index, T_sensor_board: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Ranges (M N,), m, and end points (M N, 3) of the beams ``hits`` (N,), sweep after sweep.

        Beams deviate from their true direction by the angle noise; end points use the stated direction.

        Args:
            hits: beams on the board.
            T_sensor_board: (M, 4, 4) of the board in each sweep.
            rng: of the noise.
        """
        sweeps = len(T_sensor_board)
        beams = np.tile(hits, sweeps)
        error = rng.normal(0.0, self.angle_noise, len(beams))[:, None]
        directions = np.cos(error) * self.true.directions[beams] + np.sin(error) * self.true.sideways[beams]
        origins = np.broadcast_to(self.true.origins, self.true.directions.shape)[beams]
        T_board_sensor = se3.inverse(T_sensor_board)
        starts = se3.apply(T_board_sensor, origins.reshape(sweeps, -1, 3))
        rays = directions.reshape(sweeps, -1, 3) @ np.swapaxes(T_board_sensor[:, :3, :3], 1, 2)
        starts, rays = starts.reshape(-1, 3), rays.reshape(-1, 3)
        true = self.board_errors.distance(self.board, starts, rays)
        of_print = self.board_errors.range_bias(self.board, (starts + true[:, None] * rays)[:, :2])
        rings = None if self.stated.rings is None else self.stated.rings[beams]
        noise = rng.normal(0.0, self.scanner.noise.range_noise, len(beams))
        ranges = self.errors.measured_ranges(true, rings) + of_print + noise
        return ranges, origins + ranges[:, None] * self.stated.directions[beams]

    def edge_directions(self, T_sensor_board: Array, rng: np.random.Generator) -> Array:
        """(M, 2, 3) stated directions of neighbouring beams: the first hits the board, the second misses it.

        The distance of the outline from either is drawn at random: identical beams of several sweeps at rest would
        give identical edges. A divergent beam still hits the board while its axis has passed the outline.
        """
        pattern = self.true
        crossings = find_crossings(pattern, T_sensor_board, self._true_size, self._limits)
        last, past, step = crossings.last, crossings.past, crossings.step
        share = crossings.share - rng.uniform(size=(len(last), 1))
        angle = np.linalg.norm(np.cross(pattern.directions[last], pattern.directions[past]), axis=1, keepdims=True)
        share += 0.5 * self.errors.divergence / angle
        moved = share * step + rng.normal(0.0, _EDGE_BLUR, (len(last), 2))
        ends_on_board = np.stack([crossings.hit + moved, crossings.hit + step + moved], axis=1)
        height = self.board_errors.height(self.board, ends_on_board)[..., None]
        at = se3.apply(T_sensor_board, np.concatenate([ends_on_board, height], axis=-1))
        # Messages state these directions as wrongly as those of the beams.
        turn = np.cross(pattern.directions[last], self.stated.directions[last])
        R_stated_true = so3.exp(turn)[:, None]
        directions = at / np.linalg.norm(at, axis=-1, keepdims=True)
        return np.asarray((R_stated_true @ directions[..., None])[..., 0])


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
        return _range_noise(as_scanner(sensor), self)


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
    bias = np.random.default_rng((seed, run, 1 + sensor, 1 + capture, 2)).standard_normal(6)
    motion += bias * np.repeat([board.view_bias, board.view_tilt], 3)
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
    scanner = as_scanner(sensor)
    beams = IdealBeams(scanner, errors.of_scanner(sensor.name), board, errors.board, options.angle)
    return partial(_detect_segment if sensor.kind == "lidar2d" else _detect_plane, beams, options)


def as_scanner(sensor: RobotSensor) -> MountedScanner:
    """The sensor, which measures along beams.

    Raises:
        InputError: it is a depth camera, of which there are images, but no ideal detections.
    """
    if isinstance(sensor, MountedScanner):
        return sensor
    raise InputError(f"{sensor.name}: there are no ideal detections of a {sensor.kind}; simulate a recording")


def _range_noise(scanner: MountedScanner, options: IdealDetectorOptions) -> RangeNoise:
    return RangeNoise(
        range=max(options.stated_noise_factor * scanner.noise.range_noise, _MIN_RANGE_NOISE),
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
    in_view = select_marks_in_view(board, camera, true.reshape(*marks.corners.shape[:2], 2))
    if not in_view.any():
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
    if len(hits) < MIN_POINTS or (rings is not None and len(np.unique(rings[hits])) < MIN_RINGS):
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
    if len(hits) < MIN_BEAMS:
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
    length, least = (
        float(np.linalg.norm(np.diff(segment.endpoints, axis=0))),
        MIN_SEGMENT_SHARE * min(beams.board.size),
    )
    if length < least:
        return Rejected(f"the scan cuts off a corner of the board, {length:.2f} m long")
    return (replace(segment, edges=beams.edge_directions(T_sensor_board[0], rng)),)
