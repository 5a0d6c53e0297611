"""Lines and surfaces of sensors and their uncertainty, in metres, in the root frame."""

import numpy as np
from scipy.special import chdtri

from calgraph.geometry import Array, se3
from calgraph.sensors import CameraModel

Polyline = Array
"""(N, 3) points of one line, m."""

# Standard deviations within which 95 % of a normal distribution in space lie: sqrt(χ²₃(0.95)).
SCALE_95 = float(np.sqrt(chdtri(3, 0.05)))


def frame_axes(T_root_sensor: Array, size: float) -> list[Polyline]:
    """The x, y and z axis as lines from the origin."""
    origin = T_root_sensor[:3, 3]
    return [np.stack([origin, origin + size * T_root_sensor[:3, i]]) for i in range(3)]


def camera_frustum(T_root_camera: Array, camera: CameraModel | None, depth: float) -> list[Polyline]:
    """The viewing frustum of a camera, without its lens distortion; 60° by 45° without intrinsics."""
    half = np.tan(np.radians([30.0, 22.5]))
    low, high = -half, half
    if camera is not None:
        focal, center = np.diag(camera.K)[:2], camera.K[:2, 2]
        size = np.array([camera.width, camera.height])
        # A fisheye's image plane reaches to infinity; it is clipped at 70° to each side.
        limit = np.tan(np.radians(70))
        low, high = np.clip(-center / focal, -limit, limit), np.clip((size - center) / focal, -limit, limit)
    corners = depth * np.array(
        [[low[0], low[1], 1], [high[0], low[1], 1], [high[0], high[1], 1], [low[0], high[1], 1]]
    )
    ring = se3.apply(T_root_camera, np.concatenate([corners, corners[:1]]))
    origin = T_root_camera[:3, 3]
    return [ring, *(np.stack([origin, corner]) for corner in ring[:4])]


def scan_circle(T_root_sensor: Array, radius: float, elevation: float = 0.0) -> Polyline:
    """The circle that a beam at an elevation (rad) describes about the sensor's z axis."""
    angles = np.linspace(0, 2 * np.pi, 49)
    c, s = np.cos(elevation), np.sin(elevation)
    circle = radius * np.stack([c * np.cos(angles), c * np.sin(angles), np.full_like(angles, s)], axis=-1)
    return se3.apply(T_root_sensor, circle)


def ellipsoid_mesh(center: Array, covariance: Array, exaggeration: float, limit: float) -> tuple[Array, Array]:
    """The 95 % ellipsoid of a position as a mesh.

    Args:
        center: (3,) m.
        covariance: (3, 3) m².
        exaggeration: factor on its size.
        limit: longest semi-axis, m; unobservable directions are clipped there.

    Returns:
        Vertices (N, 3) and triangles (M, 3) of indices.
    """
    variances, directions = np.linalg.eigh(np.nan_to_num(covariance, nan=0.0, posinf=1e12, neginf=-1e12))
    semi_axes = np.minimum(exaggeration * SCALE_95 * np.sqrt(np.maximum(variances, 0)), limit)
    unit, triangles = _unit_sphere(12, 18)
    return center + (unit * semi_axes) @ directions.T, triangles


def _unit_sphere(rows: int, columns: int) -> tuple[Array, Array]:
    """A unit sphere: vertices (N, 3) and triangles (M, 3)."""
    polar, azimuth = np.meshgrid(
        np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij"
    )
    vertices = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    triangles = np.stack([a, b, b + columns, a, b + columns, a + columns], axis=-1)
    return vertices.reshape(-1, 3), triangles.reshape(-1, 3)
