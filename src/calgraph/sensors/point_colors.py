"""Visibility and colours of points in a camera image."""

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.sensors.camera_model import CameraModel

# Points in one cell of this width may occlude each other: about the angle between a LiDAR's beams, rad.
_OCCLUSION_CELL = 0.02
# Points whose depths differ by less than this belong to one surface: a fraction of the distance, plus metres.
_SURFACE_DEPTH_RATIO, _SURFACE_DEPTH = 0.05, 0.1
# So do points whose inverse distances differ by less, 1/m: inverse distance is linear in the direction on a plane,
# however slanted. On a floor 1.2 m below the camera it changes by this much across two cells.
_MAX_INVERSE_DEPTH_STEP = 0.035


def colorize_points(
    points: Array, camera: CameraModel, pixels: NDArray[np.uint8]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Looks up the colours of points in an image.

    A point is not visible if it is outside the image, or well behind another in nearly the same direction.

    Args:
        points: (N, 3) in the camera's frame, m.
        camera: intrinsics of the full image.
        pixels: (h, w) grey or (h, w, 3) image in any order of channels; may be a resized image.

    Returns:
        Colours (N, 3) in the image's order of channels, 0 where not visible; and the mask (N,) of visible points.
    """
    at = camera.project(points)
    visible = np.flatnonzero(camera.contains(at))
    visible = visible[_unoccluded(points[visible], at[visible] / (_OCCLUSION_CELL * camera.focal))]
    resized = (at[visible] + 0.5) * np.divide(pixels.shape[1::-1], (camera.width, camera.height))
    column, row = resized.astype(np.intp).T
    colors = np.zeros((len(points), 3), dtype=np.uint8)
    colors[visible] = np.atleast_3d(pixels)[row, column]
    mask = np.zeros(len(points), dtype=np.bool_)
    mask[visible] = True
    return colors, mask


def _unoccluded(points: Array, cells: Array) -> NDArray[np.bool_]:
    """(N,) mask of points (N, 3) that no other point occludes, given their cells (N, 2) of the view.

    Points are compared with the nearest point of their cell and of its neighbours, so that cell borders have no
    effect.
    """
    distance = np.linalg.norm(points, axis=1)
    column, row = np.floor(cells).astype(np.intp).T if len(cells) else np.zeros((2, 0), dtype=np.intp)
    column, row = column - column.min(initial=0) + 1, row - row.min(initial=0) + 1
    nearest = np.full((row.max(initial=0) + 2, column.max(initial=0) + 2), np.inf)
    np.minimum.at(nearest, (row, column), distance)
    around = np.min([nearest[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0, initial=np.inf)
    behind = distance > (1 + _SURFACE_DEPTH_RATIO) * around + _SURFACE_DEPTH
    return np.asarray(~behind | (1 / around - 1 / np.maximum(distance, _SURFACE_DEPTH) < _MAX_INVERSE_DEPTH_STEP))
