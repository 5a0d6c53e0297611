"""Errors of a camera's intrinsics: what they change, and how they displace pixels."""

from dataclasses import replace

import numpy as np

from calgraph.geometry import Array
from calgraph.sensors.camera_model import CameraModel

ESTIMATED_COEFFICIENTS = {"pinhole": 5, "fisheye": 4}
"""Number of estimated distortion coefficients: those of the denominator of a rational model, which come after
these, have nearly the same effect."""


def adjust_camera(camera: CameraModel, change: Array) -> CameraModel:
    """The camera after changes (4 + n,) of relative focal length and pixel aspect, centre (px) and distortion."""
    stretch = 1 + change[0] + change[1] * np.array([0.5, -0.5])
    return camera.with_intrinsics(
        np.concatenate([
            camera.focal * stretch, camera.principal_point + change[2:4], camera.distortion + change[4:]
        ])
    )  # fmt: skip


def project_by_lens(nominal: CameraModel, camera: CameraModel, points: Array) -> Array:
    """Derivatives (N, 2, 4 + n) of the pixels of points (N, 3) by the changes of :func:`adjust_camera`."""
    J = camera.project_by_intrinsics(points)
    by_focal = J[..., :2] * nominal.focal
    return np.concatenate([by_focal.sum(axis=-1, keepdims=True), by_focal @ [[0.5], [-0.5]], J[..., 2:]], axis=-1)


def with_estimated_distortion(camera: CameraModel) -> CameraModel:
    """The camera with zeros for the coefficients that it does not state."""
    missing = max(ESTIMATED_COEFFICIENTS[camera.model] - len(camera.distortion), 0)
    return replace(camera, distortion=np.append(camera.distortion, np.zeros(missing)))


def displacement_at_corner(camera: CameraModel) -> Array:
    """(n,) displacement of the pixel at a corner of the image by one unit of each distortion coefficient, px."""
    size = np.array([camera.width, camera.height], dtype=np.float64)
    corner = np.where(camera.principal_point > size / 2, 0.0, size)
    # A model may end within the image: the farthest valid pixel towards the corner counts.
    share = np.linspace(1.0, 0.1, 19)[:, None]
    rays = camera.rays(camera.principal_point + share * (corner - camera.principal_point))
    valid = rays[np.isfinite(rays).all(axis=-1)]
    if not len(valid):
        return np.ones(len(camera.distortion))
    return np.asarray(np.linalg.norm(camera.project_by_intrinsics(valid[:1])[0, :, 4:], axis=0))
