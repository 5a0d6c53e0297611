"""Detections of a moving board at the time of their capture: each sensor measured it a little earlier or later."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeGuard

import numpy as np

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch, Segment
from calgraph.config.settings import MovingBoardSettings
from calgraph.geometry import Array, plane, se3
from calgraph.rig.captures.detect import CaptureSet
from calgraph.sensors import CameraModel


@dataclass(frozen=True, eq=False)
class _Measured:
    """One sensor's detections of one capture."""

    capture: int
    stamp: float
    """When it measured them, s."""
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
    velocity_stddev: Array
    """(6,) standard deviations of the velocity."""

    def pose_at(self, time: float | Array) -> Array:
        """Poses (..., 4, 4) at times (...), s."""
        t = np.asarray(time)[..., None]
        return se3.retract(self.T_sensor_board, self.velocity * t + 0.5 * self.acceleration * t**2)

    def twist_at(self, time: float) -> Array:
        """(6,) velocity of the board's point at the sensor's origin, and of its rotation, at a time."""
        v, w = np.split(self.velocity + self.acceleration * time, 2)
        return np.concatenate([v - np.cross(w, self.pose_at(time)[:3, 3]), w])


def compensate_motion(captures: CaptureSet, settings: MovingBoardSettings) -> CaptureSet:
    """Moves the detections of every capture to one time, the mean of its stamps, and adds the board's velocity.

    The motion is interpolated from the sensor's own detections in the measurements before and after. What these
    leave unknown of it, all of it without any, is noise of the detection. Holds that only serve for that are left
    out.

    Args:
        captures: with stamps of the holds; one message a sensor and hold.
        settings: limits of motion.
    """
    ordered = _order_by_time(captures)
    usual = _usual_velocity(ordered.values(), settings)
    history = {name: _remove_skew(of, usual, settings) for name, of in ordered.items()}
    detections: dict[str, dict[int, tuple[Detection, ...]]] = {name: {} for name in captures.detections}
    chosen = {hold.index for hold in captures.holds if not hold.auxiliary}
    rejections = {key: why for key, why in captures.rejections.items() if key[0] in chosen}
    by_capture: dict[int, dict[str, _Measured]] = {}
    for name, of_sensor in history.items():
        for measured in of_sensor:
            by_capture.setdefault(measured.capture, {})[name] = measured
    for hold in captures.holds:
        of_hold = {} if hold.auxiliary else by_capture.get(hold.index, {})
        reference = np.mean([one.stamp for one in of_hold.values()]) if of_hold else 0.0
        for name, measured in of_hold.items():
            stamp, neighbours = measured.stamp, _neighbours(history[name], measured.stamp)
            detections[name][hold.index] = tuple(
                move_detection(
                    one,
                    estimate_motion(known, stamp, neighbours, usual, settings),
                    float(reference) - stamp,
                    captures.cameras.get(name),
                )
                for one, known in zip(measured.original, measured.detections, strict=True)
            )
    holds = tuple(hold for hold in captures.holds if not hold.auxiliary)
    return replace(captures, holds=holds, detections=detections, rejections=rejections)


def measured_at(stamps: Array, detections: Sequence[Detection]) -> float:
    """When a board was measured, s: the mean time of its beams, or the stamp of the message."""
    times = np.zeros(0) if isinstance(detections[0], BoardCorners) else detections[0].times
    return float(stamps[0]) + (float(times.mean()) if len(times) else 0.0)


# Angular frequency of the motion of a carried board, rad/s: that of a hand, by which velocities change between
# measurements. Of the four webcams (benchmarks/webcams.py), velocities over 0.17 s to one side differ by 0.2 of
# themselves from those over both, and over 0.34 s to both sides by 0.2 (translations) to 0.5 (rotations): 2.4 to
# 5 rad/s.
_MOTION_FREQUENCY = 4.0


def estimate_motion(
    detection: Detection,
    stamp: float,
    neighbours: Sequence[_Measured],
    usual: Array,
    settings: MovingBoardSettings,
) -> BoardMotion:
    """The motion of a detected board from detections before and after: less certain, the longer ago they are.

    A sinusoid of velocity v and frequency ω deviates from a straight line to a time t by ``ω t / 2`` of v, and
    from a parabola through times t and t' by ``ω² t t' / 6``. The velocity is the mean of this measurement and of
    the usual velocity about zero, weighted by their variances.

    Args:
        detection: at the stamp.
        stamp: when it was measured, s.
        neighbours: the last detections before it and the first ones after it.
        usual: (6,) standard deviation of velocities, m/s and rad/s.
        settings: limits of motion.
    """
    T = surface_pose(detection)
    steps = [
        (time, step)
        for measured in neighbours
        if (step := _step_to(T, detection, measured, time := measured.stamp - stamp, settings)) is not None
    ]
    # Relative error, velocity and acceleration; without neighbours all of the velocity is unknown.
    options = [(np.inf, np.zeros(6), np.zeros(6))]
    options += [(_MOTION_FREQUENCY * abs(time) / 2, step / time, np.zeros(6)) for time, step in steps]
    if len(steps) == 2:
        t = np.array([time for time, _ in steps])
        velocity, half = np.linalg.solve(np.stack([t, t**2], axis=1), np.array([step for _, step in steps]))
        options.append((_MOTION_FREQUENCY**2 * abs(t[0] * t[1]) / 6, velocity, 2 * half))
    error, velocity, acceleration = min(options, key=lambda option: option[0])
    weight = 1 / (1 + error**2)
    return BoardMotion(T, weight * velocity, weight * acceleration, np.sqrt(1 - weight) * usual)


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


# Standard deviation of the stamps by which a velocity that is not known displaces a board, s: the size of exposure
# times and delays of drivers. Where the velocity is known, it is estimated.
_STAMP_ERROR = 0.005


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
    times = np.zeros(0) if isinstance(detection, BoardCorners) else detection.times
    squared_time = time**2 + _STAMP_ERROR**2 + (float(np.var(times)) if len(times) else 0.0)
    detection = replace(detection, motion_variance=squared_time * motion.velocity_stddev**2)
    if isinstance(detection, BoardCorners):
        assert camera is not None
        corners = detection.corners_board
        shift = camera.project(se3.apply(after, corners)) - camera.project(se3.apply(before, corners))
        surface = plane.from_pose(after)
        surface = surface if surface @ detection.plane >= 0 else -surface
        pixels = detection.pixels + shift
        return replace(detection, pixels=pixels, T_camera_board=after, plane=surface, twist=twist)
    u = detection.directions
    at_beam = motion.pose_at(detection.times - detection.times.mean()) if len(detection.times) else before
    ranges = detection.ranges + _distance_along(u, after) - _distance_along(u, at_beam)
    on_board = np.mean(np.linalg.norm(detection.points, axis=1))
    edges = se3.apply(M, detection.edges * on_board)
    edges = edges / np.linalg.norm(edges, axis=-1, keepdims=True)
    moved = replace(detection, ranges=ranges, edges=edges, times=np.zeros(0), twist=twist)
    if isinstance(moved, Segment):
        return replace(moved, endpoints=se3.apply(M, moved.endpoints))
    n, center = after[:3, 2], se3.apply(M, moved.center[None])[0]
    return replace(moved, plane=np.append(n, -n @ after[:3, 3]), center=center)


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
# Maximum speed over the standard deviation of a velocity along each axis before any is measured: 1 in 700 boards
# is faster than 4 standard deviations (χ² with 3 degrees of freedom).
_MAX_OVER_STDDEV = 4.0


def _usual_velocity(histories: Iterable[Sequence[_Measured]], settings: MovingBoardSettings) -> Array:
    """(6,) standard deviations of the velocity along each axis, m/s and rad/s, from the steps of all sensors.

    The limits of motion count as one step.
    """
    limits = np.array([settings.max_speed, _MAX_ROTATION_RATE]) / _MAX_OVER_STDDEV
    velocities = [limits[:, None] * np.ones(3)]
    for history in histories:
        for measured, following in pairwise(history):
            time = following.stamp - measured.stamp
            for one in measured.detections:
                step = _step_to(surface_pose(one), one, following, time, settings)
                velocities += [] if step is None else [(step / time).reshape(2, 3)]
    return np.repeat(np.sqrt(np.mean(np.square(velocities), axis=(0, 2))), 3)


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
            _Measured(hold.index, measured_at(hold.stamps[name], one), one, one)
            for hold in captures.holds
            if len(one := found.get(hold.index, ())) and len(hold.stamps.get(name, ()))
        ]
        history[name] = sorted(measured, key=lambda one: one.stamp)
    return history


# Rounds of removing the motion from the planes of a sweep, and of estimating the motion from them: where a sweep
# begins and ends on the board, the first plane is rotated by up to 10°, the second by less than 1°.
_SKEW_ROUNDS = 2


def _remove_skew(history: Sequence[_Measured], usual: Array, settings: MovingBoardSettings) -> Sequence[_Measured]:
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
            neighbours = _neighbours(history, measured.stamp)
            motions = [
                estimate_motion(one, measured.stamp, neighbours, usual, settings) for one in measured.detections
            ]
            both = zip(measured.original, measured.detections, motions, strict=True)
            fitted = tuple(
                _fit_plane(original, motion) if _is_swept(original) else one for original, one, motion in both
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


def _neighbours(history: Sequence[_Measured], stamp: float) -> list[_Measured]:
    """The last detections before and the first after a stamp, s."""
    times = np.array([one.stamp for one in history])
    i, j = int(np.searchsorted(times, stamp, "left")), int(np.searchsorted(times, stamp, "right"))
    return [*history[max(i - 1, 0) : i], *history[j : j + 1]]
