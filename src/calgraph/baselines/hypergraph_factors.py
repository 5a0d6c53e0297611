"""The six edge kinds of the hypergraph (MSG-Cal, section V): whitened residuals and their derivatives.

Variables are ``sensors`` (S, 4, 4) poses in the root frame, ``planes`` (P, 4) and ``lines`` (L, 2, 3) in the frame
of the sensor that detected them. Each class holds M edges of its kind as index arrays.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calgraph.baselines.sparse_lm import Term, Values
from calgraph.geometry import Array, Index, plane, se3, so3
from calgraph.pairwise import evaluate_coplanarity


def whitener(covariance: Array) -> Array:
    """``W`` (..., k, k) with ``W.T @ W`` the inverse of covariances (..., k, k)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


@dataclass(frozen=True, eq=False)
class SensorSensor:
    """Relative pose of two sensors against its pairwise estimate (eq. 6)."""

    name: ClassVar[str] = "sensor-sensor"
    sensor_a: Index
    sensor_b: Index
    T_a_b: Array
    """(M, 4, 4)."""
    whitener: Array
    """(M, 6, 6)."""

    def linearize(self, values: Values) -> tuple[Array, Sequence[Term]]:
        """The error of the relative pose in the fixed axes of a: the tangent of eq. 6 to first order."""
        T_r_a, T_r_b = values["sensors"][self.sensor_a], values["sensors"][self.sensor_b]
        e = se3.difference(se3.inverse(T_r_a) @ T_r_b, self.T_a_b)
        by_a, by_b = se3.relative_pose_jacobians(T_r_a, T_r_b)
        turn = so3.left_jacobian_inverse(e[:, 3:])
        by_a[:, 3:], by_b[:, 3:] = turn @ by_a[:, 3:], turn @ by_b[:, 3:]
        return _apply(self.whitener, e), (
            Term("sensors", self.sensor_a, self.whitener @ by_a),
            Term("sensors", self.sensor_b, self.whitener @ by_b),
        )


@dataclass(frozen=True, eq=False)
class SensorLine:
    """A line against the end points its sensor measured (eqs. 7–9)."""

    name: ClassVar[str] = "sensor-line"
    line: Index
    measured: Array
    """(M, 2, 3)."""
    whitener: Array
    """(M, 6, 6)."""

    def linearize(self, values: Values) -> tuple[Array, Sequence[Term]]:
        """Difference of the end points."""
        e = (values["lines"][self.line] - self.measured).reshape(-1, 6)
        return _apply(self.whitener, e), (Term("lines", self.line, self.whitener),)


@dataclass(frozen=True, eq=False)
class SensorPlane:
    """A plane against the one its sensor measured."""

    name: ClassVar[str] = "sensor-plane"
    plane: Index
    measured: Array
    """(M, 4)."""
    whitener: Array
    """(M, 3, 3) in the chart of plane.retract at the measured plane."""

    def linearize(self, values: Values) -> tuple[Array, Sequence[Term]]:
        """Difference of normals in the measured normal's tangent basis, and of offsets."""
        planes = values["planes"][self.plane]
        to_chart = np.swapaxes(plane.tangent_basis(self.measured[:, :3]), -1, -2)
        difference = planes - self.measured
        e = np.concatenate([_apply(to_chart, difference[:, :3]), difference[:, 3:]], axis=1)
        jacobian = np.zeros((len(planes), 3, 3))
        jacobian[:, :2, :2] = to_chart @ plane.tangent_basis(planes[:, :3])
        jacobian[:, 2, 2] = 1
        return _apply(self.whitener, e), (Term("planes", self.plane, self.whitener @ jacobian),)


@dataclass(frozen=True, eq=False)
class LinePlane:
    """The end points of one sensor's line lie in another sensor's plane."""

    name: ClassVar[str] = "line-plane"
    sensor_line: Index
    line: Index
    sensor_plane: Index
    plane: Index
    flatness: float
    """Standard deviation of the board from a plane, m."""

    def linearize(self, values: Values) -> tuple[Array, Sequence[Term]]:
        """Distances of both end points from the plane."""
        T_r_p, T_r_l = values["sensors"][self.sensor_plane], values["sensors"][self.sensor_line]
        planes, x_l = values["planes"][self.plane], values["lines"][self.line]
        x_r = se3.apply(T_r_l, x_l)
        x_p = se3.apply(se3.inverse(T_r_p), x_r)
        n_r = np.broadcast_to((T_r_p[:, :3, :3] @ planes[:, :3, None])[:, None, :, 0], x_r.shape)
        by_line_sensor = np.concatenate([n_r, np.cross(x_r - T_r_l[:, None, :3, 3], n_r)], axis=-1)
        by_plane_sensor = -np.concatenate([n_r, np.cross(x_r - T_r_p[:, None, :3, 3], n_r)], axis=-1)
        by_plane = np.concatenate(
            [x_p @ plane.tangent_basis(planes[:, :3]), np.ones((len(planes), 2, 1))], axis=-1
        )
        by_line = np.zeros((len(planes), 2, 2, 3))
        by_line[:, [0, 1], [0, 1]] = n_r @ T_r_l[:, :3, :3]
        w = 1 / self.flatness
        return w * plane.distance(planes, x_p), (
            Term("sensors", self.sensor_line, w * by_line_sensor),
            Term("sensors", self.sensor_plane, w * by_plane_sensor),
            Term("planes", self.plane, w * by_plane),
            Term("lines", self.line, w * by_line.reshape(-1, 2, 6)),
        )


@dataclass(frozen=True, eq=False)
class PlanePlane:
    """Two sensors detected the same plane."""

    name: ClassVar[str] = "plane-plane"
    sensor_a: Index
    plane_a: Index
    sensor_b: Index
    plane_b: Index
    flatness: float
    """Standard deviation of the board from a plane, m (and, over a metre, rad)."""

    def linearize(self, values: Values) -> tuple[Array, Sequence[Term]]:
        """Difference of the four plane parameters in frame a."""
        T_r_a, T_r_b = values["sensors"][self.sensor_a], values["sensors"][self.sensor_b]
        p_a, p_b = values["planes"][self.plane_a], values["planes"][self.plane_b]
        T_a_b = se3.inverse(T_r_a) @ T_r_b
        e = p_a - plane.transform(T_a_b, p_b)
        # First by the relative pose in the axes of a, then by the two poses in the root frame.
        n_a = (T_a_b[:, :3, :3] @ p_b[:, :3, None])[..., 0]
        by_relative = np.zeros((len(e), 4, 6))
        by_relative[:, :3, 3:] = so3.hat(n_a)
        by_relative[:, 3, :3] = n_a
        by_relative[:, 3, 3:] = np.cross(n_a, T_a_b[:, :3, 3])
        by_a, by_b = se3.relative_pose_jacobians(T_r_a, T_r_b)
        by_plane_a = np.zeros((len(e), 4, 3))
        by_plane_a[:, :3, :2] = plane.tangent_basis(p_a[:, :3])
        by_plane_a[:, 3, 2] = 1
        by_plane_b = np.zeros((len(e), 4, 3))
        turned = T_a_b[:, :3, :3] @ plane.tangent_basis(p_b[:, :3])
        by_plane_b[:, :3, :2] = -turned
        by_plane_b[:, 3, :2] = np.einsum("mij,mi->mj", turned, T_a_b[:, :3, 3])
        by_plane_b[:, 3, 2] = -1
        w = 1 / self.flatness
        return w * e, (
            Term("sensors", self.sensor_a, w * by_relative @ by_a),
            Term("sensors", self.sensor_b, w * by_relative @ by_b),
            Term("planes", self.plane_a, w * by_plane_a),
            Term("planes", self.plane_b, w * by_plane_b),
        )


@dataclass(frozen=True, eq=False)
class LineLine:
    """Two lines on one board are coplanar (not in the paper)."""

    name: ClassVar[str] = "line-line"
    sensor_a: Index
    line_a: Index
    sensor_b: Index
    line_b: Index
    flatness: float
    """Standard deviation of the board from a plane, m."""

    def linearize(self, values: Values) -> tuple[Array, Sequence[Term]]:
        """The gap between the lines (:func:`calgraph.pairwise.coplanarity`)."""
        T_r_a, T_r_b = values["sensors"][self.sensor_a], values["sensors"][self.sensor_b]
        T_a_b = se3.inverse(T_r_a) @ T_r_b
        r, by_relative, by_line_a, by_line_b = evaluate_coplanarity(
            T_a_b, values["lines"][self.line_a], values["lines"][self.line_b]
        )
        # Parallel scan planes have no residual (NaN) and get no weight.
        w = np.where(np.isnan(r), 0.0, 1 / self.flatness)[:, None, None]
        by_a, by_b = se3.relative_pose_jacobians(T_r_a, T_r_b)
        return w[:, :, 0] * np.nan_to_num(r)[:, None], (
            Term("sensors", self.sensor_a, w * np.nan_to_num(by_relative)[:, None] @ by_a),
            Term("sensors", self.sensor_b, w * np.nan_to_num(by_relative)[:, None] @ by_b),
            Term("lines", self.line_a, w * np.nan_to_num(by_line_a)[:, None]),
            Term("lines", self.line_b, w * np.nan_to_num(by_line_b)[:, None]),
        )


def _apply(matrices: Array, vectors: Array) -> Array:
    return np.asarray((matrices @ vectors[..., None])[..., 0])
