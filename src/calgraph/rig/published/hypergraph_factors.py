"""The six edge kinds of the hypergraph (MSG-Cal, section V): whitened residuals and their derivatives.

Variables are ``sensors`` (S, 4, 4) poses in the root frame, ``planes`` (P, 4) and ``lines`` (L, 2, 3) in the frame
of the sensor that detected them. Each class holds M edges of its kind as index arrays.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from calgraph.geometry import Array, Index, matvec, plane, se3, so3
from calgraph.rig.pairs.line_matches import evaluate_coplanarity
from calgraph.rig.published.sparse_lm import Term, Values


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
        by_relative = self.whitener.copy()
        by_relative[..., 3:] = by_relative[..., 3:] @ so3.left_jacobian_inverse(e[:, 3:])
        by_a, by_b = se3.relative_pose_jacobians(T_r_a, T_r_b)
        return matvec(self.whitener, e), (
            Term("sensors", self.sensor_a, by_relative @ by_a),
            Term("sensors", self.sensor_b, by_relative @ by_b),
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
        return matvec(self.whitener, e), (Term("lines", self.line, self.whitener),)


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
        e = np.concatenate([matvec(to_chart, difference[:, :3]), difference[:, 3:]], axis=1)
        jacobian = np.zeros((len(planes), 3, 3))
        jacobian[:, :2, :2] = to_chart @ plane.tangent_basis(planes[:, :3])
        jacobian[:, 2, 2] = 1
        return matvec(self.whitener, e), (Term("planes", self.plane, self.whitener @ jacobian),)


@dataclass(frozen=True, eq=False)
class _SameBoard(ABC):
    """Two sensors detected the same board, each as a line or as a plane."""

    name: ClassVar[str]
    blocks: ClassVar[tuple[str, str]]
    """Of the variables of both detections."""
    sensor_a: Index
    variable_a: Index
    sensor_b: Index
    variable_b: Index
    flatness: float
    """Standard deviation of the board from a plane, m (and, over a metre, rad)."""

    @abstractmethod
    def evaluate(self, T_a_b: Array, a: Array, b: Array) -> tuple[Array, Array, Array, Array]:
        """Residuals (M, k), m, and their derivatives by the relative pose, in the axes of a, and by a and b."""

    def linearize(self, values: Values) -> tuple[Array, Sequence[Term]]:
        """Residuals with the board's flatness as their standard deviation."""
        T_r_a, T_r_b = values["sensors"][self.sensor_a], values["sensors"][self.sensor_b]
        block_a, block_b = self.blocks
        e, by_relative, by_variable_a, by_variable_b = self.evaluate(
            se3.inverse(T_r_a) @ T_r_b, values[block_a][self.variable_a], values[block_b][self.variable_b]
        )
        by_a, by_b = se3.relative_pose_jacobians(T_r_a, T_r_b)
        w = 1 / self.flatness
        return w * e, (
            Term("sensors", self.sensor_a, w * by_relative @ by_a),
            Term("sensors", self.sensor_b, w * by_relative @ by_b),
            Term(block_a, self.variable_a, w * by_variable_a),
            Term(block_b, self.variable_b, w * by_variable_b),
        )


class LinePlane(_SameBoard):
    """The end points of a's line lie in b's plane."""

    name = "line-plane"
    blocks = ("lines", "planes")

    def evaluate(self, T_a_b: Array, a: Array, b: Array) -> tuple[Array, Array, Array, Array]:
        """Distances (M, 2) of both end points from the plane."""
        x_b = se3.apply(se3.inverse(T_a_b), a)
        n_a = np.broadcast_to(matvec(T_a_b[:, :3, :3], b[:, :3])[:, None], a.shape)
        by_relative = np.concatenate([-n_a, np.cross(n_a, a - T_a_b[:, None, :3, 3])], axis=-1)
        by_line = np.zeros((len(a), 2, 2, 3))
        by_line[:, [0, 1], [0, 1]] = n_a
        by_plane = np.concatenate([x_b @ plane.tangent_basis(b[:, :3]), np.ones((len(b), 2, 1))], axis=-1)
        return plane.distance(b, x_b), by_relative, by_line.reshape(-1, 2, 6), by_plane


class PlanePlane(_SameBoard):
    """The planes of both sensors coincide."""

    name = "plane-plane"
    blocks = ("planes", "planes")

    def evaluate(self, T_a_b: Array, a: Array, b: Array) -> tuple[Array, Array, Array, Array]:
        """Differences (M, 4) of the plane parameters in frame a."""
        n_a = matvec(T_a_b[:, :3, :3], b[:, :3])
        by_relative = np.zeros((len(a), 4, 6))
        by_relative[:, :3, 3:] = so3.hat(n_a)
        by_relative[:, 3, :3] = n_a
        by_relative[:, 3, 3:] = np.cross(n_a, T_a_b[:, :3, 3])
        by_plane_a = np.zeros((len(a), 4, 3))
        by_plane_a[:, :3, :2] = plane.tangent_basis(a[:, :3])
        by_plane_a[:, 3, 2] = 1
        by_plane_b = np.zeros((len(a), 4, 3))
        tangents_a = T_a_b[:, :3, :3] @ plane.tangent_basis(b[:, :3])
        by_plane_b[:, :3, :2] = -tangents_a
        by_plane_b[:, 3, :2] = np.einsum("mij,mi->mj", tangents_a, T_a_b[:, :3, 3])
        by_plane_b[:, 3, 2] = -1
        return a - plane.transform(T_a_b, b), by_relative, by_plane_a, by_plane_b


class LineLine(_SameBoard):
    """Two lines on one board are coplanar (not in the paper)."""

    name = "line-line"
    blocks = ("lines", "lines")

    def evaluate(self, T_a_b: Array, a: Array, b: Array) -> tuple[Array, Array, Array, Array]:
        """The gap (M, 1) between the lines: :func:`calgraph.rig.pairs.line_matches.evaluate_coplanarity`."""
        # Parallel scan planes have no residual (NaN) and get no weight.
        r, by_relative, by_a, by_b = (np.nan_to_num(part)[:, None] for part in evaluate_coplanarity(T_a_b, a, b))
        return r, by_relative, by_a, by_b
