"""Observations of the board's outline by scanners: they measure the board's position within its plane.

Ranges measure the board's plane only. The outline runs between the last beam on the board and the first one past
it; as the board's size is given, each such pair of beams is a measurement across one of the four sides.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import OutlineSettings
from calgraph.detection import PlanePatch, Segment
from calgraph.estimation.rig.observations import (
    LinearizedResiduals,
    difference_along_sensor,
    select_measurements,
    start_indices,
    view_indices,
)
from calgraph.geometry import Array, Index, se3, se_n

# Cosine of incidence at which smaller ones are truncated: keeps intersections finite. Such edges are not used.
_MIN_COSINE = 1e-3


@dataclass(frozen=True, eq=False)
class OutlineObservations:
    """Pairs of neighbouring beams, on the board and past it: the distance of their midpoint from a side, m.

    Implements :class:`calgraph.estimation.rig.observations.BoardViews`. :meth:`update_noise` assigns the sides,
    which are constant within a minimisation.
    """

    board: Index
    """(V,) index of each view's board."""
    first: Index
    """(V,) the first edge of each view."""
    edges: Array
    """(M, 2, 3) unit vectors in the sensor frame, as :class:`calgraph.detection.Segment` has them."""
    half_size: Array
    """(V, 2) half width and half height of each board, m."""
    side: NDArray[np.int8]
    """(M,) 0 and 1 for the sides at -x and +x, 2 and 3 for those at -y and +y; -1 for edges that are not used."""
    sigma: Array
    """(M,) standard deviation of each distance, m."""
    settings: OutlineSettings
    noise_scale: float = 1.0
    extra_count: int = 1
    """1, the offset of all sides, m, outwards positive: the beams' footprint, or a larger board than stated."""
    dimension: ClassVar[int] = 1

    @classmethod
    def from_edges(
        cls,
        board: Sequence[int],
        detections: Sequence[PlanePatch | Segment],
        half: Array,
        settings: OutlineSettings,
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
            settings,
        )

    @property
    def used(self) -> Index:
        """(N,) indices of the edges that are measurements."""
        return np.flatnonzero(self.side >= 0)

    @property
    def start(self) -> Index:
        """(V,) the first measurement of each view."""
        return np.searchsorted(self.used, self.first)

    def linearize(self, T_sensor_board: Array, extra: Array) -> LinearizedResiduals:
        """See :class:`BoardViews`: signed distance of the midpoint, in the board's plane, from its side.

        The midpoint (x, y) in the board's frame translates and rotates opposite to the board, and slides along the
        beam as the plane translates along its normal or tilts.
        """
        used = self.used
        view = self._view[used]
        (x, y), (u, v) = _intersect_boards(se3.inverse(T_sensor_board)[view], self.edges[used].mean(axis=1))
        axis, sign = self.side[used] // 2, 2.0 * (self.side[used] % 2) - 1
        n = sign[:, None] * np.eye(2)[axis]
        distance = n[:, 0] * x + n[:, 1] * y - self.half_size[view, axis] - extra.sum()
        slide = n[:, 0] * u + n[:, 1] * v
        by_board = np.column_stack([
            -n[:, 0], -n[:, 1], slide,
            slide * y, -slide * x, n[:, 0] * y - n[:, 1] * x,
            *[-np.ones_like(x)] * self.extra_count,
        ])  # fmt: skip
        sigma = self.sigma[used, None]
        return LinearizedResiduals(
            distance[:, None] / sigma, by_board[:, None] / sigma[..., None], self.local_jacobian(T_sensor_board)
        )

    def local_jacobian(self, T_sensor_board: Array) -> Array:
        """See :class:`BoardViews`: the local parameters are the pose's along the board's axes."""
        size = 6 + self.extra_count
        basis = np.zeros((len(self.board), size, size))
        basis[:, :3, :3] = basis[:, 3:6, 3:6] = se_n.transpose(T_sensor_board[:, :3, :3])
        basis[:, 6:, 6:] = np.eye(self.extra_count)
        return basis

    def local_difference(self, T_before: Array, T_sensor_board: Array, extra: Array) -> Array:
        """See :class:`BoardViews`."""
        along_sensor = difference_along_sensor(T_before, T_sensor_board, extra)[..., None]
        return np.asarray((self.local_jacobian(T_before) @ along_sensor)[..., 0])

    def update_noise(self, T_sensor_board: Array, scale: float) -> "OutlineObservations":
        """See :class:`BoardViews`: the outline is uniformly distributed between the two beams, plus blur."""
        view = self._view
        T, half = se3.inverse(T_sensor_board)[view], self.half_size[view]
        facing = (
            np.abs((T[:, None, :3, :3] @ self.edges[..., None])[..., 2, 0]).min(axis=1) > self.settings.min_cosine
        )
        on_board, past_board = (np.stack(_intersect_boards(T, self.edges[:, i])[0], axis=-1) for i in (0, 1))
        across, midpoint = past_board - on_board, (on_board + past_board) / 2
        axis, sign = np.array([0, 0, 1, 1]), np.array([-1.0, 1.0, -1.0, 1.0])
        distance = np.abs(sign * midpoint[:, axis] - half[:, axis])
        outward = sign * across[:, axis]
        nearest = np.argmin(np.where(outward > 0, distance, np.inf), axis=1)
        each = np.arange(len(view))
        used = (
            facing
            & (np.linalg.norm(across, axis=1) < self.settings.max_beam_spacing)
            & (distance[each, nearest] < self.settings.max_side_distance)
            & (outward[each, nearest] > 0)
            & (
                half[each, 1 - nearest // 2] - np.abs(midpoint[each, 1 - nearest // 2])
                > self.settings.min_corner_distance
            )
        )
        # Standard deviation of a uniform distribution over the beams' distance across the side.
        spread = outward[each, nearest] / np.sqrt(12)
        return replace(
            self,
            side=np.where(used, nearest, -1).astype(np.int8),
            sigma=scale * np.hypot(spread, self.settings.blur),
            noise_scale=scale,
        )

    def select(self, keep: NDArray[np.bool_] | Index) -> "OutlineObservations":
        """See :class:`BoardViews`."""
        first, kept = select_measurements(self.first, len(self.edges), keep)
        return replace(
            self,
            board=self.board[keep],
            first=first,
            edges=self.edges[kept],
            half_size=self.half_size[keep],
            side=self.side[kept],
            sigma=self.sigma[kept],
        )

    def edge_points(self, T_sensor_board: Array) -> tuple[Index, Array]:
        """Of the edges between close beams, the view of each (N,) and its place in the board's plane (N, 2), m."""
        T = se3.inverse(T_sensor_board)[self._view]
        on_board, past_board = (np.stack(_intersect_boards(T, self.edges[:, i])[0], axis=-1) for i in (0, 1))
        dense = np.linalg.norm(past_board - on_board, axis=1) < self.settings.max_beam_spacing
        return self._view[dense], (on_board + past_board)[dense] / 2

    @property
    def _view(self) -> Index:
        return view_indices(self.first, len(self.edges))


def _intersect_boards(T_board_sensor: Array, directions: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Intersections (x, y), (M,) each, of beams (M, 3) with boards (M, 4, 4), board frame; dx/dz, dy/dz."""
    u, v, w = np.moveaxis((T_board_sensor[:, :3, :3] @ directions[..., None])[..., 0], -1, 0)
    w = np.copysign(np.maximum(np.abs(w), _MIN_COSINE), w)
    x, y, z = np.moveaxis(T_board_sensor[:, :3, 3], -1, 0)
    return (x - z * u / w, y - z * v / w), (u / w, v / w)
