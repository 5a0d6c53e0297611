"""Boards fixed in the room in images of moving cameras: reprojection errors of their printed corners.

For corner c of board b, which camera i measures at time t,

    r = π_i(T_ri⁻¹ T_wr(t - o_i)⁻¹ T_wb x_c) - u_c

with the pose ``T_wb`` of the board in the world of the part, the camera's model ``π_i`` with errors of its
intrinsics, and the printed corner ``x_c`` with those of print and bow; rows of an image are read in turn. The
corners of one image are wrong together, by motion blur and what models of lens and print leave: besides its own
noise, each has a share in a displacement of the view, and in a linear distortion of it. Both are eliminated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, hstack

from calgraph.drive.measurements import MAX_VARIANCES, LinearRows, VarianceOf, place_sensor, sparse_rows
from calgraph.geometry import STDDEV_PER_MAD, Array, Index, se3, se_n, so3
from calgraph.sensors import CameraModel
from calgraph.sensors.lens_errors import adjust_camera, project_by_lens
from calgraph.surfaces.sensor_states import SensorState
from calgraph.surfaces.trajectory import SplineTrajectory

PRINT_ERRORS = 4
"""Errors of a print: relative scale, aspect (width over height), bows along x and y, m."""
# Corners of a view that are used: more have the same view bias.
_MAX_CORNERS = 24
# Least standard deviations, pixels: of the finders' corners, and of a view's displacement by anything else.
_MIN_NOISE, _MIN_BIAS = 0.05, 0.02
# Least share of the squared displacements of views that the fit leaves: below, other sensors are far less precise.
_MIN_LEFT = 0.05
# Errors of a corner beyond which it is left out, of the image's width.
_MAX_ERROR = 0.5
# Squared whitened displacement and distortion (6 in all) of a view from which its weight falls: of 1 in 20.
_MAX_SQUARE = 12.6


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board in one image."""

    time: float
    """By the camera's clock, s."""
    board: int
    """Index among the rig's boards."""
    corners: Array
    """(N, 3) the printed corners in the board's frame, m."""
    pixels: Array
    """(N, 2)."""
    T_camera_board: Array
    """(4, 4) by PnP."""

    def thin(self, count: int) -> "BoardView":
        """The view with some of its corners, evenly."""
        if len(self.pixels) <= count:
            return self
        chosen = np.linspace(0, len(self.pixels) - 1, count).round().astype(np.intp)
        return replace(self, corners=self.corners[chosen], pixels=self.pixels[chosen])


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Where the errors of lenses and prints are among the unknowns that all parts of a drive share."""

    cameras: Mapping[int, CameraModel]
    """Stated model by number of the sensor."""
    lens: Mapping[int, slice]
    """By number of the sensor, (4 + n,) of :func:`adjust_camera`."""
    readout: Mapping[int, int]
    """By number of the sensor, the time from the first to the last row of an image, s."""
    prints: NDArray[np.intp]
    """(B, PRINT_ERRORS) by board of the rig; boards may share them."""
    half_sizes: Array
    """(B, 2) half of width and height of each board, m."""


@dataclass(frozen=True, eq=False)
class BoardMeasurements:
    """The views of all boards by all cameras during a part; implements :class:`Measurements`."""

    sensor: Index
    """(V,) number of the camera."""
    board: Index
    """(V,) number among the boards of the part."""
    times: Array
    """(V,) by the camera's clock, s."""
    corners: Array
    """(V, N, 3) in the board's frame, m; padded."""
    pixels: Array
    """(V, N, 2); padded."""
    used: Array
    """(V, N) 1, and 0 where padded."""
    T_world_board: Array
    """(B, 4, 4) estimated."""
    rig_board: Index
    """(B,) index among the rig's boards."""
    errors: SharedErrors
    whitened: bool = True
    """Whether residuals are in standard deviations, and not in pixels."""
    left: Array | None = None
    """(V, 6) share of the squares of displacement and distortion of each view that the trajectory does not follow;
    1 if None."""
    spreads: Array | None = None
    """(S, 3) by number of the sensor, standard deviations of a corner by noise, displacement and distortion of its
    view, pixels; those of the residuals if None."""

    @classmethod
    def of_views(
        cls, views: Sequence[tuple[int, BoardView]], T_world_board: Mapping[int, Array], errors: SharedErrors
    ) -> "BoardMeasurements":
        """From views with the numbers of their cameras, and start poses of boards by index among the rig's."""
        thinned = [(k, view.thin(_MAX_CORNERS)) for k, view in views]
        N = max(len(view.pixels) for _, view in thinned)
        corners, pixels = np.zeros((len(views), N, 3)), np.zeros((len(views), N, 2))
        used = np.zeros((len(views), N))
        for row, (_, view) in enumerate(thinned):
            count = len(view.pixels)
            corners[row, :count], pixels[row, :count], used[row, :count] = view.corners, view.pixels, 1.0
            # Padded with a corner that exists, so that it can be projected.
            corners[row, count:], pixels[row, count:] = view.corners[0], view.pixels[0]
        boards = sorted(T_world_board)
        return cls(
            np.array([k for k, _ in thinned], dtype=np.intp),
            np.searchsorted(boards, [view.board for _, view in thinned]),
            np.array([view.time for _, view in thinned]),
            corners,
            pixels,
            used,
            np.array([T_world_board[b] for b in boards]),
            np.array(boards, dtype=np.intp),
            errors,
        )

    @property
    def unknown_count(self) -> int:
        """Six of each board."""
        return 6 * len(self.T_world_board)

    def moved(self, step: Array) -> "BoardMeasurements":
        """See :class:`Measurements`."""
        return replace(self, T_world_board=se_n.retract(self.T_world_board, step.reshape(-1, 6)))

    def linearize(self, trajectory: SplineTrajectory, states: Sequence[SensorState], shared: Array) -> LinearRows:
        """See :class:`Measurements`."""
        inside = self._find_inside(trajectory, states)
        offsets = np.array([state.clock_offset for state in states])[self.sensor]
        return self._select(inside)._linearize((self.times - offsets)[inside], trajectory, states, shared)

    def reweighted(
        self, trajectory: SplineTrajectory, states: Sequence[SensorState], shared: Array, variance_of: VarianceOf
    ) -> "BoardMeasurements":
        """See :class:`Measurements`: REML for the standard deviations of displacements and distortions."""
        inside = self._find_inside(trajectory, states)
        if not len(inside):
            return self
        rows = self.linearize(trajectory, states, shared)
        # Six of each view; only their mean by camera is used.
        chosen = np.arange(0, len(inside), max(6 * len(inside) // MAX_VARIANCES, 1))
        Q = self._select(inside[chosen])._bias_basis()
        onto_basis = sparse_rows(np.swapaxes(Q, 1, 2), Q.shape[1] * chosen, len(rows.residual))
        J = csr_array(onto_basis @ hstack([rows.by_control, rows.by_unknown]).tocsr())
        share = np.clip(1 - variance_of(J), 0.0, 1.0).reshape(-1, 6)
        left = np.ones((len(self.times), 6))
        left[inside] = share[np.searchsorted(chosen, np.arange(len(inside)), side="right") - 1]
        plain = replace(self, whitened=False).linearize(trajectory, states, shared)
        found = replace(self, left=left)._select(inside)
        spreads = found._estimate_spreads(plain.residual.reshape(len(inside), -1), len(states))
        return replace(self, left=left, spreads=spreads)

    def _find_inside(self, trajectory: SplineTrajectory, states: Sequence[SensorState]) -> Index:
        """Indices of the views within the time of a trajectory."""
        times = self.times - np.array([state.clock_offset for state in states])[self.sensor]
        return np.flatnonzero((times >= trajectory.start) & (times <= trajectory.end))

    def measure_views(self, trajectory: SplineTrajectory, states: Sequence[SensorState], shared: Array) -> Array:
        """(V, 3) number of the camera, number of corners, and squared reprojection error of each view, pixels²."""
        rows = replace(self, whitened=False).linearize(trajectory, states, shared)
        width = 2 * self.used.shape[1]
        square = np.sum(rows.residual.reshape(-1, width) ** 2, axis=1)
        count = self.used[self._find_inside(trajectory, states)].sum(axis=1)
        return np.column_stack([rows.sensor.reshape(-1, width)[:, 0], count, square])

    def _select(self, kept: Index) -> "BoardMeasurements":
        return replace(
            self,
            sensor=self.sensor[kept], board=self.board[kept], times=self.times[kept],
            corners=self.corners[kept], pixels=self.pixels[kept], used=self.used[kept],
            left=None if self.left is None else self.left[kept],
        )  # fmt: skip

    def _linearize(
        self, times: Array, trajectory: SplineTrajectory, states: Sequence[SensorState], shared: Array
    ) -> LinearRows:
        T_root_camera = np.array([state.T_root_sensor for state in states])[self.sensor]
        placed = place_sensor(trajectory, times, T_root_camera)
        T_world_board = self.T_world_board[self.board]
        residual, by_view, by_shared = self._project(se3.inverse(placed.poses) @ T_world_board, shared)
        from_camera, from_board = se_n.relative_pose_jacobians(placed.poses, T_world_board)
        by_clock = by_view @ from_camera @ placed.by_state[:, :, 6, None]
        self._add_readout(residual, by_shared, -by_clock[..., 0], shared)
        if self.whitened:
            residual, by_view, by_shared = self._whiten(residual, by_view, by_shared)
        by_camera, by_board = by_view @ from_camera, by_view @ from_board
        V, rows = residual.shape
        return LinearRows(
            residual.ravel(),
            np.repeat(self.sensor, rows),
            np.repeat(times, rows),
            sparse_rows(by_camera @ placed.by_control, 6 * placed.first, trajectory.control.size),
            (by_camera @ placed.by_state).reshape(V * rows, -1),
            sparse_rows(by_board, 6 * self.board, self.unknown_count),
            by_shared.reshape(V * rows, -1),
        )

    def _project(self, T_camera_board: Array, shared: Array) -> tuple[Array, Array, Array]:
        """Reprojection errors (V, 2N), pixels, and their derivatives (V, 2N, 6) and (V, 2N, G).

        The first are by motions of the board along the camera's axes, about its own origin, the others by what is
        shared.
        """
        V, N = self.used.shape
        residual, by_view = np.zeros((V, N, 2)), np.zeros((V, N, 2, 6))
        by_shared = np.zeros((V, N, 2, len(shared)))
        printed, by_print = self._displace(shared)
        points = se_n.apply(T_camera_board, printed)
        for k, camera in self.errors.cameras.items():
            own = np.flatnonzero(self.sensor == k)
            if not len(own):
                continue
            change = shared[self.errors.lens[k]]
            adjusted = adjust_camera(camera, change)
            x = points[own].reshape(-1, 3)
            pixels, J = adjusted.project_with_jacobian(x)
            residual[own] = pixels.reshape(-1, N, 2) - self.pixels[own]
            arm = (points[own] - T_camera_board[own, None, :3, 3]).reshape(-1, 3)
            by_view[own] = np.concatenate([J, -J @ so3.hat(arm)], axis=-1).reshape(-1, N, 2, 6)
            by_shared[own, :, :, self.errors.lens[k]] = project_by_lens(camera, adjusted, x).reshape(
                len(own), N, 2, -1
            )
            turned = J.reshape(-1, N, 2, 3) @ T_camera_board[own, None, :3, :3] @ by_print[own]
            rows = own[:, None, None, None], np.arange(N)[:, None, None], np.arange(2)[:, None]
            by_shared[(*rows, self.errors.prints[self.rig_board[self.board[own]]][:, None, None])] = turned
        # Corners that cannot be projected, or are far off, have no weight: derivatives have no bound there.
        error = np.linalg.norm(residual, axis=-1)
        widths = np.array([self.errors.cameras[k].width for k in self.sensor.tolist()])
        used = np.repeat(self.used * (error < _MAX_ERROR * widths[:, None]), 2, axis=1)
        return (
            np.nan_to_num(residual.reshape(V, -1)) * used,
            np.nan_to_num(by_view.reshape(V, 2 * N, 6)) * used[..., None],
            np.nan_to_num(by_shared.reshape(V, 2 * N, -1)) * used[..., None],
        )

    def _add_readout(self, residual: Array, by_shared: Array, flow: Array, shared: Array) -> None:
        """Adds what corners (V, 2N) that move at ``flow``, pixels per second, move until their row is read.

        Rows are read around the time of the image; the flow is the same during the readout.
        """
        for k, column in self.errors.readout.items():
            own = self.sensor == k
            share = np.repeat(self.pixels[own, :, 1] / self.errors.cameras[k].height - 0.5, 2, axis=1)
            by_shared[own, :, column] = share * flow[own]
            residual[own] += shared[column] * by_shared[own, :, column]

    def _displace(self, shared: Array) -> tuple[Array, Array]:
        """Corners (V, N, 3) of erroneous prints, and their derivatives (V, N, 3, PRINT_ERRORS)."""
        values = shared[self.errors.prints][self.rig_board][self.board]
        scale, aspect, bow_x, bow_y = values.T[:, :, None]
        half = np.array([0.5, -0.5])
        stretch = 1 + aspect[..., None] * half
        xy = self.corners[..., :2]
        relative = xy / self.errors.half_sizes[self.rig_board][self.board][:, None]
        # The middle is the bow above the edges.
        shape = 1 - relative**2
        J = np.zeros((*self.corners.shape, PRINT_ERRORS))
        J[..., :2, 0] = stretch * xy
        J[..., :2, 1] = (1 + scale)[..., None] * half * xy
        J[..., 2, 2:] = shape
        height = self.corners[..., 2] + bow_x * shape[..., 0] + bow_y * shape[..., 1]
        return np.concatenate([(1 + scale)[..., None] * stretch * xy, height[..., None]], axis=-1), J

    def _whiten(self, residual: Array, by_view: Array, by_shared: Array) -> tuple[Array, Array, Array]:
        """In standard deviations of noise and view bias, which are those of the residuals, with robust weights.

        With the orthonormal basis ``Q`` of displacements and linear distortions of a view, whose coefficients have
        the standard deviations ``s``, the inverse root of the covariance is ``(I - Q Qᵀ) / σ + Q s⁻¹ Qᵀ``.
        """
        Q = self._bias_basis()
        coefficients = np.einsum("vni,vn->vi", Q, residual)
        spreads = self.spreads
        if spreads is None:
            spreads = self._estimate_spreads(residual, int(self.sensor.max(initial=0)) + 1)
        sigma, biases = spreads[self.sensor, 0], np.repeat(spreads[self.sensor, 1:], [2, 4], axis=1)
        stddev = np.sqrt(sigma[:, None] ** 2 + self.used.sum(axis=1)[:, None] * biases**2)
        square = np.sum((coefficients / stddev) ** 2, axis=1)
        weight = np.sqrt(np.minimum(1.0, np.sqrt(_MAX_SQUARE / np.maximum(square, 1e-12))))

        def whiten(x: Array) -> Array:
            inside = np.einsum("vni,vnj->vij", Q, x)
            scaled = x / sigma[:, None, None]
            change = np.einsum("vni,vij->vnj", Q, inside * (1 / stddev - 1 / sigma[:, None])[..., None])
            return np.asarray((scaled + change) * weight[:, None, None])

        return whiten(residual[..., None])[..., 0], whiten(by_view), whiten(by_shared)

    def _estimate_spreads(self, residual: Array, count: int) -> Array:
        """(S, 3) of :attr:`spreads` from residuals (V, 2N) in pixels."""
        Q = self._bias_basis()
        coefficients = np.einsum("vni,vn->vi", Q, residual)
        around = residual - np.einsum("vni,vi->vn", Q, coefficients)
        corners = self.used.sum(axis=1)
        spreads = np.ones((count, 3))
        for k in np.unique(self.sensor):
            own = self.sensor == k
            degrees = np.maximum(2 * corners[own] - 6, 1)
            noise = max(float(np.sqrt(np.median(np.sum(around[own] ** 2, axis=1) / degrees))), _MIN_NOISE)
            spreads[k, 0] = noise
            for column, columns in ((1, slice(0, 2)), (2, slice(2, 6))):
                # Of a single corner, as coefficients grow with the root of their number.
                square = (coefficients[own, columns] / np.sqrt(corners[own, None])) ** 2
                left = 1.0 if self.left is None else max(float(self.left[own, columns].mean()), _MIN_LEFT)
                spread = STDDEV_PER_MAD**2 * np.median(square) / left
                spreads[k, column] = np.sqrt(max(spread - noise**2 / float(np.mean(corners[own])), _MIN_BIAS**2))
        return spreads

    def _bias_basis(self) -> Array:
        """(V, 2N, 6) orthonormal: displacements along u and v, then linear distortions of a view."""
        V, N = self.used.shape
        centred = self.pixels - np.einsum("vn,vni->vi", self.used, self.pixels)[:, None] / self.used.sum(
            axis=1
        ).reshape(-1, 1, 1)
        basis = np.concatenate([np.ones((V, N, 1)), centred], axis=-1) * self.used[..., None]
        q = np.linalg.qr(basis)[0] * self.used[..., None]
        Q = np.zeros((V, N, 2, 3, 2))
        Q[:, :, 0, :, 0] = Q[:, :, 1, :, 1] = q
        return Q.reshape(V, 2 * N, 6)
