"""What sensors look at, and how uncertain they are, as shapes in the sensors' own frames."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calgraph.geometry import Array
from calgraph.sensors import CameraModel

# A fisheye's image plane reaches to infinity; so much to each side is enough of a picture, rad.
_WIDEST = np.radians(65)
# 95 % of a normal distribution in space lies within this many standard deviations.
_SCALE_95 = float(np.sqrt(chdtri(3, 0.05)))
_BEAMS = 45


def window(camera: CameraModel) -> tuple[float, float]:
    """The pyramid that stands for what a camera sees: its angle from top to bottom, rad, and width over height."""
    half = np.minimum(np.array([camera.width, camera.height]) / 2 / camera.focal, np.tan(_WIDEST))
    return float(2 * np.arctan(half[1])), float(half[0] / half[1])


def through_window(picture: NDArray[np.uint8], camera: CameraModel, width: int = 400) -> NDArray[np.uint8]:
    """A picture (h, w, 3) as it looks through the :func:`window`: without the lens's distortion, and centred."""
    angle, aspect = window(camera)
    half = np.tan(angle / 2) * np.array([aspect, 1])
    size = np.array([width, max(round(width / aspect), 1)])
    x, y = np.meshgrid(*((np.arange(n) + 0.5) * 2 / n - 1 for n in size))
    rays = np.stack([half[0] * x, half[1] * y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    shrunk = np.divide(picture.shape[1::-1], (camera.width, camera.height))
    at = ((camera.project(rays) + 0.5) * shrunk - 0.5).reshape(*x.shape, 2).astype(np.float32)
    # NaN, where the lens says nothing, is outside as well.
    at = np.nan_to_num(at, nan=-9.0)
    return np.asarray(cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR), dtype=np.uint8)


def beams(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """(K, 2, 3) from the origin to some of the points (N, 3) of a scan, spread over it."""
    ends = points[:: len(points) // _BEAMS + 1]
    return np.stack([np.zeros_like(ends), ends], axis=1)


def ellipsoid(T_root_sensor: Array, covariance: Array, most: float) -> tuple[Array, Array]:
    """Where a sensor is with 95 % probability.

    Args:
        T_root_sensor: (4, 4).
        covariance: (6, 6) of its error in the root's fixed axes.
        most: longest half axis, m, at which unobservable directions are cut off.

    Returns:
        The half axes (3,), m, and the rotation (3, 3) from them to the sensor's frame.
    """
    variances, axes = np.linalg.eigh(np.nan_to_num(covariance[:3, :3], nan=0.0, posinf=1e12, neginf=-1e12))
    axes = axes * np.linalg.det(axes)
    half = np.minimum(_SCALE_95 * np.sqrt(np.maximum(variances, 0)), most)
    return half, T_root_sensor[:3, :3].T @ axes
