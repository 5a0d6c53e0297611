"""Printed corners of boards in a camera's images, with the systematic errors of lens and print."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import BoardCorners
from calgraph.config import PixelNoise
from calgraph.geometry import Array, Index, so3
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
from calgraph.rig.bundle.residual_distortion import ResidualDistortion
from calgraph.sensors import CameraModel
from calgraph.sensors.lens_errors import adjust_camera, project_by_lens


@dataclass(frozen=True, eq=False)
class PrintedCorners:
    """Printed corners (N,), and what their places depend on."""

    nominal: Array
    """(N, 3) m, in the board's frame, as stated."""
    tag_center: Array
    """(N, 2) centre of each corner's tag, m; the corner itself where it belongs to none."""
    tag: Index
    """(N,) index of the tag among those of its board; -1 for none. A print on the back counts as one."""
    height_shape: Array
    """(N, 4) height of each corner for a bow of 1 m along x and y, a twist of 1 m, and a board 1 m thick: -1 on
    its back."""

    @classmethod
    def from_nominal(cls, nominal: Array, on_back: NDArray[np.bool_] | None = None) -> "PrintedCorners":
        """Corners (N, 3) of no tag, on a flat board; on its back where marked (N,)."""
        N = len(nominal)
        shape = np.zeros((N, 4))
        shape[:, -1] = 0 if on_back is None else -1.0 * on_back
        return cls(nominal, nominal[:, :2], np.full(N, -1, dtype=np.intp), shape)

    @property
    def on_back(self) -> NDArray[np.bool_]:
        """(N,) whether each corner is on the back of the board."""
        return np.asarray(self.height_shape[:, -1] != 0, dtype=np.bool_)

    def displace(self, board: Array, tags: Array) -> tuple[Array, Array]:
        """Corners (N, 3) of an erroneous print, and their derivatives (N, 3, 7 + 3 M).

        Args:
            board: (N, 7) relative scale, aspect (width over height), size of tags; bows, twist and thickness, m.
            tags: (N, M, 3) displacements of the M tags of each corner's board, m and rad.
        """
        scale, aspect, tag_size, *heights = board.T
        first = board.shape[1]
        each, index = np.arange(len(self.tag)), np.maximum(self.tag, 0)
        on_tag = self.tag >= 0
        x, y, angle = (tags[each, index] * on_tag[:, None]).T if tags.shape[1] else np.zeros((3, len(each)))
        c, s = np.cos(angle), np.sin(angle)
        dx, dy = (self.nominal[:, :2] - self.tag_center).T
        arm = np.stack([c * dx - s * dy, s * dx + c * dy], axis=-1)
        across = np.stack([-arm[:, 1], arm[:, 0]], axis=-1) * (1 + tag_size)[:, None]
        place = self.tag_center + np.stack([x, y], axis=-1) + (1 + tag_size)[:, None] * arm
        half = np.array([0.5, -0.5])
        stretch = 1 + aspect[:, None] * half
        factor = (1 + scale)[:, None] * stretch
        height = self.nominal[:, 2] + np.sum(self.height_shape * np.stack(heights, axis=-1), axis=-1)
        J = np.zeros((len(each), 3, first + 3 * tags.shape[1]))
        J[:, :2, 0] = stretch * place
        J[:, :2, 1] = (1 + scale)[:, None] * half * place
        J[:, :2, 2] = factor * arm
        J[:, 2, 3:first] = self.height_shape
        for axis in range(2):
            J[each[on_tag], axis, first + 3 * index[on_tag] + axis] = factor[on_tag, axis]
            J[each[on_tag], axis, first + 2 + 3 * index[on_tag]] = (factor * across)[on_tag, axis]
        return np.column_stack([factor * place, height]), J

    def select(self, kept: Index) -> "PrintedCorners":
        """Some of the corners."""
        return PrintedCorners(self.nominal[kept], self.tag_center[kept], self.tag[kept], self.height_shape[kept])


@dataclass(frozen=True, eq=False)
class CornerObservations(BoardViews):
    """Printed corners in a camera's images, through its full model: pixels.

    The local parameters are the board's pose, then systematic parameters in blocks ``lens``, of
    :func:`adjust_camera`; ``print`` and ``tags``, of :meth:`PrintedCorners.displace`; ``times``, s, if boards
    move: from the stamp to the middle row, and from first to last row; ``residual distortion``. None if all are
    exact.
    """

    printed: PrintedCorners
    pixels: Array
    """(N, 2)."""
    camera: CameraModel
    noise: PixelNoise
    residual_distortion: ResidualDistortion | None = None
    """What the lens displaces beyond its model; None if nothing."""
    dimension: ClassVar[int] = 2
    unit: ClassVar[Literal["px", "m"]] = "px"

    @classmethod
    def from_detections(
        cls, board: Sequence[int], detections: Sequence[BoardCorners], camera: CameraModel, noise: PixelNoise
    ) -> "CornerObservations":
        """The views of these boards in their detections, with exact lens and prints."""
        counts = [len(d.pixels) for d in detections]
        # The plane's normal points at the reader of the front.
        on_back = np.repeat(np.array([d.plane[3] < 0 for d in detections], dtype=np.bool_), counts)
        corners = np.concatenate([np.empty((0, 3)), *(d.corners_board for d in detections)])
        return cls(
            np.array(board, dtype=np.intp),
            start_indices(counts),
            PrintedCorners.from_nominal(corners, on_back),
            np.concatenate([np.empty((0, 2)), *(d.pixels for d in detections)]),
            camera,
            noise,
            parameters=LocalParameters.exact(len(board), {}),
            **stack_motions(detections),
        )

    def linearize(self, T_sensor_board: Array, extra: Array) -> LinearizedResiduals:
        """See :class:`BoardViews`: reprojection errors."""
        camera, corners, by_print, times = self._displace(extra)
        points, R, rotated = self._place(corners, T_sensor_board)
        by_times, turn = np.zeros((len(points), 3, times.shape[1])), None
        if times.shape[1] and len(self.twist):
            points, by_times, turn = self._move_points(points, times)
        pixels, by_point = camera.project_with_jacobian(points)
        by_times = by_point @ by_times
        if turn is not None:
            by_point = by_point + by_point @ turn
        derivatives = [by_point, -by_point @ so3.hat(rotated)]
        if self.parameters.blocks:
            by_lens = project_by_lens(self.camera, camera, points)
            derivatives += [by_lens, by_point @ R @ by_print, by_times]
        if self.residual_distortion and len(self.board):
            coefficients = self.parameters.gather(extra)[0, self.parameters["residual distortion"]]
            pixels, by_pixel, by_field = self.residual_distortion.displace(pixels, coefficients)
            derivatives = [*(by_pixel @ one for one in derivatives), by_field]
        sigma = self.noise_scale * self.noise.pixel
        residual, jacobian = (pixels - self.pixels) / sigma, np.concatenate(derivatives, axis=-1) / sigma
        velocity = velocity_along_sensor(self.twist, T_sensor_board)
        return LinearizedResiduals(residual, jacobian, self.local_jacobian(T_sensor_board), 6, velocity=velocity)

    def unwhiten(self, residual: Array) -> Array:
        """See :class:`BoardViews`."""
        return residual * self.noise_scale * self.noise.pixel

    def _displace(self, extra: Array) -> tuple[CameraModel, Array, Array, Array]:
        """The camera, corners (N, 3) and their derivatives (N, 3, n) by errors of the print, and times (V, t)."""
        local, block = self.parameters.gather(extra), self.parameters
        if not block.blocks:
            return self.camera, self.printed.nominal, np.zeros((len(self.pixels), 3, 0)), local
        camera = adjust_camera(self.camera, local[0, block["lens"]]) if len(local) else self.camera
        of_corner = local[view_indices(self.start, len(self.pixels))]
        tags = of_corner[:, block["tags"]].reshape(len(of_corner), block.size("tags") // 3, 3)
        return camera, *self.printed.displace(of_corner[:, block["print"]], tags), local[:, block["times"]]

    def _place(self, corners: Array, T_sensor_board: Array) -> tuple[Array, Array, Array]:
        """Points (N, 3) before the camera, the rotations (N, 3, 3) of their boards, and rotated corners (N, 3)."""
        T = T_sensor_board[view_indices(self.start, len(self.pixels))]
        R = T[:, :3, :3]
        rotated = (R @ corners[..., None])[..., 0]
        return rotated + T[:, :3, 3], R, rotated

    def is_defined(self, T_sensor_board: Array, extra: Array) -> bool:
        """See :class:`BoardViews`."""
        camera, corners, _, times = self._displace(extra)
        points, _, _ = self._place(corners, T_sensor_board)
        if times.shape[1] and len(self.twist):
            points, _, _ = self._move_points(points, times)
        return bool(np.isfinite(camera.project(points)).all())

    def _move_points(self, points: Array, times: Array) -> tuple[Array, Array, Array]:
        """Moves points (N, 3) from the time of the stamp to that of their row in the image.

        Args:
            points: in the camera frame.
            times: (V, 2) of the block ``times``.

        Returns:
            Points (N, 3), and their derivatives by the times (N, 3, 2) and by the points at the time of the stamp
            (N, 3, 3), minus the identity.
        """
        view = view_indices(self.start, len(self.pixels))
        row = self.pixels[:, 1] / self.camera.height - 0.5
        share = np.stack([np.ones_like(row), row], axis=-1)
        delay = np.sum(share * times[view], axis=-1)
        linear, angular = np.split(self.twist[view], 2, axis=-1)
        velocity = linear + np.cross(angular, points)
        by_times = velocity[..., None] * share[:, None]
        return points + delay[:, None] * velocity, by_times, so3.hat(delay[:, None] * angular)

    def update_noise(self, T_sensor_board: Array, scale: float) -> "CornerObservations":  # noqa: ARG002
        """See :class:`BoardViews`."""
        return replace(self, noise_scale=scale)

    def select(self, keep: NDArray[np.bool_] | Index) -> "CornerObservations":
        """See :class:`BoardViews`."""
        first, kept = select_measurements(self.first, len(self.pixels), keep)
        printed, pixels = self.printed.select(kept), self.pixels[kept]
        return replace(self, first=first, printed=printed, pixels=pixels, **self.select_shared(keep))
