"""Observations of the board's outline by scanners: they measure the board's position within its plane.

Ranges measure the board's plane only. The outline runs between the last beam on the board and the first one past
it; as the board's size is given, each such pair of beams is a measurement across one of the four sides.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import PlanePatch, Segment
from calgraph.geometry import Array, Index, se3, se_n, so3
from calgraph.rig.bundle.bundle_parameters import LocalParameters
from calgraph.rig.bundle.observations import (
    BoardViews,
    LinearizedResiduals,
    select_measurements,
    stack_motions,
    start_indices,
    velocity_along_sensor,
    view_indices,
)
from calgraph.sensors.kinds.stated import BeamError, list_turns

# Cosine of incidence at which smaller ones are truncated: keeps intersections finite. Such edges are not used.
_MIN_COSINE = 1e-3


FOOTPRINTS = ("azimuth footprint", "elevation footprint")
"""How far outwards a scanner measures sides between beams of different azimuth and elevation."""
_BLOCKS = {"size": 2, "print": 3, "varying": len(FOOTPRINTS)}


# Minimum cosine of incidence (84°) of either beam: an error of 1 mrad moves a flatter one by more than 10 mm a
# metre of range along the board.
_OUTLINE_MIN_COSINE = 0.1
# Maximum distance of the two beams of an edge on the board's plane: their standard deviation is 14 mm, five times
# that of the usual spacing.
_MAX_BEAM_SPACING = 0.05
# Maximum distance of an edge from its side: four standard deviations of the coarsest edge; farther ones are of an
# arm or a stand.
_MAX_SIDE_DISTANCE = 0.06
# Minimum distance of an edge from the corners: three standard deviations of the coarsest edge; nearer, its side
# is ambiguous.
_MIN_CORNER_DISTANCE = 0.04
# Minimum standard deviation of an edge: boards are cut, and beams collimated, no more sharply.
_BLUR = 0.002


@dataclass(frozen=True, eq=False)
class OutlineObservations(BoardViews):
    """Pairs of neighbouring beams, on the board and past it: the direction to a side of the board, across it.

    :meth:`update_noise` assigns the sides and the points on them, which are constant within a minimisation.
    Residuals are angles times a constant distance: distances on the board would be reduced by a smaller scale of
    everything. The local parameters are the board's pose, then systematic parameters in blocks ``size``, width and
    height of the board, m; ``print``, place and rotation of the print on it, m and rad; ``beams``, of the errors
    that turn these; ``varying``, footprints, m.
    """

    edges: Array
    """(M, 2, 3) unit vectors in the sensor frame, as :class:`calgraph.Segment` has them."""
    half_size: Array
    """(V, 2) half width and half height of each board, m."""
    side: NDArray[np.int8]
    """(M,) 0 and 1 for the sides at -x and +x, 2 and 3 for those at -y and +y; -1 for edges that are not used."""
    sigma: Array
    """(M,) standard deviation of each edge across its side on the board, m."""
    across: Array
    """(M, 3) normal of the plane of sight through the middle of the edge and parallel to its side, sensor frame,
    scaled so that its product with the direction to the side is the distance on the board."""
    along: Array
    """(M,) coordinate of the edge along its side, board frame, m."""
    turns: tuple[BeamError, ...] = ()
    """Systematic errors of the beams' directions, in the order of their parameters."""

    @classmethod
    def from_edges(
        cls, board: Sequence[int], detections: Sequence[PlanePatch | Segment], half: Array
    ) -> "OutlineObservations":
        """The views of these boards in their detections; no edge is used before :meth:`update_noise`."""
        edges = np.concatenate([np.empty((0, 2, 3)), *(d.edges for d in detections)])
        return cls(
            np.array(board, dtype=np.intp),
            start_indices([len(d.edges) for d in detections]),
            edges,
            half.reshape(-1, 2),
            np.full(len(edges), -1, dtype=np.int8),
            np.ones(len(edges)),
            np.zeros((len(edges), 3)),
            np.zeros(len(edges)),
            parameters=LocalParameters.exact(len(board), _BLOCKS),
            **stack_motions(detections),
        )

    @property
    def used(self) -> Index:
        """(N,) indices of the edges that are measurements."""
        return np.flatnonzero(self.side >= 0)

    @property
    def start(self) -> Index:
        """(V,) the first measurement of each view: the first edge that is used."""
        return np.searchsorted(self.used, self.first)

    def linearize(self, T_sensor_board: Array, extra: Array) -> LinearizedResiduals:
        """See :class:`BoardViews`: the direction to the point of the side relative to the plane of sight."""
        used = self.used
        view, axis, sign = self._view[used], self.side[used] // 2, 2.0 * (self.side[used] % 2) - 1
        block, local = self.parameters, self.parameters.gather(extra)
        of_edge = local[view].T
        (width, height), (azimuth, elevation) = of_edge[block["size"]], of_edge[block["varying"]]
        px, py, turn = of_edge[block["print"]]
        upright = self._separates_rings[used]
        outward = np.where(upright, elevation, azimuth) + np.where(axis == 0, width, height) / 2
        on_board = np.where(axis[:, None] == [0, 1], 0.0, self.along[used, None])
        side = sign[:, None] * np.eye(2)[axis]
        on_board += side * (self.half_size[view, axis] + outward)[:, None]
        # In the frame of the print, the board is displaced by the opposite of what the print is on the board.
        c, s = np.cos(turn), -np.sin(turn)
        turned = np.stack([c * on_board[:, 0] - s * on_board[:, 1], s * on_board[:, 0] + c * on_board[:, 1]], -1)
        normal = np.stack([c * side[:, 0] - s * side[:, 1], s * side[:, 0] + c * side[:, 1]], axis=-1)
        R = T_sensor_board[view, :3, :3]
        rotated = (R[..., :2] @ (turned - np.stack([px, py], axis=-1))[..., None])[..., 0]
        point = rotated + T_sensor_board[view, :3, 3]
        distance = np.linalg.norm(point, axis=-1, keepdims=True)
        direction, sigma = point / distance, self.sigma[used, None]
        # An error of the beams' directions turns the plane of sight with them.
        turns, across = self._turns, self.across[used]
        if self.turns:
            across = so3.rotate(np.einsum("ien,en->ni", turns, of_edge[block["beams"]]), across)
        angle = np.sum(across * direction, axis=-1, keepdims=True)
        by_point = (across - angle * direction) / (distance * sigma)
        by_board = (by_point[:, None] @ R[..., :2])[:, 0]
        by_outward = np.sum(by_board * normal, axis=-1)
        by_turn = by_board[:, 0] * turned[:, 1] - by_board[:, 1] * turned[:, 0]
        jacobian = np.zeros((len(used), 6 + local.shape[1]))
        jacobian[:, :3], jacobian[:, 3:6], by_parameters = by_point, np.cross(rotated, by_point), jacobian[:, 6:]
        by_parameters[:, block["size"]] = 0.5 * by_outward[:, None] * (axis[:, None] == [0, 1])
        by_parameters[:, block["print"]] = np.column_stack([-by_board, by_turn])
        if self.turns:
            lever = so3.cross(across, direction) / sigma
            by_parameters[:, block["beams"]] = np.einsum("ien,ni->ne", turns, lever)
        by_parameters[:, block["varying"]] = by_outward[:, None] * (upright[:, None] == [False, True])
        return LinearizedResiduals(
            angle / sigma,
            jacobian[:, None],
            self.local_jacobian(T_sensor_board),
            6,
            ring_count=block.ring_count,
            velocity=velocity_along_sensor(self.twist, T_sensor_board),
        )

    def unwhiten(self, residual: Array) -> Array:
        """See :class:`BoardViews`."""
        return residual * self.sigma[self.used, None]

    def update_noise(self, T_sensor_board: Array, scale: float) -> "OutlineObservations":
        """See :class:`BoardViews`: the outline is uniformly distributed between the two beams, plus blur."""
        view = self._view
        T, half = se3.inverse(T_sensor_board)[view], self.half_size[view]
        facing = np.abs((T[:, None, :3, :3] @ self.edges[..., None])[..., 2, 0]).min(axis=1) > _OUTLINE_MIN_COSINE
        on_board, past_board = (_intersect_boards(T, self.edges[:, i]) for i in (0, 1))
        across, midpoint = past_board - on_board, (on_board + past_board) / 2
        axis, sign = np.array([0, 0, 1, 1]), np.array([-1.0, 1.0, -1.0, 1.0])
        distance = np.abs(sign * midpoint[:, axis] - half[:, axis])
        outward = sign * across[:, axis]
        nearest = np.argmin(np.where(outward > 0, distance, np.inf), axis=1)
        each = np.arange(len(view))
        used = (
            facing
            & (np.linalg.norm(across, axis=1) < _MAX_BEAM_SPACING)
            & (distance[each, nearest] < _MAX_SIDE_DISTANCE)
            & (outward[each, nearest] > 0)
            & (half[each, 1 - nearest // 2] - np.abs(midpoint[each, 1 - nearest // 2]) > _MIN_CORNER_DISTANCE)
        )
        # Standard deviation of a uniform distribution over the beams' distance across the side.
        spread = outward[each, nearest] / np.sqrt(12)
        # The side runs between the ends of the two beams on the board: the plane of sight contains their middle.
        middle = T_sensor_board[view, :3, 3] + (T_sensor_board[view, :3, :2] @ midpoint[..., None])[..., 0]
        axes = se_n.transpose(T_sensor_board[view, :3, :2])
        normal = np.cross(middle, axes[each, 1 - nearest // 2])
        across_side = sign[nearest, None] * axes[each, nearest // 2]
        length = np.linalg.norm(middle, axis=-1) / _away_from_zero(np.sum(normal * across_side, axis=-1))
        return replace(
            self,
            side=np.where(used, nearest, -1).astype(np.int8),
            sigma=scale * np.hypot(spread, _BLUR),
            across=normal * length[:, None],
            along=midpoint[each, 1 - nearest // 2],
            noise_scale=scale,
        )

    def select(self, keep: NDArray[np.bool_] | Index) -> "OutlineObservations":
        """See :class:`BoardViews`."""
        first, kept = select_measurements(self.first, len(self.edges), keep)
        return replace(
            self,
            first=first,
            edges=self.edges[kept],
            half_size=self.half_size[keep],
            side=self.side[kept],
            sigma=self.sigma[kept],
            across=self.across[kept],
            along=self.along[kept],
            **self.select_shared(keep),
        )

    def edge_points(self, T_sensor_board: Array) -> tuple[Index, Array]:
        """Of the edges between close beams, the view of each (N,) and its place in the board's plane (N, 2), m."""
        T = se3.inverse(T_sensor_board)[self._view]
        on_board, past_board = (_intersect_boards(T, self.edges[:, i]) for i in (0, 1))
        dense = np.linalg.norm(past_board - on_board, axis=1) < _MAX_BEAM_SPACING
        return self._view[dense], (on_board + past_board)[dense] / 2

    @cached_property
    def _turns(self) -> Array:
        """(3, E, N) as of :func:`list_turns`, of the middles of the used edges."""
        middle = self.edges[self.used].sum(axis=1)
        return list_turns(self.turns, middle / np.linalg.norm(middle, axis=-1, keepdims=True))

    @property
    def _separates_rings(self) -> NDArray[np.bool_]:
        """(M,) whether the two beams of an edge differ in elevation rather than in azimuth."""
        apart = np.abs(self.edges[:, 1] - self.edges[:, 0])
        return np.asarray(apart[:, 2] > np.hypot(apart[:, 0], apart[:, 1]))

    @property
    def _view(self) -> Index:
        return view_indices(self.first, len(self.edges))


def _intersect_boards(T_board_sensor: Array, directions: Array) -> Array:
    """(M, 2) intersections of beams (M, 3) with boards (M, 4, 4), board frame."""
    u, v, w = np.moveaxis((T_board_sensor[:, :3, :3] @ directions[..., None])[..., 0], -1, 0)
    w = _away_from_zero(w)
    x, y, z = np.moveaxis(T_board_sensor[:, :3, 3], -1, 0)
    return np.stack([x - z * u / w, y - z * v / w], axis=-1)


def _away_from_zero(cosine: Array) -> Array:
    return np.copysign(np.maximum(np.abs(cosine), _MIN_COSINE), cosine)
