"""Depth cameras: what rig.yaml states of them, and the clouds that their images are."""

from functools import lru_cache
from typing import Literal

import numpy as np

from calgraph.geometry import Array
from calgraph.io.quantities import AngleSigma, LengthStddev, RangeSigma, Ratio
from calgraph.sensors.camera_model import CameraModel
from calgraph.sensors.kinds.sensor_kind import OPTICAL_AXES, SensorKind
from calgraph.sensors.kinds.stated import BeamError, Intrinsics, OpticalSpec, RangeNoise, RangeUncertainty
from calgraph.sensors.messages import Image, Message, PointCloud

# Standard deviation below which no depth is measured, m: near the camera time of flight and millimetres of the
# message limit it, not the disparity.
_MIN_SIGMA = 0.001
# Columns of an image of which one pixel each is kept. Depths within a window of the stereo matching, 5 to 9 of 640
# pixels, share their errors: the pixels between would add time, and count as independent measurements.
_COLUMNS = 100
# Distance, m, from which the noise is not extrapolated: depth cameras measure up to 10 m.
_MAX_DISTANCE = 10.0


class DepthNoise(RangeNoise):
    """Noise of a depth camera: ``sigma(z) = range (z / 1 m)²``, at least 1 mm, along the optical axis.

    Disparities ``d = f b / z`` of a stereo camera have a constant error, so that ``dz = z² dd / (f b)``. The error
    of times of flight grows in nearly the same way, as the returned light falls with the square of the distance.
    """

    range: RangeSigma = 0.003
    """Standard deviation of a depth at 1 m, m. 0.08 pixels of disparity at f = 425 pixels and a baseline of 50 mm
    (RealSense D435, 848 x 480) are 3.8 mm, at 640 pixels 2.5 mm; Azure Kinect has 1 to 2 mm."""
    angle: AngleSigma = 0.0005
    """Standard deviation of a pixel's direction, rad: a third of a pixel."""

    def at(self, distance: float | Array) -> Array:
        """Standard deviations (N,) of depths (N,), m."""
        return np.asarray(np.maximum(self.range * np.minimum(distance, _MAX_DISTANCE) ** 2, _MIN_SIGMA))

    def of_beams(self, ranges: Array, directions: Array) -> Array:
        """Standard deviations (N,) of ranges (N,) along directions (N, 3), m."""
        return self.at(ranges * directions[:, 2]) / directions[:, 2]


class DepthCameraUncertainty(RangeUncertainty):
    """Prior standard deviations of a depth camera's systematic errors; 0 means exact."""

    range_bias: LengthStddev = 0.01
    """m, the same for all beams. Microsoft states ±11 mm for Azure Kinect, as a limit."""
    range_scale: Ratio = 0.01
    """Relative. Intel states an error of up to 2 % of the distance for RealSense D400, Luxonis 2 to 4 % for OAK-D:
    an error of the baseline or of the focal length scales all depths."""
    depth_bias: LengthStddev = 0.004
    """m at 1 m, growing with the square of the depth: 0.1 pixels of disparity (RealSense D435, 848 x 480)."""
    depth_warp: LengthStddev = 0.002
    """The same at 45° from the optical axis over that on the axis, along x, along y, and radially. Rectification
    leaves half of such an error, in the directions in which the two images of a stereo camera are turned."""

    def beam_errors(self) -> tuple[BeamError, ...]:
        """See :class:`RangeUncertainty`; also errors of disparities: the same in the image, linear in it, radial.

        They are in m at a depth of 1 m and grow with its square: one unit lengthens a range r along (x, y, z) by
        ``(r z)² / z``.
        """
        return (
            *super().beam_errors(),
            BeamError("depth bias at 1 m", "m", self.depth_bias, lengthen=_lengthen_equally, power=2),
            BeamError("depth warp along x", "m", self.depth_warp, lengthen=_lengthen_along_x, power=2),
            BeamError("depth warp along y", "m", self.depth_warp, lengthen=_lengthen_along_y, power=2),
            BeamError("radial depth warp", "m", self.depth_warp, lengthen=_lengthen_radially, power=2),
        )


def _lengthen_equally(directions: Array) -> Array:
    return np.asarray(directions[:, 2])


def _lengthen_along_x(directions: Array) -> Array:
    return np.asarray(directions[:, 0])


def _lengthen_along_y(directions: Array) -> Array:
    return np.asarray(directions[:, 1])


def _lengthen_radially(directions: Array) -> Array:
    x, y, z = directions.T
    return np.asarray((x**2 + y**2) / z)


class DepthCameraSpec(OpticalSpec):
    """A depth camera of the rig."""

    kind: Literal["depth_camera"] = "depth_camera"
    intrinsics: Intrinsics | None = None
    """The intrinsics, instead of a topic."""
    noise: DepthNoise = DepthNoise()
    uncertainty: DepthCameraUncertainty = DepthCameraUncertainty()


def convert_depth_image(image: Image, camera: CameraModel) -> PointCloud:
    """The cloud, in the optical frame, of a depth image: pixels of a grid, without those that measured nothing.

    Args:
        image: with depths along the optical axis.
        camera: its intrinsics; their distortion is removed from the directions of pixels.

    Raises:
        ValueError: the image has no depths, or another size than the intrinsics.
    """
    if image.depth is None:
        raise ValueError(
            "the image has no depths: it must have the encoding 16UC1 (mm) or 32FC1 (m), or be a 16-bit PNG (mm) "
            "in a folder whose name contains depth"
        )
    height, width = image.depth.shape
    if (width, height) != (camera.width, camera.height):
        raise ValueError(
            f"the depth image has {width} x {height} pixels, its intrinsics are of {camera.width} x "
            f"{camera.height}"
        )
    step = max(1, round(width / _COLUMNS))
    depth = image.depth[step // 2 :: step, step // 2 :: step].ravel().astype(np.float64)
    scaled = _rays_of_grid(
        camera.model, width, height, camera.K.tobytes(), np.asarray(camera.distortion).tobytes(), step
    )
    valid = np.isfinite(depth) & np.isfinite(scaled[:, 0])
    return PointCloud(image.stamp, image.frame_id, depth[valid, None] * scaled[valid])


@lru_cache(maxsize=8)
def _rays_of_grid(
    model: Literal["pinhole", "fisheye"], width: int, height: int, K: bytes, distortion: bytes, step: int
) -> Array:
    """(N, 3) directions with z = 1 of every ``step``-th pixel, row by row; NaN where no point projects there.

    The arrays are given as bytes, by which equal cameras of several messages have one entry.
    """
    camera = CameraModel(model, width, height, np.frombuffer(K).reshape(3, 3), np.frombuffer(distortion))
    v, u = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]))
    return np.asarray(rays / np.where(rays[:, 2:] > 0, rays[:, 2:], np.nan))


def _has_depths(message: Message) -> bool:
    return isinstance(message, Image) and message.depth is not None


DEPTH_CAMERA = SensorKind(
    name="depth_camera",
    title="depth camera",
    spec=DepthCameraSpec,
    messages=(PointCloud,),
    types=(),
    detects="plane",
    axes=OPTICAL_AXES,
    shape="frustum",
    color="#c9a2ff",
    default_name="depth",
    drafted_noise="{range: 0.003}",
    residual="distance from the board",
    noise_causes="check its noise at 1 m, and that its depths are in mm (16UC1) or m (32FC1)",
    error_causes="its noise at 1 m, and its intrinsics",
    correction="true range r along the unit vector (x, y, z): range = range bias + range scale * r + r^2 * (z * "
    "depth bias at 1 m + x * depth warp along x + y * depth warp along y + (x^2 + y^2) / z * radial depth warp)",
    claims=_has_depths,
    convert=convert_depth_image,
)
