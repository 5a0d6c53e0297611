"""Ranges along a scanner's beams to boards, with systematic errors of ranges, angles, rings and boards."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import PlanePatch, Segment
from calgraph.config import RangeNoise
from calgraph.geometry import Array, Index, se3, so3
from calgraph.rig.bundle.board_motions import select_motions, stack_motions, velocity_along_sensor
from calgraph.rig.bundle.observations import (
    LinearizedResiduals,
    gather_extra,
    no_extra,
    select_extra,
    select_measurements,
    start_indices,
    view_indices,
)

SCANNER_PARAMETERS = ("range bias", "range scale", "bow along x", "bow along y")
"""Systematic parameters of ranges, in the order of a view's local parameters after the plane."""
BIAS_COLUMN = 3
"""Of the local parameters, that of a range bias: a ring's bias acts in the same way on some of the beams."""

# Limit on the beams of all views of a scanner, half a kilobyte each in a solution. Rests of a second before 16
# beams have 6,000 each: of 250 rests (16 GB of raw images), 1,000 each remain, whose noise is 0.4 mm in the view's
# plane, less than the bias of a view, 1 to 2 mm.
_MAX_BEAMS = 250_000


@dataclass(frozen=True, eq=False)
class RangeObservations:
    """Ranges along a scanner's beams to the plane of the board: metres.

    Implements :class:`calgraph.rig.bundle.observations.BoardViews`. The local parameters are three of the
    plane, ``SCANNER_PARAMETERS`` (m, or relative), the relative scale of azimuths where there are, the errors
    that vary over the view (m), the delay of
    stamps (s) if boards move, and one bias a ring.
    """

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
    """Least cosine between a beam and the board's normal: at grazing incidence the range is not linear in the
    pose."""
    noise_scale: float = 1.0
    azimuth: Array | None = None
    """(N,) rad, of scanners whose azimuths may be scaled."""
    shapes: Array | None = None
    """(N, K) errors of ranges that vary over the view, by their parameters; constant within a minimisation."""
    ring: Index | None = None
    """(N,) index of each beam's ring, ascending within a view; None without rings."""
    ring_count: int = 0
    half_size: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """(V, 2) half width and height of each bowed board, m; infinite where it is not known which board it is."""
    registered: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    """(V,) whether the pose of each bowed board within its plane is known."""
    bow_shape: Array | None = None
    """(N, 2) height of each beam's end on a board with a bow of 1 m along x and y; constant within a
    minimisation."""
    extra_of_local: Index = field(default_factory=lambda: np.zeros((0, 0), dtype=np.intp))
    """(V, m) as of :class:`calgraph.rig.bundle.corner_observations.CornerObservations`."""
    extra_count: int = 0
    timed: bool = False
    """Whether the last local parameter before those of rings is the delay of stamps, s."""
    twist: Array = field(default_factory=lambda: np.zeros((0, 6)))
    """See :class:`BoardViews`."""
    motion_variance: Array = field(default_factory=lambda: np.zeros((0, 6)))
    """See :class:`BoardViews`."""
    dimension: ClassVar[int] = 1

    @classmethod
    def from_detections(
        cls, board: Sequence[int], detections: Sequence[PlanePatch | Segment], noise: RangeNoise, min_cosine: float
    ) -> "RangeObservations":
        """The views of these boards in their detections, without systematic errors.

        Of many beams, those of each view are thinned evenly.
        """
        quota = _MAX_BEAMS // max(len(detections), 1)
        kept = [_spread_evenly(len(d.ranges), quota) for d in detections]
        ranges = np.concatenate([np.empty(0), *(d.ranges[k] for d, k in zip(detections, kept, strict=True))])
        directions = np.concatenate([
            np.empty((0, 3)), *(d.directions[k] for d, k in zip(detections, kept, strict=True))
        ])  # fmt: skip
        return cls(
            np.array(board, dtype=np.intp),
            start_indices([len(k) for k in kept]),
            np.asfortranarray(directions),
            ranges,
            noise,
            noise.of_beams(ranges, directions),
            min_cosine,
            extra_of_local=no_extra(len(board)),
            twist=stack_motions([d.twist for d in detections]),
            motion_variance=stack_motions([d.motion_variance for d in detections]),
        )

    def linearize(self, T_sensor_board: Array, extra: Array) -> LinearizedResiduals:
        """See :class:`BoardViews`: a beam u meets the surface ``n @ x = h + z`` at the range ``(h + z) / n @ u``.

        The plane changes this by ``u @ (n dh - h dn) / (n @ u)²``; the share ``z / h`` of a bow z in it, below
        0.01, is neglected.
        """
        velocity = velocity_along_sensor(self.twist, T_sensor_board)
        local, view = gather_extra(self.extra_of_local, extra), view_indices(self.start, len(self.ranges))
        if not local.shape[1]:
            h, cosine = self._intersect_planes(T_sensor_board)
            distance = np.repeat(h, self._counts) / cosine
            # Column-major, in the order of computation.
            columns = np.empty((3, len(self.ranges)))
            np.multiply(self.directions.T, 1 / (cosine**2 * self.sigma), out=columns)
            residual = (distance - self.ranges) / self.sigma
            by_plane = self.local_jacobian(T_sensor_board)
            return LinearizedResiduals(residual[:, None], columns.T[:, None], by_plane, 3, velocity=velocity)
        shared = local[0] if len(local) else np.zeros(local.shape[1])
        bias, scale = shared[:2]
        directions, by_azimuth = self.directions, None
        if self.azimuth is not None:
            turn = shared[len(SCANNER_PARAMETERS)] * self.azimuth
            directions = so3.rotate_z(turn, self.directions)
            across = np.stack([-directions[:, 1], directions[:, 0], np.zeros(len(turn))])
            by_azimuth = across.T * self.azimuth[:, None]
        T_measured, by_delay, local_jacobian = T_sensor_board, None, self.local_jacobian(T_sensor_board)
        if self.timed and velocity is not None:
            delay = shared[local.shape[1] - self.ring_count - 1]
            T_measured = se3.retract(T_sensor_board, delay * velocity)
            by_delay = _plane_velocity(T_measured, self.twist)
            local_jacobian = self.local_jacobian(T_measured)
            local_jacobian[..., :3] += local_jacobian[..., :3] @ so3.hat(delay * velocity[:, 3:])
            local_jacobian[..., 3:6] = local_jacobian[..., 3:6] @ so3.exp(delay * velocity[:, 3:])
        h, cosine = self._intersect_planes(T_measured, directions)
        height = np.repeat(h, self._counts)
        if self.bow_shape is not None:
            height = height + np.sum(self.bow_shape * local[view, 2:4], axis=-1)
        distance, stretch = height / cosine, (1 + scale) / self.sigma
        q = 3 + local.shape[1] - self.ring_count
        columns = np.empty((q, len(self.ranges)))
        np.multiply(directions.T, stretch / cosine**2, out=columns[:3])
        columns[BIAS_COLUMN], columns[4] = 1 / self.sigma, distance / self.sigma
        columns[5:7] = 0 if self.bow_shape is None else (stretch / cosine) * self.bow_shape.T
        if by_azimuth is not None:
            n = np.repeat(T_measured[:, :3, 2].T, self._counts, axis=1)
            columns[7] = -np.einsum("in,ni->n", n, by_azimuth) * stretch * distance / cosine
        if self.shapes is not None:
            first = len(SCANNER_PARAMETERS) + (self.azimuth is not None)
            count = self.shapes.shape[1]
            columns[3 + first : 3 + first + count] = self.shapes.T / self.sigma
        if self.timed:
            columns[-1] = 0 if by_delay is None else np.einsum("in,ni->n", columns[:3], by_delay[view])
        predicted = (1 + scale) * distance + bias
        if self.shapes is not None:
            predicted = predicted + self.shapes @ shared[first : first + count]
        if self.ring is not None:
            predicted = predicted + local[view, local.shape[1] - self.ring_count + self.ring]
        residual = (predicted - self.ranges) / self.sigma
        return LinearizedResiduals(
            residual[:, None],
            columns.T[:, None],
            local_jacobian,
            3,
            self.ring,
            self.ring_count,
            BIAS_COLUMN,
            velocity,
        )

    def local_jacobian(self, T_sensor_board: Array) -> Array:
        """See :class:`BoardViews`: derivatives of ``n dh - h dn``, and the extra parameters of each view."""
        n, h = _board_planes(T_sensor_board)
        views, m = self.extra_of_local.shape
        basis = np.zeros((views, 3 + m, 6 + self.extra_count))
        basis[:, :3, :3] = n[:, :, None] * n[:, None]
        lever = np.cross(n, T_sensor_board[:, :3, 3])
        basis[:, :3, 3:6] = h[:, None, None] * so3.hat(n) + n[:, :, None] * lever[:, None]
        basis[:, 3:, 6:] = select_extra(self.extra_of_local, self.extra_count)
        return basis

    def local_difference(self, T_before: Array, T_sensor_board: Array, extra: Array) -> Array:
        """See :class:`BoardViews`: ``n dh - h dn`` and the extra parameters.

        Ranges change by exactly ``u @ (n dh - h dn)`` over both cosines.
        """
        (n, h), (n_after, h_after) = _board_planes(T_before), _board_planes(T_sensor_board)
        planes = n * (h_after - h)[:, None] - h[:, None] * (n_after - n)
        return np.concatenate([planes, gather_extra(self.extra_of_local, extra)], axis=-1)

    def is_defined(self, T_sensor_board: Array, extra: Array) -> bool:  # noqa: ARG002
        """See :class:`BoardViews`."""
        return True

    def update_noise(self, T_sensor_board: Array, scale: float) -> "RangeObservations":
        """See :class:`BoardViews`: the error of a beam's direction grows with the tangent of its incidence."""
        h, cosine = self._intersect_planes(T_sensor_board)
        tangent2 = np.maximum(1 / cosine**2 - 1, 0)
        expected = np.repeat(h, self._counts) / cosine
        along = self.noise.of_beams(expected, self.directions)
        # Not at the measured ranges: parameters of these shapes would then fit the noise of the ranges.
        shapes = None if self.shapes is None else self.noise.error_shapes(expected, self.directions)
        sigma = scale * np.sqrt(along**2 + (self.noise.angle * self.ranges) ** 2 * tangent2)
        shape = None
        if np.isfinite(self.half_size).any():
            T, counts = se3.inverse(T_sensor_board), self._counts
            on_board = np.stack([
                np.einsum("in,ni->n", np.repeat(T[:, axis, :3].T, counts, axis=1), self.directions) * expected
                + np.repeat(T[:, axis, 3], counts)
                for axis in range(2)
            ])  # fmt: skip
            half, known = np.repeat(self.half_size, counts, axis=0), np.repeat(self.registered, counts)[:, None]
            shape = np.where(known, bow_shape(on_board.T, half), round_bow_shape(on_board.T, half))
        return replace(self, sigma=sigma, noise_scale=scale, bow_shape=shape, shapes=shapes)

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
            azimuth=None if self.azimuth is None else self.azimuth[kept],
            shapes=None if self.shapes is None else self.shapes[kept],
            ring=None if self.ring is None else self.ring[kept],
            half_size=self.half_size[keep] if len(self.half_size) else self.half_size,
            registered=self.registered[keep] if len(self.registered) else self.registered,
            bow_shape=None if self.bow_shape is None else self.bow_shape[kept],
            extra_of_local=self.extra_of_local[keep],
            twist=select_motions(self.twist, keep),
            motion_variance=select_motions(self.motion_variance, keep),
        )

    def with_rings(self, ring: Index, count: int) -> "RangeObservations":
        """The same beams in the order of their rings (N,), of which there are ``count``, within each view."""
        order = np.lexsort([ring, view_indices(self.start, len(self.ranges))])
        return replace(
            self,
            directions=self.directions.T[:, order].T,
            ranges=self.ranges[order],
            sigma=self.sigma[order],
            azimuth=None if self.azimuth is None else self.azimuth[order],
            shapes=None if self.shapes is None else self.shapes[order],
            ring=ring[order],
            ring_count=count,
        )

    def with_beams(self, board: Index, start: Index, directions: Array, ranges: Array) -> "RangeObservations":
        """Other beams of the same scanner, (N,), on boards like that of its first view.

        Beams of a multi-beam scanner belong to the ring of the nearest elevation.
        """
        first = np.zeros(len(board), dtype=np.intp)
        beams = replace(
            self,
            board=board,
            start=start,
            directions=directions,
            ranges=ranges,
            sigma=np.ones(len(ranges)),
            azimuth=None if self.azimuth is None else np.arctan2(directions[:, 1], directions[:, 0]),
            shapes=None if self.shapes is None else self.noise.error_shapes(ranges, directions),
            half_size=self.half_size[first] if len(self.half_size) else self.half_size,
            registered=self.registered[first] if len(self.registered) else self.registered,
            bow_shape=None,
            extra_of_local=self.extra_of_local[first],
            twist=np.zeros((0, 6)),
            motion_variance=np.zeros((0, 6)),
        )
        if self.ring is None:
            return beams
        count = np.bincount(self.ring, minlength=self.ring_count)
        elevation = np.bincount(self.ring, self.directions[:, 2], self.ring_count) / np.maximum(count, 1)
        nearest = np.argmin(np.abs(directions[:, 2:] - elevation), axis=1)
        return beams.with_rings(nearest, self.ring_count)

    @property
    def _counts(self) -> Index:
        """(V,) number of beams of each view."""
        return np.diff(self.start, append=len(self.ranges))

    def _intersect_planes(self, T_sensor_board: Array, directions: Array | None = None) -> tuple[Array, Array]:
        """Offsets of the planes (V,), and cosines (N,) between beams and normals."""
        n, h = _board_planes(T_sensor_board)
        beams = self.directions if directions is None else directions
        cosine = np.einsum("in,in->n", beams.T, np.repeat(n.T, self._counts, axis=1))
        return h, np.copysign(np.maximum(np.abs(cosine), self.min_cosine), cosine)


def bow_shape(points: Array, half_size: Array) -> Array:
    """(N, 2) heights of points (N, 2) on boards (N, 2) with a bow of 1 m along x and y.

    A parabola from edge to edge, relative to the best plane; the bow is its height. Zero where sizes are infinite.
    """
    known = np.isfinite(half_size)
    share = np.clip(points / np.where(known, half_size, 1.0), -1, 1)
    return np.asarray(np.where(known, share**2 - 1 / 3, 0.0))


def round_bow_shape(points: Array, half_size: Array) -> Array:
    """(N, 2) as :func:`bow_shape`, of boards in an unknown rotation about the point (0, 0) of their plane.

    The mean of the heights over all rotations: a paraboloid with the boards' mean curvature. That the point is not
    the centre of the board tilts and displaces it only, which its pose does as well.
    """
    known = np.isfinite(half_size)
    square = np.where(known, half_size, 1.0) ** 2
    diagonal = square.sum(axis=-1, keepdims=True)
    # No two points of a board are farther apart than its diagonal.
    distance = np.minimum(np.sum(points**2, axis=-1, keepdims=True), 4 * diagonal)
    return np.asarray(np.where(known, (distance - diagonal / 3) / (2 * square), 0.0))


def _spread_evenly(count: int, limit: int) -> Index:
    """Ascending indices of ``limit`` of ``count`` beams, or of all.

    The smallest multiples of the golden ratio modulo 1: evenly spread over any order of rings and columns (Knuth,
    "The art of computer programming", volume 3, section 6.4), where each n-th beam may be of one ring.
    """
    if count <= limit:
        return np.arange(count)
    return np.sort(np.argpartition(np.arange(count) * ((math.sqrt(5) - 1) / 2) % 1, limit)[:limit])


def _plane_velocity(T_sensor_board: Array, twist: Array) -> Array:
    """(V, 3) change of ``n dh - h dn`` per second, of boards (V, 4, 4) with twists (V, 6)."""
    n, h = _board_planes(T_sensor_board)
    return np.asarray(
        n * np.sum(n * twist[:, :3], axis=-1, keepdims=True) - h[:, None] * np.cross(twist[:, 3:], n)
    )


def _board_planes(T_sensor_board: Array) -> tuple[Array, Array]:
    """Normals (V, 3) and offsets (V,) of the boards' planes ``n @ x = h``."""
    n = T_sensor_board[:, :3, 2]
    return n, np.sum(n * T_sensor_board[:, :3, 3], axis=-1)
