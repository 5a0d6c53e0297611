"""The plane of a board as the mean over its tags (MSG-Cal, section III-C)."""

import numpy as np

from calgraph.boards.board_pose import fit_pose, plane_covariance
from calgraph.boards.tags import Marks
from calgraph.errors import Rejected
from calgraph.geometry import Array, plane
from calgraph.sensors import CameraModel


def estimate_mean_plane(
    marks: Marks, corners: Array, camera: CameraModel, sigma: float
) -> tuple[Array, Array] | None:
    """The mean of normals and offsets of one PnP per tag: plane (4,) and covariance (3, 3).

    None if no single tag determines its plane.
    """
    planes, covariances = [], []
    for i in range(len(marks)):
        pose = fit_pose(marks.ids[i : i + 1], corners[i : i + 1], marks.pixels[i : i + 1], camera, sigma)
        if isinstance(pose, Rejected):
            continue
        one = plane.from_pose(pose.T_camera_board)
        chart = _chart(one[:3])
        planes.append(one)
        covariances.append(chart @ plane_covariance(pose.T_camera_board, pose.covariance) @ chart.T)
    if not planes:
        return None
    mean = np.mean(planes, axis=0)
    mean[:3] /= np.linalg.norm(mean[:3])
    back = _chart(mean[:3]).T
    return mean, np.asarray(back @ np.sum(covariances, axis=0) @ back.T / len(planes) ** 2)


def _chart(normal: Array) -> Array:
    """Derivative (4, 3) of a plane by its tangent vector in ``plane.retract``."""
    J = np.zeros((4, 3))
    J[:3, :2] = plane.tangent_basis(normal)
    J[3, 2] = 1
    return J
