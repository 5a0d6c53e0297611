"""Images of a simulated stereo depth camera: what a calibration does not know of it included."""

from collections.abc import Sequence

import cv2
import numpy as np

from calgraph.geometry import Array
from calgraph.sensors import Image
from calgraph.simulation.robot import MountedDepthCamera
from calgraph.simulation.solids import Solid, cast_rays

# Relative step between the depths of neighbouring pixels that is an edge of an object.
_EDGE_STEP = 0.05
# Probability that a pixel at an edge gets a depth between both: a flying pixel.
_FLYING = 0.3
# Waves of the constant error over half of the image, rad, and their share of what it has at the border: no
# polynomial of low order describes them.
_WAVES, _WAVE_SHARE = 3.0, 0.3
# Depth of pixels that see nothing, m: farther than any camera measures.
_NOTHING = 1e3


def simulate_depth_image(
    sensor: MountedDepthCamera, solids: Sequence[Solid], stamp: float, rng: np.random.Generator
) -> Image:
    """The depth image of a scene that stands still, in whole millimetres.

    Errors are those of a disparity, and so grow with the square of the depth: noise that neighbouring pixels
    share, and a constant part that varies over the image. Windows that contain an edge measure what is nearer.
    """
    options, shape = sensor.options, (sensor.camera.height, sensor.camera.width)
    window = np.ones((options.window, options.window), np.uint8)
    true = _cast_depths(sensor, solids).reshape(shape)
    near, far = cv2.erode(true, window), cv2.dilate(true, window)
    edge = far - near > _EDGE_STEP * near
    flying = edge & (rng.random(shape) < _FLYING)
    near = np.where(edge, near, true)
    depth = np.where(flying, near + rng.random(shape) * (far - near), near)
    # The mean over a window is of variance 1 / window².
    noise = cv2.blur(rng.standard_normal(shape), window.shape, borderType=cv2.BORDER_REFLECT) * options.window
    depth = depth + depth**2 * (options.noise * noise + _warp(sensor, shape))
    measured = (depth >= options.min_range) & (depth <= options.max_range)
    millimetres = np.round(1e3 * np.where(measured, depth, 0.0))
    values = np.where(measured, 1e-3 * millimetres, np.nan).astype(np.float32)
    picture = np.clip(0.255 * millimetres / options.max_range, 0, 255).astype(np.uint8)
    return Image(stamp, sensor.frame_id, picture, values)


def _cast_depths(sensor: MountedDepthCamera, solids: Sequence[Solid]) -> Array:
    """(N,) true depths of all pixels, row by row, m."""
    camera = sensor.camera
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.nan_to_num(camera.rays(np.column_stack([u.ravel(), v.ravel()])), nan=0.0)
    found = np.any(rays, axis=1)
    R, origin = sensor.T_world_sensor[:3, :3], sensor.T_world_sensor[None, :3, 3]
    depths = np.full(len(rays), _NOTHING)
    depths[found] = cast_rays(solids, origin, rays[found] @ R.T).ranges * rays[found, 2]
    return np.asarray(np.minimum(depths, _NOTHING))


def _warp(sensor: MountedDepthCamera, shape: tuple[int, int]) -> Array:
    """(H, W) constant error of depths, m at 1 m."""
    x, y = np.linspace(-1, 1, shape[1]), np.linspace(-1, 1, shape[0])[:, None] * shape[0] / shape[1]
    whole, border = sensor.warp
    waves = np.sin(_WAVES * x + 1e3 * whole) * np.cos(_WAVES * y)
    return np.asarray(whole + border * (x**2 + y**2) + _WAVE_SHARE * border * waves)
