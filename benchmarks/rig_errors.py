"""How the real world differs from what rig.yaml states: errors of boards and sensors with known size.

``rig.yaml`` and camera_info of a simulated rig are those of its scenario; the measurements are made with a board,
lenses and beams that differ from them. Everything is exact by default.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.printed_boards import Landmarks, compute_landmarks
from calgraph.config import Board
from calgraph.errors import InputError
from calgraph.geometry import Array, se3, so3
from calgraph.sensors import CameraModel
from calgraph.sensors.beam_pattern import BeamPattern
from calgraph.simulation.robot import MountedCamera, RobotSensor

_NEWTON_STEPS = 4
"""Steps from the plane to a bowed face: each squares the relative error, which starts at a few per cent."""

Pair = tuple[float, float]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class BoardErrors:
    """The real boards, relative to those stated, and their motion while sensors measure."""

    print_scale: float = 0.0
    """Relative size of the print, about the board's centre."""
    print_aspect: float = 0.0
    """Relative width over height of the print, half of it in either direction."""
    print_position: Pair = (0.0, 0.0)
    """Displacement of the whole print on the board (x, y), m."""
    print_rotation: float = 0.0
    """Rotation of the whole print about the board's centre, rad."""
    tag_size: float = 0.0
    """Relative size of each tag about its centre."""
    tag_position: Mapping[int, Pair] = field(default_factory=dict)
    """Displacement of tags on the print (x, y) by id, m."""
    tag_rotation: Mapping[int, float] = field(default_factory=dict)
    """Rotation of tags about their centres by id, rad."""
    bow: Vector = (0.0, 0.0, 0.0)
    """Height of the face above its plane: at the ends of the x axis and of the y axis, and at the upper right
    corner by torsion, m. ``(b, 0, 0)`` is a cylinder, ``(b, -b, 0)`` a saddle."""
    size: Pair = (0.0, 0.0)
    """Added to width and height of the board, m."""
    tag_range_bias: float = 0.0
    """Added to the ranges of beams that end on a tag, m: dark ink returns less light, and later."""
    tremor: float = 0.0
    """Standard deviation of the board's position from message to message, along each axis, m."""
    tremor_rotation: float = 0.0
    """And of its rotation about each axis, rad."""
    view_bias: float = 0.0
    """Standard deviation of its position from view to view, along each axis, m: it differs between sensors, too,
    but not between the messages of one in one capture."""
    view_tilt: float = 0.0
    """And of its rotation about each axis, rad."""
    speed: float = 0.0
    """Speed of the board, m/s, in a random direction in each capture. Sensors measure simultaneously; those whose
    clocks are late, with the board where it is afterwards."""

    def true_size(self, board: Board) -> Pair:
        """Width and height of the board, m."""
        return board.size[0] + self.size[0], board.size[1] + self.size[1]

    def true_landmarks(self, board: Board) -> Landmarks:
        """The printed corners where they are, in the frame of the board; not in its plane if it is bowed."""
        stated = compute_landmarks(board)
        centers = stated.corners.mean(axis=1, keepdims=True)
        turn = np.array([[0.0, 0.0, self.tag_rotation.get(int(mark), 0.0)] for mark in stated.ids]).reshape(-1, 3)
        of_marks = (1 + self.tag_size) * (stated.corners - centers) @ np.swapaxes(so3.exp(turn), 1, 2)
        shift = [self.tag_position.get(int(mark), (0.0, 0.0)) for mark in stated.ids]
        corners = centers + of_marks
        corners[..., :2] += np.reshape(shift, (-1, 1, 2))
        stretch = (1 + self.print_scale) * (1 + 0.5 * self.print_aspect * np.array([1.0, -1.0]))
        R = so3.exp(np.array([0.0, 0.0, self.print_rotation]))[:2, :2]
        corners[..., :2] = (stretch * corners[..., :2]) @ R.T + self.print_position
        corners[..., 2] = self.height(board, corners[..., :2])
        return Landmarks(stated.ids, corners)

    def height(self, board: Board, at: Array) -> Array:
        """Height (...,) of the face above the plane of the board at points (..., 2) of it, m."""
        x, y = np.moveaxis(2 * at / np.array(self.true_size(board)), -1, 0)
        return np.asarray(self.bow[0] * x**2 + self.bow[1] * y**2 + self.bow[2] * x * y)

    def range_bias(self, board: Board, at: Array) -> Array:
        """(N,) added to the ranges of beams that end at points (N, 2) of the board, m."""
        centers = np.array([tag.center for tag in board.tags]).reshape(-1, 2)
        half = 0.5 * np.array([tag.size for tag in board.tags])
        on_tag = np.abs(at[:, None] - centers).max(axis=-1) <= half
        return np.asarray(self.tag_range_bias * on_tag.any(axis=-1))

    def distance(self, board: Board, origins: Array, directions: Array) -> Array:
        """Distance (N,) along rays (N, 3), in the frame of the board, to its face, m.

        Newton's method from the board's plane; the face is extended beyond the outline.
        """
        reach = -origins[:, 2] / directions[:, 2]
        half = 0.5 * np.array(self.true_size(board))
        for _ in range(_NEWTON_STEPS if any(self.bow) else 0):
            at = origins + reach[:, None] * directions
            x, y = (at[:, :2] / half).T
            slope = np.stack(
                [2 * self.bow[0] * x + self.bow[2] * y, 2 * self.bow[1] * y + self.bow[2] * x], axis=-1
            )
            falling = directions[:, 2] - np.sum(slope / half * directions[:, :2], axis=-1)
            reach = reach - (at[:, 2] - self.height(board, at[:, :2])) / falling
        return np.asarray(reach)


@dataclass(frozen=True)
class Bump:
    """A change of the pose of a sensor during the recording: a step, or a slow drift."""

    after: float
    """Share of the captures before it."""
    duration: float = 0.0
    """Share of the captures during which the pose changes steadily; 0 for a step."""
    translation: Vector = (0.0, 0.0, 0.0)
    """In the frame of the sensor before it, m."""
    rotation: Vector = (0.0, 0.0, 0.0)
    """Rotation vector in that frame, rad."""


@dataclass(frozen=True)
class SensorErrors:
    """Errors that any sensor may have."""

    bump: Bump | None = None
    """Ground truth is the pose after it."""
    delay: float = 0.0
    """Time by which the sensor measures later than its stamps state, s."""

    def pose(self, T_world_sensor: Array, done: float) -> Array:
        """``T_world_sensor`` (4, 4) after a share of the captures, from the pose at the start."""
        if self.bump is None or done < self.bump.after:
            return T_world_sensor
        share = min((done - self.bump.after) / self.bump.duration, 1.0) if self.bump.duration else 1.0
        step = se3.pose(so3.exp(share * np.array(self.bump.rotation)), share * np.array(self.bump.translation))
        return np.asarray(T_world_sensor @ step)


@dataclass(frozen=True, eq=False)
class CameraErrors(SensorErrors):
    """The real lens and image of a camera."""

    focal_length: Pair = (0.0, 0.0)
    """Relative, fx and fy."""
    principal_point: Pair = (0.0, 0.0)
    """Displacement, pixels."""
    distortion: tuple[float, ...] = ()
    """Added to the stated coefficients, in their order."""
    lens: CameraModel | None = None
    """The camera before these errors, where its model is not the stated one."""
    image_shift: Pair = (0.0, 0.0)
    """Displacement of the image from ``image_shift_after`` on, pixels."""
    image_shift_after: float = 0.0
    """Share of the captures before it."""

    def true_camera(self, stated: CameraModel) -> CameraModel:
        """The camera that takes the images."""
        camera = self.lens or stated
        coefficients = camera.distortion.copy()
        coefficients[: len(self.distortion)] += self.distortion
        focal = camera.focal * (1 + np.array(self.focal_length))
        return camera.with_intrinsics(
            np.concatenate([focal, camera.principal_point + self.principal_point, coefficients])
        )

    def shift(self, done: float) -> Array:
        """(2,) displacement of the image after a share of the captures, pixels."""
        return np.array(self.image_shift) * (done >= self.image_shift_after)


@dataclass(frozen=True)
class ScannerErrors(SensorErrors):
    """The real beams of a scanner."""

    range_bias: float = 0.0
    """Added to all ranges, m."""
    range_scale: float = 0.0
    """Measured over true range, minus 1."""
    angle_scale: float = 0.0
    """True over stated angle of a beam, minus 1; only of a 2-D scanner."""
    ring_bias: tuple[float, ...] = ()
    """Added to the ranges of each ring of a multi-beam LiDAR, m."""
    ring_elevation: tuple[float, ...] = ()
    """True minus stated elevation of each ring, rad."""
    divergence: float = 0.0
    """Full angle of the beams' divergence, rad. A beam measures the board if its footprint touches it."""

    def true_pattern(self, pattern: BeamPattern) -> BeamPattern:
        """The pattern with the beams' true directions.

        Raises:
            InputError: the number of rings, or the kind of scanner, does not fit.
        """
        rings = 0 if pattern.rings is None else int(pattern.rings.max()) + 1
        for name, values in (("ring_bias", self.ring_bias), ("ring_elevation", self.ring_elevation)):
            if values and len(values) != rings:
                raise InputError(
                    f"{name}: must have as many values as there are rings, {rings}, got {len(values)}"
                )
        directions, sideways = pattern.directions, pattern.sideways
        if self.angle_scale:
            if directions[:, 2].any():
                raise InputError("angle_scale: only a 2-D scanner has one")
            turn = (self.angle_scale * pattern.angles)[:, None]
            directions, sideways = (
                np.cos(turn) * directions + np.sin(turn) * sideways,
                np.cos(turn) * sideways - np.sin(turn) * directions,
            )
        if self.ring_elevation:
            rise = np.array(self.ring_elevation)[pattern.rings][:, None]
            directions = np.cos(rise) * directions + np.sin(rise) * np.cross(directions, sideways)
        return replace(pattern, directions=directions, sideways=sideways)

    def measured_ranges(self, true: Array, rings: NDArray[np.int32] | None) -> Array:
        """Ranges (N,) before noise, m, from true ranges (N,) and the rings (N,) of a multi-beam LiDAR."""
        of_rings = np.array(self.ring_bias)[rings] if self.ring_bias else 0.0
        return np.asarray((1 + self.range_scale) * true + self.range_bias + of_rings)


@dataclass(frozen=True, eq=False)
class ModelErrors:
    """Everything in which the world differs from rig.yaml and camera_info."""

    board: BoardErrors = BoardErrors()
    """Of all boards."""
    cameras: Mapping[str, CameraErrors] = field(default_factory=dict)
    """By camera."""
    scanners: Mapping[str, ScannerErrors] = field(default_factory=dict)
    """By scanner."""

    def of_camera(self, name: str) -> CameraErrors:
        """The errors of a camera, none by default."""
        return self.cameras.get(name, CameraErrors())

    def of_scanner(self, name: str) -> ScannerErrors:
        """The errors of a scanner, none by default."""
        return self.scanners.get(name, ScannerErrors())

    def of_sensor(self, sensor: RobotSensor) -> SensorErrors:
        """The errors of a camera or scanner."""
        return self.of_camera(sensor.name) if isinstance(sensor, MountedCamera) else self.of_scanner(sensor.name)

    def check(self, robot: Sequence[RobotSensor]) -> None:
        """Raises InputError unless all cameras and scanners with errors exist."""
        cameras = {sensor.name for sensor in robot if isinstance(sensor, MountedCamera)}
        scanners = {sensor.name for sensor in robot} - cameras
        if unknown := (self.cameras.keys() - cameras) | (self.scanners.keys() - scanners):
            raise InputError(
                f"model errors: this robot has no such camera or scanner: {', '.join(sorted(unknown))}"
            )
