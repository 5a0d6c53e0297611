"""Rectified views of tags: the image of a virtual camera without distortion that points at them.

The AprilTag library fits straight lines to the edges of tags. Lens distortion bends them: a tag of 36 pixels, 40
degrees off a fisheye's axis, is detected larger by 0.2 pixels, and so nearer by half a per cent.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from calgraph.boards.tags import Gray
from calgraph.geometry import Array
from calgraph.sensors import CameraModel

_STEP = 8
"""The map from view to image is computed every 8 pixels, and interpolated: it is smooth."""


@dataclass(frozen=True, eq=False)
class RectifiedView:
    """A piece of an image, resampled."""

    image: Gray
    """(height, width)."""
    camera: CameraModel
    """The camera that took the image."""
    R_camera_view: Array
    """(3, 3) rotation of the camera without distortion."""
    focal: float
    """Its focal length, pixels."""
    corner: Array
    """(2,) the centre of the view's first pixel on its plane z = 1."""

    def to_image(self, pixels: Array) -> Array:
        """Maps pixels (..., 2) of the view to the image."""
        return _project_to_image(pixels, self.camera, self.R_camera_view, self.focal, self.corner)


def is_undistorted(camera: CameraModel) -> bool:
    """Whether straight lines are straight in the camera's images."""
    return camera.model == "pinhole" and not camera.distortion.any()


# Tangent of the largest angle between a corner and the axis of a rectified view (76°): beyond it the view is
# stretched more than tenfold towards its edge.
_MAX_VIEW_TANGENT = 4.0
# Resolution of a rectified view over that of the image: resampling at 1 blurs edges by about half a pixel.
_VIEW_SCALE = 1.5
# Margin around the tags in a rectified view, in edges of the largest tag: its white border and the error of the
# prediction.
_VIEW_MARGIN = 0.4
# Maximum number of pixels along an edge of a rectified view: bounds memory and time.
_MAX_VIEW_SIZE = 2000


def rectify_view(gray: Gray, camera: CameraModel, corners: Array) -> RectifiedView | None:
    """Resamples the image of tags; None if they span too wide an angle for one view.

    Args:
        gray: image (height, width).
        camera: its intrinsics.
        corners: (M, 4, 3) approximate corners of the tags, camera frame, m.
    """
    points = corners.reshape(-1, 3)
    R_camera_view = _compute_look_at(points.mean(axis=0))
    local = points @ R_camera_view
    flat = local[:, :2] / local[:, 2:]
    if (local[:, 2] <= 0).any() or np.abs(flat).max() > _MAX_VIEW_TANGENT:
        return None
    edges = _edge_lengths(flat.reshape(-1, 4, 2))
    focal = _VIEW_SCALE * float(np.median(_edge_lengths(camera.project(points).reshape(-1, 4, 2)) / edges))
    margin = _VIEW_MARGIN * edges.max()
    low, high = flat.min(axis=0) - margin, flat.max(axis=0) + margin
    focal = min(focal, _MAX_VIEW_SIZE / (high - low).max())
    width, height = np.ceil(focal * (high - low)).astype(int) + 1
    nodes = np.stack(np.meshgrid(_grid_nodes(width), _grid_nodes(height)), axis=-1)
    sparse = _project_to_image(nodes, camera, R_camera_view, focal, low)
    down, across = _interpolation_weights(height), _interpolation_weights(width)
    x, y = ((down @ np.nan_to_num(sparse[..., k], nan=-1e4) @ across.T).astype(np.float32) for k in (0, 1))
    image = cv2.remap(gray, x, y, cv2.INTER_LINEAR)
    return RectifiedView(np.asarray(image, dtype=np.uint8), camera, R_camera_view, focal, low)


def _compute_look_at(point: Array) -> Array:
    """Rotation (3, 3) from a frame whose z axis points at a point, with y downwards where possible."""
    z = point / np.linalg.norm(point)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [0.0, 0.0, -1.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _project_to_image(
    pixels: Array, camera: CameraModel, R_camera_view: Array, focal: float, corner: Array
) -> Array:
    flat = (corner + pixels / focal).reshape(-1, 2)
    rays = np.column_stack([flat, np.ones(len(flat))]) @ R_camera_view.T
    return camera.project(rays).reshape(pixels.shape)


def _edge_lengths(quads: Array) -> Array:
    """(M, 4) lengths of the edges of quadrilaterals (M, 4, 2)."""
    return np.asarray(np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=-1))


def _grid_nodes(length: int) -> Array:
    return np.arange(0.0, length + _STEP, _STEP)


def _interpolation_weights(length: int) -> Array:
    """(length, nodes) weights of linear interpolation between the nodes."""
    distance = np.abs(np.arange(length)[:, None] - _grid_nodes(length)) / _STEP
    return np.asarray(np.clip(1 - distance, 0, None))
