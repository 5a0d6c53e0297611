"""Errors of a camera's intrinsics: what they change, and how they displace pixels."""

import numpy as np

from calgraph.geometry import Array
from calgraph.sensors.camera_model import CameraModel


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
