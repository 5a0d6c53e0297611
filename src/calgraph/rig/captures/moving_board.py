"""Detections of a moving board at the time of their capture: each sensor measured it a little earlier or later."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeGuard

import numpy as np

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch, Segment
from calgraph.config.settings import MovingBoardSettings
from calgraph.geometry import Array, plane, se3
from calgraph.rig.captures.detect import CaptureSet
from calgraph.sensors import CameraModel

_NO_VELOCITY = (
    "the velocity of the board is not known: it was not detected in the sensor's measurements before or after, or "
    "moved too fast between them"
)


@dataclass(frozen=True, eq=False)
class _Measured:
    """One sensor's detections of one capture, and when it measured them."""

    stamp: float
    detections: tuple[Detection, ...]
    """As at the time of the stamp."""
    original: tuple[Detection, ...]
    """As measured."""


@dataclass(frozen=True, eq=False)
class BoardMotion:
    """The motion of a board near the time of a measurement: quadratic in time."""

    T_sensor_board: Array
    """(4, 4) a pose whose z axis is the normal of the measured surface, at time 0."""
    velocity: Array
    """(6,) of its translation and rotation along the sensor's axes at time 0, m/s and rad/s."""
    acceleration: Array
    """(6,) m/s² and rad/s²."""

    def pose_at(self, time: float | Array) -> Array:
        """Poses (..., 4, 4) at times (...), s."""
        t = np.asarray(time)[..., None]
        return se3.retract(self.T_sensor_board, self.velocity * t + 0.5 * self.acceleration * t**2)

    def twist_at(self, time: float) -> Array:
        """(6,) velocity of the board's point at the sensor's origin, and of its rotation, at a time."""
        v, w = np.split(self.velocity + self.acceleration * time, 2)
        return np.concatenate([v - np.cross(w, self.pose_at(time)[:3, 3]), w])


# Maximum time between a measurement and the one that shows the velocity of the board, s: within it, the motion of
# a hand is a parabola to some millimetres.
_MAX_INTERVAL = 0.3


def compensate_motion(captures: CaptureSet, settings: MovingBoardSettings) -> CaptureSet:
    """Moves the detections of every capture to one time, the mean of its stamps, and adds the board's velocity.

    The motion is interpolated from the sensor's own detections in the measurements before and after. Holds that
    only serve for that are left out.

    Args:
        captures: with stamps of the holds; one message a sensor and hold.
        settings: limits of motion and of the time between measurements.
    """
    history = {name: _remove_skew(of, settings) for name, of in _order_by_time(captures).items()}
    detections: dict[str, dict[int, tuple[Detection, ...]]] = {name: {} for name in captures.detections}
    chosen = {hold.index for hold in captures.holds if not hold.auxiliary}
    rejections = {key: why for key, why in captures.rejections.items() if key[0] in chosen}
    for hold in captures.holds:
        measured = {
            name: (measured_at(hold.stamps[name], found[hold.index]), found[hold.index])
            for name, found in captures.detections.items()
            if hold.index in found and len(hold.stamps.get(name, ()))
        }
        if hold.auxiliary or not measured:
            continue
        reference = float(np.mean([stamp for stamp, _ in measured.values()]))
        for name, (stamp, found) in measured.items():
            at_stamp = next(one.detections for one in history[name] if one.original is found)
            before, after = _neighbours(history[name], stamp, _MAX_INTERVAL)
            moved = [
                move_detection(one, motion, reference - stamp, captures.cameras.get(name))
                for one, known in zip(found, at_stamp, strict=True)
                if (motion := estimate_motion(known, stamp, before, after, settings)) is not None
            ]
            if moved:
                detections[name][hold.index] = tuple(moved)
            else:
                rejections[hold.index, name] = _NO_VELOCITY
    holds = tuple(hold for hold in captures.holds if not hold.auxiliary)
    return replace(captures, holds=holds, detections=detections, rejections=rejections)


def measured_at(stamps: Array, detections: Sequence[Detection]) -> float:
    """When a board was measured, s: the mean time of its beams, or the stamp of the message."""
    times = np.zeros(0) if isinstance(detections[0], BoardCorners) else detections[0].times
    return float(stamps[0]) + (float(times.mean()) if len(times) else 0.0)


def estimate_motion(
    detection: Detection,
    stamp: float,
    before: _Measured | None,
    after: _Measured | None,
    settings: MovingBoardSettings,
) -> BoardMotion | None:
    """The motion of a detected board from the nearest detections before and after; None where it is not known."""
    T = surface_pose(detection)
    times: list[float] = []
    steps: list[Array] = []
    for measured in (before, after):
        step = None if measured is None else _step_to(T, detection, measured, measured.stamp - stamp, settings)
        if measured is not None and step is not None:
            times.append(measured.stamp - stamp)
            steps.append(step)
    if not steps:
        return None
    if len(steps) == 1:
        return BoardMotion(T, steps[0] / times[0], np.zeros(6))
    t = np.array(times)
    velocity, half = np.linalg.solve(np.stack([t, t**2], axis=1), np.array(steps))
    return BoardMotion(T, velocity, 2 * half)


def surface_pose(detection: Detection) -> Array:
    """A pose (4, 4) of the measured surface: that of the board for corners, else z along the normal."""
    if isinstance(detection, BoardCorners):
        return detection.T_camera_board
    if isinstance(detection, PlanePatch):
        n = detection.plane[:3]
    else:
        along = detection.endpoints[1] - detection.endpoints[0]
        n = np.array([-along[1], along[0], 0.0]) / np.hypot(along[0], along[1])
        n = n if n @ detection.center <= 0 else -n
    return se3.pose(np.column_stack([plane.tangent_basis(n), n]), detection.center)


def move_detection(
    detection: Detection, motion: BoardMotion, time: float, camera: CameraModel | None = None
) -> Detection:
    """The detection as it would be at another time.

    Args:
        detection: as measured.
        motion: of the board, from the time of the measurement.
        time: since the measurement, s.
        camera: intrinsics, for corners.
    """
    before, after, twist = motion.T_sensor_board, motion.pose_at(time), motion.twist_at(time)
    M = after @ se3.inverse(before)
    if isinstance(detection, BoardCorners):
        assert camera is not None
        corners = detection.corners_board
        shift = camera.project(se3.apply(after, corners)) - camera.project(se3.apply(before, corners))
        moved = plane.from_pose(after)
        return replace(
            detection,
            pixels=detection.pixels + shift,
            T_camera_board=after,
            plane=moved if moved @ detection.plane >= 0 else -moved,
            twist=twist,
        )
    u = detection.directions
    at_beam = motion.pose_at(detection.times - detection.times.mean()) if len(detection.times) else before
    ranges = detection.ranges + _distance_along(u, after) - _distance_along(u, at_beam)
    on_board = np.mean(np.linalg.norm(detection.points, axis=1))
    edges = se3.apply(M, detection.edges * on_board)
    edges = edges / np.linalg.norm(edges, axis=-1, keepdims=True)
    if isinstance(detection, Segment):
        ends = se3.apply(M, detection.endpoints)
        return replace(detection, ranges=ranges, endpoints=ends, edges=edges, times=np.zeros(0), twist=twist)
    center = se3.apply(M, detection.center[None])[0]
    n = after[:3, 2]
    return replace(
        detection,
        ranges=ranges,
        plane=np.append(n, -n @ after[:3, 3]),
        center=center,
        edges=edges,
        times=np.zeros(0),
        twist=twist,
    )


def _distance_along(directions: Array, T_sensor_board: Array) -> Array:
    """(N,) distances along directions (N, 3) to the surfaces of poses (4, 4) or (N, 4, 4)."""
    n, t = T_sensor_board[..., :3, 2], T_sensor_board[..., :3, 3]
    return np.asarray(np.sum(n * t, axis=-1) / np.sum(directions * n, axis=-1))


def _step_to(
    T: Array, detection: Detection, measured: _Measured, time: float, settings: MovingBoardSettings
) -> Array | None:
    """(6,) displacement of the surface to the nearest of the detections; None where none is near."""
    steps = [
        step
        for other in measured.detections
        if _same_kind(detection, other) and _is_near(step := _displacement(T, detection, other), time, settings)
    ]
    return min(steps, key=lambda step: float(np.linalg.norm(step[:3])), default=None)


def _same_kind(detection: Detection, other: Detection) -> bool:
    if isinstance(detection, BoardCorners):
        return isinstance(other, BoardCorners) and other.board == detection.board
    return type(other) is type(detection)


def _displacement(T: Array, detection: Detection, other: Detection) -> Array:
    """(6,) of a surface along the sensor's axes; a plane does not show a rotation about its normal."""
    if isinstance(detection, BoardCorners):
        return se3.difference(surface_pose(other), T)
    there = surface_pose(other)
    n, m = T[:3, 2], there[:3, 2]
    axis = np.cross(n, m)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, float(n @ m))
    return np.concatenate([there[:3, 3] - T[:3, 3], axis * (angle / sine if sine > 0 else 1.0)])


# Maximum rotation rate of a board, rad/s: more is the second solution of a plane's pose.
_MAX_ROTATION_RATE = 6.0


def _is_near(step: Array, time: float, settings: MovingBoardSettings) -> bool:
    return bool(
        np.linalg.norm(step[:3]) <= settings.max_speed * abs(time)
        and np.linalg.norm(step[3:]) <= _MAX_ROTATION_RATE * abs(time)
    )


def _order_by_time(captures: CaptureSet) -> Mapping[str, Sequence[_Measured]]:
    """By sensor, its detections in order of time."""
    history = {}
    for name, found in captures.detections.items():
        measured = [
            _Measured(measured_at(hold.stamps[name], found[hold.index]), found[hold.index], found[hold.index])
            for hold in captures.holds
            if hold.index in found and len(hold.stamps.get(name, ()))
        ]
        history[name] = sorted(measured, key=lambda one: one.stamp)
    return history


# Rounds of removing the motion from the planes of a sweep, and of estimating the motion from them: where a sweep
# begins and ends on the board, the first plane is rotated by up to 10°, the second by less than 1°.
_SKEW_ROUNDS = 2


def _remove_skew(history: Sequence[_Measured], settings: MovingBoardSettings) -> Sequence[_Measured]:
    """The detections in sweeps, in order of time, as if all beams had been measured at the time of the stamp.

    The parts of a moving board that a sweep measures at its beginning and at its end lie apart, and the plane
    through them is rotated. Its velocity is known nevertheless: it is used to move the beams to one time, which
    gives planes that give better velocities.
    """
    for _ in range(_SKEW_ROUNDS):
        if not any(_is_swept(one) for measured in history for one in measured.original):
            break
        straight = []
        for measured in history:
            before, after = _neighbours(history, measured.stamp, _MAX_INTERVAL)
            motions = [
                estimate_motion(one, measured.stamp, before, after, settings) for one in measured.detections
            ]
            both = zip(measured.original, measured.detections, motions, strict=True)
            fitted = tuple(
                _fit_plane(original, motion) if _is_swept(original) and motion is not None else one
                for original, one, motion in both
            )
            straight.append(replace(measured, detections=fitted))
        history = straight
    return history


def _is_swept(detection: Detection) -> TypeGuard[PlanePatch]:
    """Whether it is a plane whose beams have different times."""
    return isinstance(detection, PlanePatch) and len(detection.times) > 0


def _fit_plane(original: PlanePatch, motion: BoardMotion) -> PlanePatch:
    """The plane through beams that are moved to their mean time."""
    at_beam = motion.pose_at(original.times - original.times.mean())
    shift = _distance_along(original.directions, motion.T_sensor_board)
    shift -= _distance_along(original.directions, at_beam)
    points = original.points + shift[:, None] * original.directions
    return replace(original, plane=plane.towards_origin(plane.fit(points)), center=points.mean(axis=0))


def _neighbours(
    history: Sequence[_Measured], stamp: float, max_interval: float
) -> tuple[_Measured | None, _Measured | None]:
    """The last detections before and the first after a stamp, s, if they are near in time."""
    times = np.array([one.stamp for one in history])
    i, j = int(np.searchsorted(times, stamp, "left")) - 1, int(np.searchsorted(times, stamp, "right"))
    before = history[i] if i >= 0 and stamp - times[i] <= max_interval else None
    after = history[j] if j < len(times) and times[j] - stamp <= max_interval else None
    return before, after
