"""What one sensor measured of boards, and how it depends on the pose of each board before the sensor.

A *view* is what one sensor measured of one board: corners in pixels, or ranges along beams. Everything it says is
a function of ``T_sensor_board``, so residuals are differentiated by that pose alone: by perturbations
(translation, rotation) along the sensor's fixed axes, as :func:`calgraph.geometry.se3.retract` applies them.
"""

from collections.abc import Sequence
from dataclasses import Field, dataclass, field, replace
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from calgraph.config import PixelNoise, RangeNoise
from calgraph.detection import BoardCorners, PlanePatch, Segment
from calgraph.geometry import Array, Index, se3, so3
from calgraph.sensors import CameraModel

# Flatter than this a beam grazes the board and its range says nothing about it.
_MIN_COSINE = 0.05


@dataclass(frozen=True, eq=False)
class LinearizedResiduals:
    """Whitened residuals of N measurements, k numbers each, in V views, and their derivatives.

    A view's measurements may depend on fewer than six numbers of the pose: derivatives are by q numbers, of which
    ``basis`` says how they move with the pose and with the sensor's e own unknowns.
    """

    residual: Array
    """(N, k) predicted minus measured, in standard deviations."""
    jacobian: Array
    """(N, k, q)."""
    local_jacobian: Array
    """(V, q, 6 + e)."""


class BoardViews(Protocol):
    """All views of one sensor, a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def board(self) -> Index:
        """(V,) which board each view is of; no board twice."""

    @property
    def start(self) -> Index:
        """(V,) the first measurement of each view."""

    @property
    def noise_scale(self) -> float:
        """How many times larger than stated the noise is taken to be."""

    @property
    def dimension(self) -> int:
        """How many numbers each measurement has, k."""

    @property
    def extra_count(self) -> int:
        """How many unknowns the sensor has besides its pose, e."""

    def linearize(self, T_sensor_board: Array, own: Array) -> LinearizedResiduals:
        """Residuals and derivatives at poses (V, 4, 4) and the sensor's own unknowns (e,)."""

    def local_jacobian(self, T_sensor_board: Array) -> Array:
        """(V, q, 6 + e): how the q numbers that measurements depend on move with pose and own unknowns."""

    def local_difference(self, T_before: Array, T_sensor_board: Array, own: Array) -> Array:
        """(V, q) by how much those numbers differ between two poses, and own unknowns by (e,)."""

    def update_noise(self, T_sensor_board: Array, scale: float) -> Self:
        """The same views with noise as it is at these poses, ``scale`` times that stated."""

    def select(self, keep: NDArray[np.bool_] | Index) -> Self:
        """Some of the views: a mask (V,), or their numbers, which may repeat."""


@dataclass(frozen=True, eq=False)
class CornerObservations:
    """Printed corners in a camera's pictures, through its full model: pixels."""

    board: Index
    start: Index
    corners_board: Array
    """(N, 3) m."""
    pixels: Array
    """(N, 2)."""
    camera: CameraModel
    noise: PixelNoise
    noise_scale: float = 1.0
    estimate_intrinsics: bool = False
    """Whether the camera's intrinsics are unknown."""
    tag_centers: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """(M, 2) centres of the tags whose places on the board are unknown, m."""
    tag_index: Index | None = None
    """(N,) on which of ``tags`` each corner is; -1 on none. Needed where there are any."""
    dimension: ClassVar[int] = 2

    @classmethod
    def from_detections(
        cls, board: Sequence[int], found: Sequence[BoardCorners], camera: CameraModel, noise: PixelNoise
    ) -> "CornerObservations":
        """The views of detections ``found`` of these boards."""
        return cls(
            np.array(board, dtype=np.intp),
            start_indices([len(d.pixels) for d in found]),
            np.concatenate([np.empty((0, 3)), *(d.corners_board for d in found)]),
            np.concatenate([np.empty((0, 2)), *(d.pixels for d in found)]),
            camera,
            noise,
        )

    @property
    def extra_count(self) -> int:
        """The camera's intrinsics, then (x, y, rotation) of each tag, m and rad; where they are unknown."""
        return len(self.camera.intrinsics) * self.estimate_intrinsics + 3 * len(self.tag_centers)

    def linearize(self, T_sensor_board: Array, own: Array) -> LinearizedResiduals:
        """See :class:`Views`: reprojection errors."""
        view = view_indices(self.start, len(self.pixels))
        intrinsics, places = np.split(own, [self.extra_count - 3 * len(self.tag_centers)])
        camera = self.camera.with_intrinsics(intrinsics) if self.estimate_intrinsics else self.camera
        corners_board, by_places = self._displace_tags(places.reshape(-1, 3))
        R = T_sensor_board[view, :3, :3]
        turned = (R @ corners_board[..., None])[..., 0]
        points = turned + T_sensor_board[view, :3, 3]
        pixels, by_point = camera.project_with_jacobian(points)
        parts = [by_point, -by_point @ so3.hat(turned)]
        if self.estimate_intrinsics:
            parts.append(camera.project_by_intrinsics(points))
        if len(places):
            parts.append(by_point @ R @ by_places)
        sigma = self.noise_scale * self.noise.pixel
        residual, jacobian = (pixels - self.pixels) / sigma, np.concatenate(parts, axis=-1) / sigma
        return LinearizedResiduals(residual, jacobian, self.local_jacobian(T_sensor_board))

    def local_jacobian(self, T_sensor_board: Array) -> Array:  # noqa: ARG002
        """See :class:`Views`: corners depend on all of the pose."""
        size = 6 + self.extra_count
        return np.broadcast_to(np.eye(size), (len(self.board), size, size))

    def local_difference(self, T_before: Array, T_sensor_board: Array, own: Array) -> Array:
        """See :class:`Views`."""
        return difference_along_sensor(T_before, T_sensor_board, own)

    def _displace_tags(self, places: Array) -> tuple[Array, Array]:
        """Corners (N, 3) with their tags moved by ``places`` (M, 3), and derivatives (N, 3, 3 M) by those."""
        if self.tag_index is None or not len(places):
            return self.corners_board, np.zeros((len(self.corners_board), 3, 0))
        moved, of = self.corners_board.copy(), np.flatnonzero(self.tag_index >= 0)
        x, y, angle = places[self.tag_index[of]].T
        center, (c, s) = self.tag_centers[self.tag_index[of]], (np.cos(angle), np.sin(angle))
        dx, dy = (self.corners_board[of, :2] - center).T
        arm = np.stack([c * dx - s * dy, s * dx + c * dy], axis=-1)
        moved[of, :2] = center + arm + np.stack([x, y], axis=-1)
        J = np.zeros((len(moved), 3, len(places), 3))
        J[of, 0, self.tag_index[of], 0] = J[of, 1, self.tag_index[of], 1] = 1
        J[of, 0, self.tag_index[of], 2], J[of, 1, self.tag_index[of], 2] = -arm[:, 1], arm[:, 0]
        return moved, J.reshape(len(moved), 3, -1)

    def update_noise(self, T_sensor_board: Array, scale: float) -> "CornerObservations":  # noqa: ARG002
        """See :class:`Views`."""
        return replace(self, noise_scale=scale)

    def select(self, keep: NDArray[np.bool_] | Index) -> "CornerObservations":
        """See :class:`Views`."""
        start, kept = select_measurements(self.start, len(self.pixels), keep)
        return replace(
            self,
            board=self.board[keep],
            start=start,
            corners_board=self.corners_board[kept],
            pixels=self.pixels[kept],
            tag_index=None if self.tag_index is None else self.tag_index[kept],
        )


@dataclass(frozen=True, eq=False)
class RangeObservations:
    """Ranges along a scanner's beams to the plane of the board: metres."""

    board: Index
    start: Index
    directions: Array
    """(N, 3) unit vectors in the sensor frame; column by column in memory, which is how they are used."""
    ranges: Array
    """(N,) m."""
    noise: RangeNoise
    sigma: Array
    """(N,) standard deviation of each range, m: held while poses move, for it depends on them."""
    noise_scale: float = 1.0
    extra_count: int = 0
    """1 if the scanner's ranges have an unknown bias, m."""
    dimension: ClassVar[int] = 1

    @classmethod
    def from_detections(
        cls, board: Sequence[int], found: Sequence[PlanePatch | Segment], noise: RangeNoise, bias: bool = False
    ) -> "RangeObservations":
        """The views of detections ``found`` of these boards."""
        points = np.concatenate([np.empty((0, 3)), *(d.points for d in found)])
        ranges = np.linalg.norm(points, axis=1)
        return cls(
            np.array(board, dtype=np.intp),
            start_indices([len(d.points) for d in found]),
            np.asfortranarray(points / ranges[:, None]),
            ranges,
            noise,
            np.full(len(ranges), noise.range),
            extra_count=int(bias),
        )

    def linearize(self, T_sensor_board: Array, own: Array) -> LinearizedResiduals:
        """See :class:`Views`: a beam u meets the plane ``n @ x = h`` at the range ``h / n @ u``.

        Of the board's pose, ranges know the plane: they change by ``u @ (n dh - h dn) / (n @ u)²``.
        """
        h, cosine = self._intersect_planes(T_sensor_board)
        # Column by column, as they are computed.
        columns = np.empty((3 + self.extra_count, len(self.ranges)))
        np.multiply(self.directions.T, 1 / (cosine**2 * self.sigma), out=columns[:3])
        columns[3:] = 1 / self.sigma
        residual = (np.repeat(h, self._counts) / cosine + own.sum() - self.ranges) / self.sigma
        return LinearizedResiduals(residual[:, None], columns.T[:, None], self.local_jacobian(T_sensor_board))

    def local_jacobian(self, T_sensor_board: Array) -> Array:
        """See :class:`Views`: (V, 3 + e, 6 + e), how ``n dh - h dn`` moves with the pose."""
        n, h = _board_planes(T_sensor_board)
        basis = np.zeros((len(self.board), 3 + self.extra_count, 6 + self.extra_count))
        basis[:, :3, :3] = n[:, :, None] * n[:, None]
        lever = np.cross(n, T_sensor_board[:, :3, 3])
        basis[:, :3, 3:6] = h[:, None, None] * so3.hat(n) + n[:, :, None] * lever[:, None]
        basis[:, 3:, 6:] = np.eye(self.extra_count)
        return basis

    def local_difference(self, T_before: Array, T_sensor_board: Array, own: Array) -> Array:
        """See :class:`Views`: (V, 3 + e) of ``n dh - h dn`` and own unknowns.

        Ranges change by ``u @ (n dh - h dn)`` over both cosines, however large the step.
        """
        (n, h), (n_after, h_after) = _board_planes(T_before), _board_planes(T_sensor_board)
        planes = n * (h_after - h)[:, None] - h[:, None] * (n_after - n)
        return np.concatenate([planes, np.broadcast_to(own, (len(n), len(own)))], axis=-1)

    def update_noise(self, T_sensor_board: Array, scale: float) -> "RangeObservations":
        """See :class:`Views`: an error of the beam's direction counts the more, the flatter it meets the board."""
        _, cosine = self._intersect_planes(T_sensor_board)
        tangent2 = np.maximum(1 / cosine**2 - 1, 0)
        sigma = scale * np.sqrt(self.noise.range**2 + (self.noise.angle * self.ranges) ** 2 * tangent2)
        return replace(self, sigma=sigma, noise_scale=scale)

    def select(self, keep: NDArray[np.bool_] | Index) -> "RangeObservations":
        """See :class:`Views`."""
        start, kept = select_measurements(self.start, len(self.ranges), keep)
        return replace(
            self,
            board=self.board[keep],
            start=start,
            directions=self.directions.T[:, kept].T,
            ranges=self.ranges[kept],
            sigma=self.sigma[kept],
        )

    @property
    def _counts(self) -> Index:
        """(V,) how many beams each view has."""
        return np.diff(self.start, append=len(self.ranges))

    def _intersect_planes(self, T_sensor_board: Array) -> tuple[Array, Array]:
        """Offsets of the planes (V,), and cosines (N,) of beams and normals."""
        n, h = _board_planes(T_sensor_board)
        cosine = np.einsum("in,in->n", self.directions.T, np.repeat(n.T, self._counts, axis=1))
        return h, np.copysign(np.maximum(np.abs(cosine), _MIN_COSINE), cosine)


def _board_planes(T_sensor_board: Array) -> tuple[Array, Array]:
    """Normals (V, 3) of boards, and their offsets along these (V,): ``n @ x = h``."""
    n = T_sensor_board[:, :3, 2]
    return n, np.sum(n * T_sensor_board[:, :3, 3], axis=-1)


def relative_poses(T_root_sensor: Array, T_root_board: Array) -> Array:
    """``T_sensor_board`` (V, 4, 4) of boards (V, 4, 4) before one sensor (4, 4)."""
    return np.asarray(se3.inverse(T_root_sensor) @ T_root_board)


def difference_along_sensor(T_before: Array, T_sensor_board: Array, own: Array) -> Array:
    """(V, 6 + e) from poses to poses (V, 4, 4), along the sensor's axes, and of own unknowns (e,)."""
    return np.concatenate(
        [se3.difference(T_sensor_board, T_before), np.broadcast_to(own, (len(T_before), len(own)))], axis=-1
    )


def start_indices(counts: Sequence[int]) -> Index:
    """(V,) the first measurement of each view, for the number of measurements of each."""
    return np.cumsum([0, *counts], dtype=np.intp)[:-1]


def view_indices(start: Index, count: int) -> Index:
    """(N,) which view each measurement belongs to."""
    return np.repeat(np.arange(len(start)), np.diff(start, append=count))


def select_measurements(start: Index, count: int, keep: NDArray[np.bool_] | Index) -> tuple[Index, Index]:
    """Where the chosen views start after selection, and which measurements are theirs."""
    counts = np.diff(start, append=count)[keep]
    after = start_indices(counts.tolist())
    return after, np.repeat(start[keep] - after, counts) + np.arange(counts.sum())
