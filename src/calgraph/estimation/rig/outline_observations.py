"""Where scanners saw the sheets end: what tells in which place of its plane a board is.

Ranges know a board's plane only. Between the last beam on the board and the first one past it, its outline runs;
the sheet's size is known, so each such pair of beams is a measurement across one of the four sides.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calgraph.detection import PlanePatch, Segment
from calgraph.detection.board_edges import EDGE_BLUR
from calgraph.estimation.rig.observations import (
    LinearizedResiduals,
    difference_along_sensor,
    select_measurements,
    start_indices,
    view_indices,
)
from calgraph.geometry import Array, Index, se3

# Beams that are farther apart on the board than this, m, say too little of where it ends.
_MAX_BEAM_SPACING = 0.05
# An edge farther than this from every side, m, is none of the sheet: an arm, a stand.
_MAX_SIDE_DISTANCE = 0.06
# Nearer to a corner than this, m, either side may be meant.
_MIN_CORNER_DISTANCE = 0.04
# Flatter than this, a cosine, a beam's place on the board is unknown.
_MIN_COSINE = 0.1


@dataclass(frozen=True, eq=False)
class OutlineObservations:
    """Pairs of neighbouring beams, on the board and past it: each is the distance of their middle from a side, m.

    One of the :class:`calgraph.estimation.rig.observations.Views`. Which side is meant is decided by
    :meth:`weighed`, and held while poses move.
    """

    board: Index
    """(V,) which board each view is of."""
    first: Index
    """(V,) the first edge of each view."""
    edges: Array
    """(M, 2, 3) unit vectors in the sensor frame, as :class:`calgraph.detection.Segment` has them."""
    half_size: Array
    """(V, 2) half the width and half the height of each board, m."""
    side: NDArray[np.int8]
    """(M,) 0 and 1 for those at -x and +x, 2 and 3 for those at -y and +y; -1 for edges that are not used."""
    sigma: Array
    """(M,) standard deviation of each distance, m."""
    noise_scale: float = 1.0
    extra_count: int = 1
    """How much too far out the scanner sees each side, m: half its beams' footprint, or a board cut too large."""
    dimension: ClassVar[int] = 1

    @classmethod
    def from_detections(
        cls, board: Sequence[int], found: Sequence[PlanePatch | Segment], half: Array
    ) -> "OutlineObservations":
        """The views of detections ``found`` of these boards; nothing is used of them until they are weighed."""
        edges = np.concatenate([np.empty((0, 2, 3)), *(d.edges for d in found)])
        return cls(
            np.array(board, dtype=np.intp),
            start_indices([len(d.edges) for d in found]),
            edges,
            half.reshape(-1, 2),
            np.full(len(edges), -1, dtype=np.int8),
            np.ones(len(edges)),
        )

    @property
    def used(self) -> Index:
        """(N,) which edges are measurements."""
        return np.flatnonzero(self.side >= 0)

    @property
    def start(self) -> Index:
        """(V,) the first measurement of each view."""
        return np.searchsorted(self.used, self.first)

    def linearize(self, T_sensor_board: Array, own: Array) -> LinearizedResiduals:
        """See :class:`Views`: in the board's frame, the middle between two beams meets z = 0 beyond the side.

        Its place (x, y) moves against the board, turns against it, and slides along the beam as the plane comes
        nearer or tilts.
        """
        used = self.used
        view = self._view[used]
        (x, y), (u, v) = _intersect_boards(se3.inverse(T_sensor_board)[view], self.edges[used].mean(axis=1))
        axis, sign = self.side[used] // 2, 2.0 * (self.side[used] % 2) - 1
        n = sign[:, None] * np.eye(2)[axis]
        distance = n[:, 0] * x + n[:, 1] * y - self.half_size[view, axis] - own.sum()
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
        """See :class:`Views`: the pose along the board's axes."""
        size = 6 + self.extra_count
        basis = np.zeros((len(self.board), size, size))
        basis[:, :3, :3] = basis[:, 3:6, 3:6] = np.swapaxes(T_sensor_board[:, :3, :3], -1, -2)
        basis[:, 6:, 6:] = np.eye(self.extra_count)
        return basis

    def local_difference(self, T_before: Array, T_sensor_board: Array, own: Array) -> Array:
        """See :class:`Views`."""
        along_sensor = difference_along_sensor(T_before, T_sensor_board, own)[..., None]
        return np.asarray((self.local_jacobian(T_before) @ along_sensor)[..., 0])

    def update_noise(self, T_sensor_board: Array, scale: float) -> "OutlineObservations":
        """See :class:`Views`: the outline is anywhere between the two beams, and no sharper than beams are."""
        view = self._view
        T, half = se3.inverse(T_sensor_board)[view], self.half_size[view]
        facing = np.abs((T[:, None, :3, :3] @ self.edges[..., None])[..., 2, 0]).min(axis=1) > _MIN_COSINE
        on, past = (np.stack(_intersect_boards(T, self.edges[:, i])[0], axis=-1) for i in (0, 1))
        across, middle = past - on, (on + past) / 2
        axis, sign = np.array([0, 0, 1, 1]), np.array([-1.0, 1.0, -1.0, 1.0])
        distance = np.abs(sign * middle[:, axis] - half[:, axis])
        outward = sign * across[:, axis]
        nearest = np.argmin(np.where(outward > 0, distance, np.inf), axis=1)
        each = np.arange(len(view))
        certain = (
            facing
            & (np.linalg.norm(across, axis=1) < _MAX_BEAM_SPACING)
            & (distance[each, nearest] < _MAX_SIDE_DISTANCE)
            & (outward[each, nearest] > 0)
            & (half[each, 1 - nearest // 2] - np.abs(middle[each, 1 - nearest // 2]) > _MIN_CORNER_DISTANCE)
        )
        # Of a uniform distribution over what the beams are apart across the side.
        spread = outward[each, nearest] / np.sqrt(12)
        return replace(
            self,
            side=np.where(certain, nearest, -1).astype(np.int8),
            sigma=scale * np.hypot(spread, EDGE_BLUR),
            noise_scale=scale,
        )

    def select(self, keep: NDArray[np.bool_] | Index) -> "OutlineObservations":
        """See :class:`Views`."""
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
        """By the edges that tell, which view each is of (N,), and where its board ends, in its plane (N, 2), m."""
        T = se3.inverse(T_sensor_board)[self._view]
        on, past = (np.stack(_intersect_boards(T, self.edges[:, i])[0], axis=-1) for i in (0, 1))
        telling = np.linalg.norm(past - on, axis=1) < _MAX_BEAM_SPACING
        return self._view[telling], (on + past)[telling] / 2

    @property
    def _view(self) -> Index:
        return view_indices(self.first, len(self.edges))


def _intersect_boards(T_board_sensor: Array, directions: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Where beams (M, 3) meet the planes of boards (M, 4, 4): x, y (M,) in the board's frame, and dx/dz, dy/dz."""
    u, v, w = np.moveaxis((T_board_sensor[:, :3, :3] @ directions[..., None])[..., 0], -1, 0)
    w = np.copysign(np.maximum(np.abs(w), 1e-3), w)
    x, y, z = np.moveaxis(T_board_sensor[:, :3, 3], -1, 0)
    return (x - z * u / w, y - z * v / w), (u / w, v / w)
