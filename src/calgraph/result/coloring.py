"""Colours of points from camera images."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se3
from calgraph.result.snapshots import Snapshot
from calgraph.sensors import CameraModel, colorize_points


def colorize_from_snapshots(
    x_root: Array,
    snapshots: Sequence[Snapshot],
    cameras: Mapping[str, CameraModel],
    T_root_sensor: Mapping[str, Array],
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The colours of points in simultaneous images; of each point, from the first image that shows it.

    Args:
        x_root: (N, 3) in the root's frame, m.
        snapshots: of any sensors; images of cameras without intrinsics or pose are skipped.
        cameras: intrinsics by camera.
        T_root_sensor: (4, 4) by sensor.

    Returns:
        Red, green and blue (N, 3), 0 where the point is in no image; and whether it is in one (N,).
    """
    colors, is_colored = np.zeros((len(x_root), 3), dtype=np.uint8), np.zeros(len(x_root), dtype=np.bool_)
    for s in snapshots:
        if s.image and s.sensor in cameras and s.sensor in T_root_sensor:
            x_camera = se3.apply(se3.inverse(T_root_sensor[s.sensor]), x_root)
            camera_colors, is_visible = colorize_points(x_camera, cameras[s.sensor], s.picture)
            colors[is_visible & ~is_colored] = camera_colors[is_visible & ~is_colored]
            is_colored |= is_visible
    return colors, is_colored
