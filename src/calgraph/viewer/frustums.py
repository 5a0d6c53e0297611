"""Fields of view and uncertainties of sensors as shapes in their sensor frames."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calgraph.geometry import Array
from calgraph.sensors import CameraModel

# A fisheye's image plane reaches to infinity; frustums are clipped at this angle to each side, rad.
_MAX_HALF_ANGLE = np.radians(65)
# Standard deviations within which 95 % of a normal distribution in space lie: sqrt(χ²₃(0.95)).
_SCALE_95 = float(np.sqrt(chdtri(3, 0.05)))
_MAX_BEAMS = 45


def frustum_shape(camera: CameraModel) -> tuple[float, float]:
    """The viewing frustum of a camera: its vertical angle, rad, and its aspect ratio, width over height."""
    half = np.minimum(np.array([camera.width, camera.height]) / 2 / camera.focal, np.tan(_MAX_HALF_ANGLE))
    return float(2 * np.arctan(half[1])), float(half[0] / half[1])


def rectify_image(picture: NDArray[np.uint8], camera: CameraModel, width: int = 400) -> NDArray[np.uint8]:
    """Rectifies an image (h, w, 3) to the :func:`frustum_shape`: undistorted and centred."""
    angle, aspect = frustum_shape(camera)
    half = np.tan(angle / 2) * np.array([aspect, 1])
    size = np.array([width, max(round(width / aspect), 1)])
    x, y = np.meshgrid(*((np.arange(n) + 0.5) * 2 / n - 1 for n in size))
    rays = np.stack([half[0] * x, half[1] * y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    shrunk = np.divide(picture.shape[1::-1], (camera.width, camera.height))
    at = ((camera.project(rays) + 0.5) * shrunk - 0.5).reshape(*x.shape, 2).astype(np.float32)
    # NaN, outside of the lens' field of view, is outside of the image as well.
    at = np.nan_to_num(at, nan=-9.0)
    return np.asarray(cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR), dtype=np.uint8)


def sample_beams(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """(K, 2, 3) lines from the origin to an evenly spaced subset of the points (N, 3) of a scan."""
    ends = points[:: len(points) // _MAX_BEAMS + 1]
    return np.stack([np.zeros_like(ends), ends], axis=1)


def uncertainty_ellipsoid(T_root_sensor: Array, covariance: Array, most: float) -> tuple[Array, Array]:
    """The 95 % ellipsoid of a sensor's position.

    Args:
        T_root_sensor: (4, 4).
        covariance: (6, 6) of its error in the root's fixed axes.
        most: longest semi-axis, m, at which unobservable directions are clipped.

    Returns:
        The semi-axes (3,), m, and the rotation (3, 3) from them to the sensor frame.
    """
    variances, axes = np.linalg.eigh(np.nan_to_num(covariance[:3, :3], nan=0.0, posinf=1e12, neginf=-1e12))
    axes = axes * np.linalg.det(axes)
    half = np.minimum(_SCALE_95 * np.sqrt(np.maximum(variances, 0)), most)
    return half, T_root_sensor[:3, :3].T @ axes
