"""Start values of intrinsics: a search over focal lengths of undistorted projections.

With the right focal length, rays through the corners of a plane and the corners are related by a homography whose
columns are two orthogonal vectors of equal length and a translation. That holds for rays in any direction, so
also beyond 90 degrees from the axis, where no homography of pixels exists.

Source: Zhang, "A flexible new technique for camera calibration", PAMI 2000, for rays instead of pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array, se3, se_n, so3
from calgraph.rig.detection.board_views import BoardView
from calgraph.sensors import CameraModel
from calgraph.solver.levenberg_marquardt import DenseLinearization, minimize

LensModel = Literal["pinhole", "fisheye"]
COEFFICIENTS: dict[LensModel, int] = {"pinhole": 5, "fisheye": 4}
"""Number of distortion coefficients that are estimated: k1 k2 p1 p2 k3, or k1 to k4."""
_MIN_COSINE = 0.2
"""Least cosine of the angle from the axis (78°) of corners that a pinhole is fitted to."""


@dataclass(frozen=True, eq=False)
class IntrinsicsStart:
    """A camera, and the poses of boards before it."""

    camera: CameraModel
    T_camera_board: Array
    """(V, 4, 4); NaN for views that the camera cannot have."""
    error: float
    """Mean over the views of their median reprojection error, pixels."""


# Largest focal length of the search, in widths of the image: 9.5° over the width, where boards near enough to be
# found are as good as parallel to the image.
_MAX_FOCAL_LENGTH = 6.0
# Smallest focal length of the search, in widths of the image: fisheye lenses of 360° over the width have 0.16.
_MIN_FOCAL_LENGTH = 0.15
# Ratio of neighbouring focal lengths of the search: start values within 7 % lead to the minimum.
_FOCAL_LENGTH_RATIO = 1.15


def search_focal_length(views: Sequence[BoardView], model: LensModel) -> IntrinsicsStart:
    """The undistorted camera that explains the views best.

    Args:
        views: of boards, in images of one size.
        model: the kind of the camera; its principal point is the middle of the image.
    """
    width, height = views[0].size
    ratio = _MAX_FOCAL_LENGTH / _MIN_FOCAL_LENGTH
    steps = int(np.ceil(np.log(ratio) / np.log(_FOCAL_LENGTH_RATIO)))
    distortion = np.zeros(COEFFICIENTS[model])
    cameras = []
    for focal in width * _MIN_FOCAL_LENGTH * _FOCAL_LENGTH_RATIO ** np.arange(steps + 1):
        K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
        cameras.append(CameraModel(model, width, height, K, distortion))
    return min(locate_views(views, cameras), key=lambda start: start.error)


def locate_views(views: Sequence[BoardView], cameras: Sequence[CameraModel]) -> list[IntrinsicsStart]:
    """The poses of boards before each of the cameras, each by the homography between rays and corners."""
    starts = np.cumsum([len(view.flat_pixels) for view in views])[:-1]
    pixels = np.concatenate([view.flat_pixels for view in views])
    rays = np.split(np.array([camera.rays(pixels) for camera in cameras]), starts, axis=1)
    T = np.stack(
        [_solve_homographies(view.flat_corners, part) for view, part in zip(views, rays, strict=True)], axis=1
    )
    points = [se3.apply(T[:, i], view.flat_corners) for i, view in enumerate(views)]
    projected = [camera.project(one) for camera, one in zip(cameras, np.concatenate(points, axis=1), strict=True)]
    distances = np.linalg.norm(np.array(projected) - pixels, axis=-1)
    # A view without a pose is as wrong as can be.
    largest = float(max(cameras[0].width, cameras[0].height))
    bounded = np.minimum(np.where(np.isfinite(distances), distances, largest), largest)
    errors = np.mean([np.median(part, axis=1) for part in np.split(bounded, starts, axis=1)], axis=0)
    return [IntrinsicsStart(*found) for found in zip(cameras, T, errors.tolist(), strict=True)]


def _solve_homographies(corners: Array, rays: Array) -> Array:
    """Poses (K, 4, 4) of coplanar corners (N, 3) in the direction of rays (K, N, 3) of K cameras; NaN without one.

    Rays that a camera does not have are NaN.
    """
    valid, places = np.asarray(np.isfinite(rays).all(axis=-1)), corners[:, :2]
    rays = np.where(valid[..., None], rays, 0.0)
    middle = places.mean(axis=0)
    scale = np.sqrt(np.mean((places - middle) ** 2))
    x = np.column_stack([(places - middle) / scale, np.ones(len(places))])
    # d x (H x) = 0 for every ray d.
    A = np.einsum("knij,nl->knijl", so3.hat(rays), x).reshape(len(rays), -1, 9)
    H = np.linalg.eigh(se_n.transpose(A) @ A)[1][..., 0].reshape(-1, 3, 3)
    H = np.where(np.sum(rays * (x @ se_n.transpose(H)), axis=(1, 2))[:, None, None] < 0, -H, H)
    lengths = np.linalg.norm(H[..., :2], axis=1)
    has_pose = (valid.sum(axis=1) >= 4) & lengths.all(axis=1)
    lengths = np.where(has_pose[:, None], lengths, 1.0)
    a, b = np.moveaxis(H[..., :2] / lengths[:, None], -1, 0)
    R = se_n.nearest_rotation(np.stack([a, b, np.cross(a, b)], axis=-1))
    t = H[..., 2] * scale / np.sqrt(lengths.prod(axis=1))[:, None] - R[..., :2] @ middle
    # The face of a board in view is towards the camera.
    has_pose &= np.sum(R[..., 2] * (t + R[..., :2] @ middle), axis=1) < 0
    return np.where(has_pose[:, None, None], se3.pose(R, t), np.nan)


def convert_model(
    views: Sequence[BoardView], camera: CameraModel, T_camera_board: Array, model: LensModel, max_steps: int
) -> IntrinsicsStart | None:
    """The camera of another model that is nearest to a fitted one at the corners of its views; None without one.

    Args:
        views: of boards.
        camera: fitted to them.
        T_camera_board: (V, 4, 4) poses of the boards before it; NaN for views that are left out.
        model: the other model.
        max_steps: limit on Levenberg-Marquardt steps.
    """
    located = [(view, T) for view, T in zip(views, T_camera_board, strict=True) if np.isfinite(T).all()]
    points = np.concatenate([se3.apply(T, view.flat_corners) for view, T in located])
    pixels = np.concatenate([view.flat_pixels for view, _ in located])
    # The tangent of a pinhole's angles diverges: only corners well in front enter.
    front = points[:, 2] > _MIN_COSINE * np.linalg.norm(points, axis=1)
    points, pixels = (points[front], pixels[front]) if model == "pinhole" else (points, pixels)
    start = replace(camera, model=model, distortion=np.zeros(COEFFICIENTS[model]))

    def linearize(camera: CameraModel, _: DenseLinearization | None) -> DenseLinearization:
        J = camera.project_by_intrinsics(points)
        return DenseLinearization((camera.project(points) - pixels).ravel(), J.reshape(-1, J.shape[-1]))

    def retract(camera: CameraModel, step: Array) -> CameraModel:
        return camera.with_intrinsics(camera.intrinsics + step)

    try:
        minimum = minimize(start, linearize, retract, iterations=max_steps, tolerance=1e-6)
    except (np.linalg.LinAlgError, InputError):
        return None
    return locate_views(views, [minimum.state])[0] if np.isfinite(minimum.linearization.cost) else None
