"""What ideal detectors report of a simulated robot: measurements with exactly the noise that its rig.yaml states.

Neither images nor clouds of the room are made, so a recording takes a fraction of a second, and hundreds of them
tell how an estimator's errors compare with its covariances. Planes, lines and poses are the library's own fits.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calgraph.captures import CaptureSet, Hold, RecordingTimeline, SensorCapture, SensorTimes, collect_detections
from calgraph.config import Board, Checkerboard, PixelNoise, RangeNoise, Rig
from calgraph.detection import Detection, PlanePatch, compute_landmarks
from calgraph.detection.board_edges import EDGE_BLUR
from calgraph.detection.board_pose import fit_pose
from calgraph.detection.camera import make_board_corners
from calgraph.detection.lidar2d import build_segment
from calgraph.detection.line_plane_fit import fit_line, fit_plane
from calgraph.errors import Rejected
from calgraph.geometry import Array, plane, se3
from calgraph.sensors import CameraModel
from calgraph.simulation.motion import board_pose
from calgraph.simulation.rig_simulation import rig_of
from calgraph.simulation.robot import MountedCamera, MountedScanner, RobotSensor
from calgraph.simulation.solids import Sheet, Solid, cast
from calgraph.simulation.truth import Truth
from calgraph.simulation.world import Stage, truth_of

_MARGIN = 0.02
"""Beams this near to the sheet's outline are left out, as detectors do, m."""
_LEAST_BEAMS, _LEAST_POINTS, _LEAST_RINGS = 5, 20, 3
"""Different beams of a 2-D and of a 3-D scanner, and rings, that have to hit the board."""
_FLAT = 1e-6
"""Flatter than this, a cosine or an angle in rad, beams meet no board."""
_LEAST_RANGE_NOISE, _LEAST_ANGLE_NOISE = 1e-4, 1e-5
"""Solvers cannot weigh with a noise of zero: less than this (m and rad) is never stated."""

Found = tuple[Detection, ...] | Rejected


@dataclass(frozen=True)
class DetectionKnobs:
    """How the ideal detectors measure; the noise of the scanners' ranges is the scenario's."""

    pixel: float = 0.3
    """Standard deviation of a corner in x and in y, pixels."""
    angle: float = 0.0
    """Standard deviation of a beam's direction, rad."""
    sweeps: int = 2
    """Scans or sweeps that a scanner makes of each resting board."""
    stated: float = 1.0
    """What rig.yaml states, as a multiple of the noise that there is."""


def simulate_detections(
    stage: Stage, seed: int, knobs: DetectionKnobs | None = None
) -> tuple[Rig, CaptureSet, Truth]:
    """One recording's detections: the corners in view and the beams on the board, truth plus Gaussian noise.

    Every sensor measures at some time of its own in the hold. In a disturbed one, some therefore see the board
    where it was before it slipped, and others where it is afterwards.

    Args:
        stage: robot and board poses; the same for any number of recordings.
        seed: of the noise, and of the times of measurement.
        knobs: how the detectors measure.

    Returns:
        The rig with its stated noise, the detections, and the truth with the board's pose in every capture.

    """
    knobs = knobs or DetectionKnobs()
    rig, t0 = rig_of(stage), stage.scenario.start_time
    sensors = {
        sensor.name: rig.sensors[sensor.name].model_copy(update={"noise": _stated_noise(sensor, knobs)})
        for sensor in stage.robot
    }
    times = {s.name: SensorTimes(np.zeros(0), 0.0, np.zeros(0), s.frame_id) for s in stage.robot}
    holds = [Hold(i, t0 + hold.start, t0 + hold.end) for i, hold in enumerate(stage.timeline.holds)]
    cameras = {s.name: s.camera for s in stage.robot if isinstance(s, MountedCamera)}
    rig = rig.model_copy(update={"sensors": sensors})
    captured = collect_detections(
        rig, RecordingTimeline(t0, times, np.zeros(0)), holds, _observations(stage, seed, knobs), cameras
    )
    return rig, captured, truth_of(stage)


def _observations(stage: Stage, seed: int, knobs: DetectionKnobs) -> Iterator[SensorCapture]:
    for k, sensor in enumerate(stage.robot):
        detect = _detector(sensor, stage.scenario.board, knobs)
        T_sensor_world = se3.inverse(sensor.T_world_sensor)
        for i, hold in enumerate(stage.timeline.holds):
            # A generator for each: a slip in one capture must not change the noise in another.
            rng = np.random.default_rng((stage.seed, seed, 1 + k, 1 + i))
            stance = stage.timeline.stance(rng.uniform(hold.start, hold.end)) or hold.stance
            yield SensorCapture(i, sensor.name, detect(T_sensor_world @ board_pose(stance), rng))


def _detector(
    sensor: RobotSensor, board: Board, knobs: DetectionKnobs
) -> Callable[[Array, np.random.Generator], Found]:
    """What a sensor finds of a board at a pose in its frame."""
    if isinstance(sensor, MountedCamera):
        return partial(_corners, sensor.camera, board, knobs)
    return partial(_segment if sensor.kind == "lidar2d" else _patch, sensor, board, knobs)


def _stated_noise(sensor: RobotSensor, knobs: DetectionKnobs) -> PixelNoise | RangeNoise:
    return _pixel_noise(knobs) if isinstance(sensor, MountedCamera) else _range_noise(sensor, knobs)


def _pixel_noise(knobs: DetectionKnobs) -> PixelNoise:
    return PixelNoise(pixel=knobs.stated * knobs.pixel)


def _range_noise(scanner: MountedScanner, knobs: DetectionKnobs) -> RangeNoise:
    return RangeNoise(
        range=max(knobs.stated * scanner.noise.range, _LEAST_RANGE_NOISE),
        angle=max(knobs.stated * knobs.angle, _LEAST_ANGLE_NOISE),
    )


def _corners(
    camera: CameraModel, board: Board, knobs: DetectionKnobs, T_camera_board: Array, rng: np.random.Generator
) -> Found:
    """The pose of the board from its marks that lie in the image as a whole."""
    marks = compute_landmarks(board)
    if plane.from_pose(T_camera_board)[3] <= 0:
        return Rejected("the board shows its back")
    true = camera.project(se3.apply(T_camera_board, marks.corners.reshape(-1, 3)))
    shown = camera.contains(true).reshape(marks.corners.shape[:2]).all(axis=1)
    # Chessboards are told from other corners by having all of them.
    if not (shown.all() if isinstance(board.pattern, Checkerboard) else shown.any()):
        return Rejected("no mark of the board lies in the image as a whole")
    pixels = (true + rng.normal(0.0, knobs.pixel, true.shape)).reshape(*marks.corners.shape[:2], 2)[shown]
    corners = marks.corners[shown]
    pose = fit_pose(marks.ids[shown], corners, pixels, camera, _pixel_noise(knobs).pixel)
    return pose if isinstance(pose, Rejected) else (make_board_corners(pose, corners, pixels),)


def _patch(
    scanner: MountedScanner, board: Board, knobs: DetectionKnobs, T_sensor_board: Array, rng: np.random.Generator
) -> Found:
    """The plane through all beams of a 3-D scanner that hit the board."""
    hits = _hits(scanner, board, T_sensor_board)
    rings = scanner.pattern.rings
    if len(hits) < _LEAST_POINTS or (rings is not None and len(np.unique(rings[hits])) < _LEAST_RINGS):
        return Rejected(f"only {len(hits)} beams hit the board")
    true = plane.towards_origin(plane.from_pose(T_sensor_board))
    _, points = _measured(scanner, hits, true, knobs, rng)
    noise = _range_noise(scanner, knobs)
    fit = fit_plane(points, noise.range, noise.angle, true)
    if fit is None:
        return Rejected("the beams graze the board")
    middle = points.mean(axis=0)
    center = middle - plane.distance(fit.parameters, middle[None]) * fit.parameters[:3]
    edges = _edges(scanner, board, T_sensor_board, rng)
    return (PlanePatch(fit.parameters, fit.covariance, points, center, edges=edges),)


def _segment(
    scanner: MountedScanner, board: Board, knobs: DetectionKnobs, T_sensor_board: Array, rng: np.random.Generator
) -> Found:
    """The line through all beams of a 2-D scanner that hit the board."""
    hits = _hits(scanner, board, T_sensor_board)
    if len(hits) < _LEAST_BEAMS:
        return Rejected(f"only {len(hits)} beams hit the board")
    true = plane.towards_origin(plane.from_pose(T_sensor_board))
    ranges, points = _measured(scanner, hits, true, knobs, rng)
    angles, noise = np.tile(scanner.pattern.angles[hits], knobs.sweeps), _range_noise(scanner, knobs)
    # The cut of the plane n x + d = 0 with z = 0; its normal points at the scanner, the line's away from it.
    start = np.array([np.arctan2(-true[1], -true[0]), true[3] / np.hypot(true[0], true[1])])
    fit = fit_line(angles, ranges, np.full_like(ranges, noise.range), np.full_like(ranges, noise.angle), start)
    if fit is None:
        return Rejected("the beams graze the board")
    spacing = float(np.diff(scanner.pattern.angles[:2])[0])
    segment = build_segment(angles[[0, len(hits) - 1]], spacing, fit, points)
    length, least = float(np.linalg.norm(np.diff(segment.endpoints, axis=0))), min(board.size) / 3
    if length < least:
        return Rejected(f"the scan cuts off a corner of the board, {length:.2f} m long")
    return (replace(segment, edges=_edges(scanner, board, T_sensor_board, rng)),)


def _hits(scanner: MountedScanner, board: Board, T_sensor_board: Array) -> NDArray[np.intp]:
    """Which beams of one sweep hit the sheet clear of its outline, within the scanner's range."""
    width, height = board.size
    sheet = Solid(Sheet(width - 2 * _MARGIN, height - 2 * _MARGIN), T_sensor_board)
    ranges = cast([sheet], scanner.pattern.origins, scanner.pattern.directions).ranges
    return np.flatnonzero((ranges >= scanner.noise.min_range) & (ranges <= scanner.noise.max_range))


def _edges(scanner: MountedScanner, board: Board, T_sensor_board: Array, rng: np.random.Generator) -> Array:
    """(M, 2, 3) beams next to each other of which one hits the sheet, and the other one goes past it.

    How far the outline is from either is drawn, as if the scanner's beams pointed elsewhere each time: of several
    sweeps at rest all would see the same.
    """
    pattern, half = scanner.pattern, 0.5 * np.array(board.size)
    T_board_sensor = se3.inverse(T_sensor_board)
    origins = se3.apply(T_board_sensor, np.broadcast_to(pattern.origins, pattern.directions.shape))
    along = pattern.directions @ T_board_sensor[:3, :3].T
    reach = -origins[:, 2] / np.where(np.abs(along[:, 2]) < _FLAT, np.nan, along[:, 2])
    hit = (origins + reach[:, None] * along)[:, :2]
    ahead = (reach >= scanner.noise.min_range) & (reach <= scanner.noise.max_range)
    on = ahead & np.all(np.abs(hit) <= half, axis=1)
    ends = np.flatnonzero(ahead & ahead[pattern.neighbours] & (on != on[pattern.neighbours]))
    other = pattern.neighbours[ends]
    last, past = np.where(on[ends], ends, other), np.where(on[ends], other, ends)
    step = hit[past] - hit[last]
    # The side that the beams cross first, and where.
    walls = (np.sign(step) * half - hit[last]) / np.where(step == 0, np.nan, step)
    side = np.nanargmin(walls, axis=1)[:, None]
    share = np.take_along_axis(walls, side, axis=1) - rng.uniform(size=(len(ends), 1))
    moved = share * step + rng.normal(0.0, EDGE_BLUR, (len(ends), 2))
    ends_on_board = np.stack([hit[last] + moved, hit[past] + moved], axis=1)
    at = se3.apply(T_sensor_board, np.concatenate([ends_on_board, np.zeros((len(ends), 2, 1))], axis=-1))
    return np.asarray(at / np.linalg.norm(at, axis=-1, keepdims=True))


def _measured(
    scanner: MountedScanner,
    hits: NDArray[np.intp],
    surface: Array,
    knobs: DetectionKnobs,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Ranges (N,) and end points (N, 3) of beams to a plane (4,), sweep after sweep, in the sensor frame, m.

    Beams point off their nominal direction by the angle noise, and are reported as if they did not.
    """
    pattern, beams = scanner.pattern, np.tile(hits, knobs.sweeps)
    error = rng.normal(0.0, knobs.angle, len(beams))[:, None]
    directions = np.cos(error) * pattern.directions[beams] + np.sin(error) * pattern.sideways[beams]
    origins = np.broadcast_to(pattern.origins, pattern.directions.shape)[beams]
    true = -plane.distance(surface, origins) / (directions @ surface[:3])
    ranges = true + rng.normal(0.0, scanner.noise.range, len(beams))
    return ranges, origins + ranges[:, None] * pattern.directions[beams]
