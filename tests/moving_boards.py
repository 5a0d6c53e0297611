"""Detections of a board that never rests, in synchronized frames.

They are those of ideal detectors, with what an estimator does not know: true times that differ from stamps,
shutters that read the image row by row, sweeps that last, and hands that tremble. Stamps of a set of frames lie
within the spread; true times differ from stamps by the jitter, and cameras read their rows one after the other
during the readout. Neither is an input of the estimator.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, RotationSpline

from calgraph.boards.detections import BoardCorners, Detection
from calgraph.config import Capture, Rig
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3
from calgraph.rig.captures.detect import CaptureSet, SensorCapture, collect_detections
from calgraph.rig.captures.holds import Hold, find_holds
from calgraph.rig.captures.moving_board import compensate_motion
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes
from calgraph.rig.detection.from_measurements import board_corners_from_pixels
from calgraph.simulation import (
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    World,
    ground_truth,
    world_rig,
)
from calgraph.simulation.motion import pose_from_placement
from calgraph.simulation.robot import MountedCamera, RobotSensor
from ideal_detections import IdealDetectorOptions, as_scanner, make_ideal_detector
from rig_errors import ModelErrors

_TREMOR_FREQUENCIES = (2.0, 7.0)
"""Bounds of the frequency of a hand's tremor, Hz (physiological tremor of an arm with a load)."""


@dataclass(frozen=True)
class MovingBoardOptions:
    """How the board moves, and when it is measured."""

    speed: float = 0.3
    """Mean speed of the board along its path, m/s; it rotates from pose to pose in the same time."""
    tremor: float = 0.001
    """Amplitude of the tremor along each axis, m."""
    rate: float = 10.0
    """Sets of frames per second."""
    spread: float = 0.0
    """Time between the first and the last stamp of a set, s: stamps are uniform within it."""
    jitter: float = 0.0
    """Standard deviation of the true time of a measurement about its stamp, s."""
    readout: float = 0.0
    """Time from the first to the last row of an image, s; the stamp is of the first."""
    captures: int = 40
    """Sets of frames that are captures."""


def simulate_moving_detections(
    world: World, seed: int, motion: MovingBoardOptions, options: IdealDetectorOptions | None = None
) -> tuple[Rig, CaptureSet, GroundTruth]:
    """Simulates the detections of a board that passes the placements of a world's captures without resting.

    Args:
        world: robot and board poses.
        seed: of noise, stamps and tremor.
        motion: of the board, and stamps.
        options: noise of the detectors.

    Returns:
        The rig, the detections at the times of their captures with the velocities of the board, and the ground
        truth of the sensors.
    """
    options = options or IdealDetectorOptions(scans_per_hold=1)
    rng = np.random.default_rng((world.seed, seed, 0))
    path, duration = _move_along([pose_from_placement(h.placement) for h in world.trajectory.holds], motion, rng)
    rig, t0 = world_rig(world), world.scenario.start_time
    shots = np.arange(0.2, duration - 0.2, 1 / motion.rate)
    stamps = {s.name: shots + motion.spread * rng.uniform(-0.5, 0.5, len(shots)) for s in world.robot}
    truth = {name: of + motion.jitter * rng.standard_normal(len(of)) for name, of in stamps.items()}
    timeline = RecordingTimeline(
        t0,
        {s.name: SensorTimes(t0 + stamps[s.name], 0.0, np.zeros(len(shots)), s.frame_id) for s in world.robot},
        np.zeros(0),
    )
    settings = rig.settings.captures
    moving_settings = settings.moving_board.model_copy(update={"max_captures": motion.captures})
    capture = Capture(mode="synchronized", max_spread=motion.spread + 1e-3)
    holds = find_holds(timeline, capture, settings.model_copy(update={"moving_board": moving_settings}))
    cameras = {s.name: s.camera for s in world.robot if isinstance(s, MountedCamera)}
    noise = {
        s.name: rig.sensors[s.name].model_copy(update={"noise": options.stated_noise(s)}) for s in world.robot
    }
    rig = rig.model_copy(update={"sensors": noise, "capture": capture})
    found = [
        capture_
        for k, sensor in enumerate(world.robot)
        for capture_ in _detect_all(
            sensor, world, holds, dict(zip((t0 + stamps[sensor.name]).tolist(), truth[sensor.name], strict=True)),
            path, motion, options, np.random.default_rng((world.seed, seed, 1 + k)),
        )
    ]  # fmt: skip
    captures = collect_detections(rig, timeline, holds, found, cameras)
    return rig, compensate_motion(captures, moving_settings), ground_truth(world)


def _move_along(
    poses: list[Array], motion: MovingBoardOptions, rng: np.random.Generator
) -> tuple[Callable[[Array], Array], float]:
    """The pose (..., 4, 4) of the board at times (...), and the duration of its path."""
    positions = np.array([T[:3, 3] for T in poses])
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    # Poses at one place differ by their rotation: as a path of the board's rim.
    rotations = Rotation.from_matrix(np.array([T[:3, :3] for T in poses]))
    steps = np.maximum(steps, 0.4 * (rotations[:-1].inv() * rotations[1:]).magnitude())
    knots = np.concatenate([[0.0], np.cumsum(steps)]) / motion.speed
    position, rotation = CubicSpline(knots, positions), RotationSpline(knots, rotations)
    frequency = rng.uniform(*_TREMOR_FREQUENCIES, (4, 3))
    phase = rng.uniform(0, 2 * np.pi, (4, 3))

    def pose_at(time: Array) -> Array:
        t = np.asarray(time, dtype=np.float64)
        waves = np.sin(2 * np.pi * frequency * t[..., None, None] + phase).sum(axis=-2) / 2
        R = rotation(t.ravel()).as_matrix().reshape(*t.shape, 3, 3)
        return se3.pose(R, position(t) + motion.tremor * waves)

    return pose_at, float(knots[-1])


def _detect_all(
    sensor: RobotSensor,
    world: World,
    holds: tuple[Hold, ...],
    true_time: dict[float, float],
    path: Callable[[Array], Array],
    motion: MovingBoardOptions,
    options: IdealDetectorOptions,
    rng: np.random.Generator,
) -> Iterator[SensorCapture]:
    """The detections of one sensor in all holds."""
    T_sensor_world = se3.inverse(sensor.T_world_sensor)
    detect = make_ideal_detector(sensor, world.scenario.board, options, ModelErrors())
    beams = None if isinstance(sensor, MountedCamera) else cKDTree(as_scanner(sensor).pattern.directions)

    def at(time: Array) -> Array:
        return np.asarray(T_sensor_world @ path(time))

    for hold in holds:
        if not len(hold.stamps[sensor.name]):
            continue
        start = true_time[float(hold.stamps[sensor.name][0])]
        middle = start if isinstance(sensor, MountedCamera) else start + _mean_time(sensor, at, start)
        found = detect(at(np.array([middle])), 0.0, rng)
        if not isinstance(found, Rejected):
            found = _blur(sensor, found[0], at, start, middle, motion, beams)
        yield SensorCapture(hold.index, sensor.name, found)


def _mean_time(sensor: RobotSensor, at: Callable[[Array], Array], start: float) -> float:
    """Mean time of the beams that point at the board, s after the stamp."""
    pattern = as_scanner(sensor).pattern
    mean = float(pattern.times.mean())
    for _ in range(2):
        center = at(np.array(start + mean))[:3, 3]
        bearing = center / np.linalg.norm(center)
        near = pattern.directions @ bearing > np.cos(0.15)
        mean = float(pattern.times[near].mean()) if near.any() else mean
    return mean


def _blur(
    sensor: RobotSensor,
    found: Detection,
    at: Callable[[Array], Array],
    start: float,
    middle: float,
    motion: MovingBoardOptions,
    beams: cKDTree | None,
) -> tuple[Detection, ...] | Rejected:
    """The detection with every row or beam at its own time."""
    T = at(np.array(middle))
    if isinstance(found, BoardCorners):
        assert isinstance(sensor, MountedCamera)
        if not motion.readout:
            return (found,)
        rows = found.pixels[:, 1] / sensor.camera.height
        own = _project(sensor, at(start + motion.readout * rows), found.corners_board)
        pixels = found.pixels + own - _project(sensor, np.broadcast_to(T, (len(rows), 4, 4)), found.corners_board)
        corners = board_corners_from_pixels(found.corners_board, pixels, sensor.camera)
        return corners if isinstance(corners, Rejected) else (corners,)
    assert beams is not None
    times = as_scanner(sensor).pattern.times[beams.query(found.directions)[1]]
    n, c = T[:3, 2], T[:3, 3]
    own_n, own_c = (own := at(start + times))[:, :3, 2], own[:, :3, 3]
    u = found.directions
    shift = np.sum(own_n * own_c, axis=1) / np.sum(own_n * u, axis=1) - (n @ c) / (u @ n)
    return (replace(found, ranges=found.ranges + shift, times=times),)


def _project(sensor: MountedCamera, T_camera_board: Array, corners: Array) -> Array:
    """(N, 2) pixels of corners (N, 3) of boards (N, 4, 4)."""
    return sensor.camera.project(
        (T_camera_board[:, :3, :3] @ corners[..., None])[..., 0] + T_camera_board[:, :3, 3]
    )


def scenario() -> RigScenario:
    """The robot, and the places that the board passes."""
    return RigScenario(
        camera=CameraOptions(count=2),
        laser=LaserOptions(count=1),
        spinning=SpinningOptions(count=0),
        multibeam=MultibeamOptions(count=1),
        bearings=(-40, -25, -10, 10, 25, 40),
    )
