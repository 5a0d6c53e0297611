"""Ranges along a scanner's beams to boards, with systematic errors of ranges, angles, rings and boards."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import PlanePatch, Segment
from calgraph.config import RangeNoise
from calgraph.geometry import Array, Index, se3, so3
from calgraph.rig.bundle.bundle_parameters import LocalParameters
from calgraph.rig.bundle.observations import (
    BoardViews,
    LinearizedResiduals,
    select_measurements,
    select_some,
    stack_motions,
    start_indices,
    velocity_along_sensor,
    view_indices,
)
from calgraph.sensors.kinds.stated import BeamError, list_turns

# Limit on the beams of all views of a scanner, half a kilobyte each in a solution. Rests of a second before 16
# beams have 6,000 each: of 250 rests (16 GB of raw images), 1,000 each remain, whose noise is 0.4 mm in the view's
# plane, less than the bias of a view, 1 to 2 mm.
_MAX_BEAMS = 250_000


@dataclass(frozen=True, eq=False)
class RangeObservations(BoardViews):
    """Ranges along a scanner's beams to the plane of the board: metres.

    The local parameters are three of the plane, then systematic parameters in blocks ``beams``, of the errors;
    ``bow``, bows along x and y and twist of the board, m; ``delay`` of stamps, s, if boards move; ``varying``, a
    bias of each ring, m. None if all are exact.
    """

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
    errors: tuple[BeamError, ...] = ()
    """Systematic errors of the beams, in the order of their parameters."""
    ring: Index | None = None
    """(N,) index of each beam's ring, ascending within a view; None without rings."""
    half_size: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """(V, 2) half width and height of each bowed board, m; infinite where it is not known which board it is."""
    registered: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    """(V,) whether the pose of each bowed board within its plane is known."""
    bow_shape: Array | None = None
    """(N, 3) height of each beam's end on a board with a bow of 1 m along x and y, and a twist; constant within a
    minimisation."""

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
            parameters=LocalParameters.exact(len(board), {}),
            **stack_motions(detections),
        )

    def linearize(self, T_sensor_board: Array, extra: Array) -> LinearizedResiduals:
        """See :class:`BoardViews`: a beam u meets the surface ``n @ x = h + z`` at the range ``(h + z) / n @ u``.

        The plane changes this by ``u @ (n dh - h dn) / (n @ u)²``; the share ``z / h`` of a bow z in it, below
        0.01, is neglected.
        """
        velocity = velocity_along_sensor(self.twist, T_sensor_board)
        block, view = self.parameters, view_indices(self.start, len(self.ranges))
        local = block.gather(extra)
        # All but bows and biases of rings are the same in all views.
        shared = local[0] if len(local) else np.zeros(local.shape[1])
        T_measured, by_delay, by_pose = T_sensor_board, None, _plane_jacobian(T_sensor_board)
        if block.size("delay") and velocity is not None:
            moved = shared[block["delay"]] * velocity
            T_measured = se3.retract(T_sensor_board, moved)
            by_delay = _plane_velocity(T_measured, self.twist)
            by_pose = _plane_jacobian(T_measured)
            by_pose[..., :3] += by_pose[..., :3] @ so3.hat(moved[:, 3:])
            by_pose[..., 3:] = by_pose[..., 3:] @ so3.exp(moved[:, 3:])
        of_beams, directions = shared[block["beams"]], self.directions
        turning = [i for i, error in enumerate(self.errors) if error.turn]
        if turning:
            directions = so3.rotate(np.einsum("ien,e->ni", self._turns, of_beams[turning]), directions)
        h, n, cosine = self._intersect_planes(T_measured, directions)
        height = np.repeat(h, self.counts)
        if self.bow_shape is not None:
            bows = np.repeat(local[:, block["bow"]].T, self.counts, axis=1)
            height += np.einsum("ni,in->n", self.bow_shape, bows)
        distance, weight = height / cosine, 1 / self.sigma
        residual, stretch = (distance - self.ranges) * weight, np.ones(1)
        columns = np.zeros((3 + local.shape[1] - block.ring_count, len(self.ranges)))
        by_parameters = columns[3:]
        by_beams = by_parameters[block["beams"]]
        for error, at_1_m, value, by_error in zip(self.errors, self._shapes, of_beams, by_beams, strict=True):
            shape, growth = at_1_m, np.zeros(1)
            for _ in range(error.power):
                shape, growth = shape * distance, error.power * shape
            stretch = stretch + value * growth
            np.multiply(shape, weight, out=by_error)
        residual += of_beams @ by_beams
        by_height = stretch * weight / cosine
        if turning:
            lever = so3.cross(n, directions) * (distance * by_height)[:, None]
            by_beams[turning] += np.einsum("ni,ien->en", lever, self._turns)
        np.multiply(directions.T, by_height / cosine, out=columns[:3])
        if self.bow_shape is not None:
            np.multiply(by_height, self.bow_shape.T, out=by_parameters[block["bow"]])
        if by_delay is not None:
            by_parameters[block["delay"]] = np.einsum("in,ni->n", columns[:3], by_delay[view])
        if self.ring is not None:
            residual += local[:, block["varying"]][view, self.ring] * weight
        return LinearizedResiduals(
            residual[:, None],
            columns.T[:, None],
            block.jacobian(by_pose),
            3,
            self.ring,
            block.ring_count,
            0 if self.ring is None else self._bias_column,
            velocity,
        )

    def local_jacobian(self, T_sensor_board: Array) -> Array:
        """See :class:`BoardViews`: derivatives of ``n dh - h dn``, and the extra parameters of each view."""
        return self.parameters.jacobian(_plane_jacobian(T_sensor_board))

    def local_difference(self, T_before: Array, T_sensor_board: Array, extra: Array) -> Array:
        """See :class:`BoardViews`: ``n dh - h dn`` and the extra parameters.

        Ranges change by exactly ``u @ (n dh - h dn)`` over both cosines.
        """
        (n, h), (n_after, h_after) = _board_planes(T_before), _board_planes(T_sensor_board)
        planes = n * (h_after - h)[:, None] - h[:, None] * (n_after - n)
        return np.concatenate([planes, self.parameters.gather(extra)], axis=-1)

    def unwhiten(self, residual: Array) -> Array:
        """See :class:`BoardViews`."""
        return residual * self.sigma[:, None]

    def incidence(self, T_sensor_board: Array) -> Array:
        """(N,) cosines between beams and the normals of boards (V, 4, 4)."""
        normals = np.repeat(T_sensor_board[:, :3, 2], self.counts, axis=0)
        return np.asarray(np.abs(np.sum(normals * self.directions, axis=1)))

    def update_noise(self, T_sensor_board: Array, scale: float) -> "RangeObservations":
        """See :class:`BoardViews`: the error of a beam's direction grows with the tangent of its incidence."""
        h, _, cosine = self._intersect_planes(T_sensor_board, self.directions)
        tangent2 = np.maximum(1 / cosine**2 - 1, 0)
        expected = np.repeat(h, self.counts) / cosine
        along = self.noise.of_beams(expected, self.directions)
        sigma = scale * np.sqrt(along**2 + (self.noise.angle * self.ranges) ** 2 * tangent2)
        shape = None
        if np.isfinite(self.half_size).any():
            T, counts = se3.inverse(T_sensor_board), self.counts
            on_board = np.stack([
                np.einsum("in,ni->n", np.repeat(T[:, axis, :3].T, counts, axis=1), self.directions) * expected
                + np.repeat(T[:, axis, 3], counts)
                for axis in range(2)
            ])  # fmt: skip
            half, known = np.repeat(self.half_size, counts, axis=0), np.repeat(self.registered, counts)[:, None]
            shape = np.where(known, bow_shape(on_board.T, half), round_bow_shape(on_board.T, half))
        return replace(self, sigma=sigma, noise_scale=scale, bow_shape=shape)

    def select(self, keep: NDArray[np.bool_] | Index) -> "RangeObservations":
        """See :class:`BoardViews`."""
        first, kept = select_measurements(self.first, len(self.ranges), keep)
        return replace(
            self,
            first=first,
            directions=self.directions.T[:, kept].T,
            ranges=self.ranges[kept],
            sigma=self.sigma[kept],
            ring=None if self.ring is None else self.ring[kept],
            half_size=select_some(self.half_size, keep),
            registered=select_some(self.registered, keep),
            bow_shape=None if self.bow_shape is None else self.bow_shape[kept],
            **self.select_shared(keep),
        )

    def with_rings(self, ring: Index) -> "RangeObservations":
        """The same beams in the order of their rings (N,) within each view."""
        order = np.lexsort([ring, view_indices(self.start, len(self.ranges))])
        return replace(
            self,
            directions=self.directions.T[:, order].T,
            ranges=self.ranges[order],
            sigma=self.sigma[order],
            ring=ring[order],
        )

    def with_beams(self, board: Index, first: Index, directions: Array, ranges: Array) -> "RangeObservations":
        """Other beams of the same scanner, (N,), on boards like that of its first view.

        Beams of a multi-beam scanner belong to the ring of the nearest elevation.
        """
        like_first = np.zeros(len(board), dtype=np.intp)
        beams = replace(
            self,
            board=board,
            first=first,
            directions=directions,
            ranges=ranges,
            sigma=np.ones(len(ranges)),
            half_size=select_some(self.half_size, like_first),
            registered=select_some(self.registered, like_first),
            bow_shape=None,
            parameters=self.parameters.select(like_first),
            twist=np.zeros((0, 6)),
            motion_variance=np.zeros((0, 6)),
        )
        if self.ring is None:
            return beams
        rings = self.parameters.ring_count
        count = np.bincount(self.ring, minlength=rings)
        elevation = np.bincount(self.ring, self.directions[:, 2], rings) / np.maximum(count, 1)
        nearest = np.argmin(np.abs(directions[:, 2:] - elevation), axis=1)
        return beams.with_rings(nearest)

    @property
    def counts(self) -> Index:
        """(V,) number of beams of each view."""
        return np.diff(self.start, append=len(self.ranges))

    @property
    def _bias_column(self) -> int:
        """Of the local parameters, that of a range bias: a ring's bias acts in the same way on some beams."""
        return 3 + [error.quantity for error in self.errors].index("range bias")

    @cached_property
    def _turns(self) -> Array:
        """(3, E, N) as of :func:`list_turns`."""
        return list_turns(self.errors, self.directions)

    @cached_property
    def _shapes(self) -> list[Array]:
        """(N,) or (1,) lengthening of ranges of 1 m by one unit of each error, m."""
        return [error.lengthen(self.directions) if error.lengthen else np.zeros(1) for error in self.errors]

    def _intersect_planes(self, T_sensor_board: Array, directions: Array) -> tuple[Array, Array, Array]:
        """Offsets of the planes (V,), and of each beam the plane's normal (N, 3) and the cosine (N,) to it."""
        n, h = _board_planes(T_sensor_board)
        normals = np.repeat(n.T, self.counts, axis=1)
        cosine = np.einsum("in,in->n", directions.T, normals)
        return h, normals.T, np.copysign(np.maximum(np.abs(cosine), self.min_cosine), cosine)


def bow_shape(points: Array, half_size: Array) -> Array:
    """(N, 3) heights of points (N, 2) on boards (N, 2) with a bow of 1 m along x and y, and a twist of 1 m.

    A parabola from edge to edge, relative to the best plane; the bow is its height. The twist is the height of the
    corners (1, 1) and (-1, -1), and minus that of the others. Zero where sizes are infinite.
    """
    known = np.isfinite(half_size)
    share = np.where(known, np.clip(points / np.where(known, half_size, 1.0), -1, 1), 0.0)
    return np.column_stack([np.where(known, share**2 - 1 / 3, 0.0), share.prod(axis=-1)])


def round_bow_shape(points: Array, half_size: Array) -> Array:
    """(N, 3) as :func:`bow_shape`, of boards in an unknown rotation about the point (0, 0) of their plane.

    The mean of the heights over all rotations: a paraboloid with the boards' mean curvature, and no twist. That
    the point is not the centre of the board tilts and displaces it only, which its pose does as well.
    """
    known = np.isfinite(half_size)
    square = np.where(known, half_size, 1.0) ** 2
    diagonal = square.sum(axis=-1, keepdims=True)
    # No two points of a board are farther apart than its diagonal.
    distance = np.minimum(np.sum(points**2, axis=-1, keepdims=True), 4 * diagonal)
    bows = np.where(known, (distance - diagonal / 3) / (2 * square), 0.0)
    return np.column_stack([bows, np.zeros(len(bows))])


def _spread_evenly(count: int, limit: int) -> Index:
    """Ascending indices of ``limit`` of ``count`` beams, or of all.

    The smallest multiples of the golden ratio modulo 1: evenly spread over any order of rings and columns (Knuth,
    "The art of computer programming", volume 3, section 6.4), where each n-th beam may be of one ring.
    """
    if count <= limit:
        return np.arange(count)
    return np.sort(np.argpartition(np.arange(count) * ((math.sqrt(5) - 1) / 2) % 1, limit)[:limit])


def _plane_jacobian(T_sensor_board: Array) -> Array:
    """(V, 3, 6) derivatives of ``n dh - h dn`` by the poses of boards (V, 4, 4)."""
    n, h = _board_planes(T_sensor_board)
    lever = np.cross(n, T_sensor_board[:, :3, 3])
    by_rotation = h[:, None, None] * so3.hat(n) + n[:, :, None] * lever[:, None]
    return np.concatenate([n[:, :, None] * n[:, None], by_rotation], axis=-1)


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
