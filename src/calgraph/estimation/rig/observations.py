"""Observations of boards by one sensor, and their residuals as functions of the board's pose before the sensor.

A *view* is the set of one sensor's measurements of one board: corners in pixels, or ranges along beams. They
depend on ``T_sensor_board`` alone, so residuals are differentiated by that pose: by perturbations (translation,
rotation) along the sensor's fixed axes, as :func:`calgraph.geometry.se3.retract` applies them.
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


@dataclass(frozen=True, eq=False)
class LinearizedResiduals:
    """Whitened residuals of N measurements, of dimension k, in V views, and their derivatives.

    A view's measurements may depend on fewer than six parameters, as ranges do on the plane alone: derivatives are
    by q local parameters, which are differentiated by the pose and the sensor's e extra parameters.
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
        """(V,) index of each view's board; no board twice."""

    @property
    def start(self) -> Index:
        """(V,) the first measurement of each view."""

    @property
    def noise_scale(self) -> float:
        """Standard deviation of the noise over that stated."""

    @property
    def dimension(self) -> int:
        """Dimension k of each measurement."""

    @property
    def extra_count(self) -> int:
        """Number e of the sensor's extra parameters."""

    def linearize(self, T_sensor_board: Array, extra: Array) -> LinearizedResiduals:
        """Residuals and derivatives at poses (V, 4, 4) and the sensor's extra parameters (e,)."""

    def local_jacobian(self, T_sensor_board: Array) -> Array:
        """(V, q, 6 + e) derivatives of the local parameters by the pose and the extra parameters."""

    def local_difference(self, T_before: Array, T_sensor_board: Array, extra: Array) -> Array:
        """(V, q) difference of the local parameters between two poses, for a difference ``extra`` (e,)."""

    def update_noise(self, T_sensor_board: Array, scale: float) -> Self:
        """The same views with the noise at these poses, ``scale`` times that stated."""

    def select(self, keep: NDArray[np.bool_] | Index) -> Self:
        """Some of the views: a mask (V,), or indices, which may repeat."""


@dataclass(frozen=True, eq=False)
class CornerObservations:
    """Printed corners in a camera's images, through its full model: pixels."""

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
    """Whether the camera's intrinsics are estimated."""
    tag_centers: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """(M, 2) centres of the tags whose displacements on the board are estimated, m."""
    tag_index: Index | None = None
    """(N,) row in ``tag_centers`` of each corner; -1 for none. Required where there are any."""
    dimension: ClassVar[int] = 2

    @classmethod
    def from_detections(
        cls, board: Sequence[int], detections: Sequence[BoardCorners], camera: CameraModel, noise: PixelNoise
    ) -> "CornerObservations":
        """The views of these boards in their detections."""
        return cls(
            np.array(board, dtype=np.intp),
            start_indices([len(d.pixels) for d in detections]),
            np.concatenate([np.empty((0, 3)), *(d.corners_board for d in detections)]),
            np.concatenate([np.empty((0, 2)), *(d.pixels for d in detections)]),
            camera,
            noise,
        )

    @property
    def extra_count(self) -> int:
        """The camera's intrinsics, then the displacement (x, y, rotation) of each tag, m and rad."""
        return len(self.camera.intrinsics) * self.estimate_intrinsics + 3 * len(self.tag_centers)

    def linearize(self, T_sensor_board: Array, extra: Array) -> LinearizedResiduals:
        """See :class:`BoardViews`: reprojection errors."""
        view = view_indices(self.start, len(self.pixels))
        intrinsics, displacements = np.split(extra, [self.extra_count - 3 * len(self.tag_centers)])
        camera = self.camera.with_intrinsics(intrinsics) if self.estimate_intrinsics else self.camera
        corners_board, by_displacements = self._displace_tags(displacements.reshape(-1, 3))
        R = T_sensor_board[view, :3, :3]
        rotated = (R @ corners_board[..., None])[..., 0]
        points = rotated + T_sensor_board[view, :3, 3]
        pixels, by_point = camera.project_with_jacobian(points)
        derivatives = [by_point, -by_point @ so3.hat(rotated)]
        if self.estimate_intrinsics:
            derivatives.append(camera.project_by_intrinsics(points))
        if len(displacements):
            derivatives.append(by_point @ R @ by_displacements)
        sigma = self.noise_scale * self.noise.pixel
        residual, jacobian = (pixels - self.pixels) / sigma, np.concatenate(derivatives, axis=-1) / sigma
        return LinearizedResiduals(residual, jacobian, self.local_jacobian(T_sensor_board))

    def local_jacobian(self, T_sensor_board: Array) -> Array:  # noqa: ARG002
        """See :class:`BoardViews`: the local parameters of corners are the pose itself."""
        size = 6 + self.extra_count
        return np.broadcast_to(np.eye(size), (len(self.board), size, size))

    def local_difference(self, T_before: Array, T_sensor_board: Array, extra: Array) -> Array:
        """See :class:`BoardViews`."""
        return difference_along_sensor(T_before, T_sensor_board, extra)

    def _displace_tags(self, displacements: Array) -> tuple[Array, Array]:
        """Corners (N, 3) with their tags displaced by (M, 3), and derivatives (N, 3, 3 M) by these."""
        if self.tag_index is None:
            return self.corners_board, np.zeros((len(self.corners_board), 3, 0))
        displaced, on_tag = self.corners_board.copy(), np.flatnonzero(self.tag_index >= 0)
        x, y, angle = displacements[self.tag_index[on_tag]].T
        center, (c, s) = self.tag_centers[self.tag_index[on_tag]], (np.cos(angle), np.sin(angle))
        dx, dy = (self.corners_board[on_tag, :2] - center).T
        arm = np.stack([c * dx - s * dy, s * dx + c * dy], axis=-1)
        displaced[on_tag, :2] = center + arm + np.stack([x, y], axis=-1)
        J = np.zeros((len(displaced), 3, len(displacements), 3))
        J[on_tag, 0, self.tag_index[on_tag], 0] = J[on_tag, 1, self.tag_index[on_tag], 1] = 1
        J[on_tag, 0, self.tag_index[on_tag], 2], J[on_tag, 1, self.tag_index[on_tag], 2] = -arm[:, 1], arm[:, 0]
        return displaced, J.reshape(len(displaced), 3, displacements.size)

    def update_noise(self, T_sensor_board: Array, scale: float) -> "CornerObservations":  # noqa: ARG002
        """See :class:`BoardViews`."""
        return replace(self, noise_scale=scale)

    def select(self, keep: NDArray[np.bool_] | Index) -> "CornerObservations":
        """See :class:`BoardViews`."""
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
    """(N, 3) unit vectors in the sensor frame; column-major, in the order of use."""
    ranges: Array
    """(N,) m."""
    noise: RangeNoise
    sigma: Array
    """(N,) standard deviation of each range, m: it depends on the poses, but is constant within a minimisation."""
    min_cosine: float
    """Least cosine between a beam and the board's normal, at which smaller ones are truncated."""
    noise_scale: float = 1.0
    extra_count: int = 0
    """1 if the scanner's range bias (m) is estimated."""
    dimension: ClassVar[int] = 1

    @classmethod
    def from_detections(
        cls,
        board: Sequence[int],
        detections: Sequence[PlanePatch | Segment],
        noise: RangeNoise,
        min_cosine: float,
    ) -> "RangeObservations":
        """The views of these boards in their detections."""
        ranges = np.concatenate([np.empty(0), *(d.ranges for d in detections)])
        directions = np.concatenate([np.empty((0, 3)), *(d.directions for d in detections)])
        return cls(
            np.array(board, dtype=np.intp),
            start_indices([len(d.ranges) for d in detections]),
            np.asfortranarray(directions),
            ranges,
            noise,
            np.full(len(ranges), noise.range),
            min_cosine,
        )

    def linearize(self, T_sensor_board: Array, extra: Array) -> LinearizedResiduals:
        """See :class:`BoardViews`: a beam u meets the plane ``n @ x = h`` at the range ``h / n @ u``.

        Ranges depend on the plane alone: they change by ``u @ (n dh - h dn) / (n @ u)²``.
        """
        h, cosine = self._intersect_planes(T_sensor_board)
        # Column-major, in the order of computation.
        columns = np.empty((3 + self.extra_count, len(self.ranges)))
        np.multiply(self.directions.T, 1 / (cosine**2 * self.sigma), out=columns[:3])
        columns[3:] = 1 / self.sigma
        residual = (np.repeat(h, self._counts) / cosine + extra.sum() - self.ranges) / self.sigma
        return LinearizedResiduals(residual[:, None], columns.T[:, None], self.local_jacobian(T_sensor_board))

    def local_jacobian(self, T_sensor_board: Array) -> Array:
        """See :class:`BoardViews`: (V, 3 + e, 6 + e) derivatives of ``n dh - h dn``."""
        n, h = _board_planes(T_sensor_board)
        basis = np.zeros((len(self.board), 3 + self.extra_count, 6 + self.extra_count))
        basis[:, :3, :3] = n[:, :, None] * n[:, None]
        lever = np.cross(n, T_sensor_board[:, :3, 3])
        basis[:, :3, 3:6] = h[:, None, None] * so3.hat(n) + n[:, :, None] * lever[:, None]
        basis[:, 3:, 6:] = np.eye(self.extra_count)
        return basis

    def local_difference(self, T_before: Array, T_sensor_board: Array, extra: Array) -> Array:
        """See :class:`BoardViews`: (V, 3 + e) ``n dh - h dn`` and the extra parameters.

        Ranges change by exactly ``u @ (n dh - h dn)`` over both cosines.
        """
        (n, h), (n_after, h_after) = _board_planes(T_before), _board_planes(T_sensor_board)
        planes = n * (h_after - h)[:, None] - h[:, None] * (n_after - n)
        return np.concatenate([planes, np.broadcast_to(extra, (len(n), len(extra)))], axis=-1)

    def update_noise(self, T_sensor_board: Array, scale: float) -> "RangeObservations":
        """See :class:`BoardViews`: the error of a beam's direction grows with the tangent of its incidence."""
        _, cosine = self._intersect_planes(T_sensor_board)
        tangent2 = np.maximum(1 / cosine**2 - 1, 0)
        sigma = scale * np.sqrt(self.noise.range**2 + (self.noise.angle * self.ranges) ** 2 * tangent2)
        return replace(self, sigma=sigma, noise_scale=scale)

    def select(self, keep: NDArray[np.bool_] | Index) -> "RangeObservations":
        """See :class:`BoardViews`."""
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
        """(V,) number of beams of each view."""
        return np.diff(self.start, append=len(self.ranges))

    def _intersect_planes(self, T_sensor_board: Array) -> tuple[Array, Array]:
        """Offsets of the planes (V,), and cosines (N,) between beams and normals."""
        n, h = _board_planes(T_sensor_board)
        cosine = np.einsum("in,in->n", self.directions.T, np.repeat(n.T, self._counts, axis=1))
        return h, np.copysign(np.maximum(np.abs(cosine), self.min_cosine), cosine)


def _board_planes(T_sensor_board: Array) -> tuple[Array, Array]:
    """Normals (V, 3) and offsets (V,) of the boards' planes ``n @ x = h``."""
    n = T_sensor_board[:, :3, 2]
    return n, np.sum(n * T_sensor_board[:, :3, 3], axis=-1)


def relative_poses(T_root_sensor: Array, T_root_board: Array) -> Array:
    """``T_sensor_board`` (V, 4, 4) of boards (V, 4, 4) for one sensor (4, 4)."""
    return np.asarray(se3.inverse(T_root_sensor) @ T_root_board)


def difference_along_sensor(T_before: Array, T_sensor_board: Array, extra: Array) -> Array:
    """(V, 6 + e) difference of poses (V, 4, 4) along the sensor's axes, and of extra parameters (e,)."""
    return np.concatenate(
        [se3.difference(T_sensor_board, T_before), np.broadcast_to(extra, (len(T_before), len(extra)))], axis=-1
    )


def start_indices(counts: Sequence[int]) -> Index:
    """(V,) the first measurement of each view, from the number of measurements of each."""
    return np.cumsum([0, *counts], dtype=np.intp)[:-1]


def view_indices(start: Index, count: int) -> Index:
    """(N,) the view of each measurement."""
    return np.repeat(np.arange(len(start)), np.diff(start, append=count))


def select_measurements(start: Index, count: int, keep: NDArray[np.bool_] | Index) -> tuple[Index, Index]:
    """First measurements of the selected views after selection, and the indices of their measurements."""
    counts = np.diff(start, append=count)[keep]
    after = start_indices(counts.tolist())
    return after, np.repeat(start[keep] - after, counts) + np.arange(counts.sum())
