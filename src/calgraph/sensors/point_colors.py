"""Which points a camera sees, and in which colours."""

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.sensors.camera_model import CameraModel

# Points within so wide a cell of the view hide each other: about the gaps between a LiDAR's beams, rad.
_CELL = 0.02
# Nearer together along the sight than this they are one surface: a share of the distance, and m.
_SHARE, _THICKNESS = 0.05, 0.1
# As are those whose inverse distances differ by less, 1/m: on a plane, however slanted, they change steadily. A
# floor 1.2 m below changes by as much across two cells.
_SLANT = 0.035


def painted(
    points: Array, camera: CameraModel, pixels: NDArray[np.uint8]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The colours in which a camera sees points.

    A point is not seen if it is outside the image, or well behind another that lies in nearly the same direction.

    Args:
        points: (N, 3) in the camera's frame, m.
        camera: intrinsics of the full image.
        pixels: (h, w) grey or (h, w, 3) image in any order of channels, of any size: shrunk ones serve.

    Returns:
        Colours (N, 3) in the image's order of channels, 0 where not seen; and which points are seen (N,).

    """
    at = camera.project(points)
    seen = np.flatnonzero(camera.contains(at))
    seen = seen[_in_front(points[seen], at[seen] / (_CELL * camera.focal))]
    shrunk = (at[seen] + 0.5) * np.divide(pixels.shape[1::-1], (camera.width, camera.height))
    column, row = shrunk.astype(np.intp).T
    colors = np.zeros((len(points), 3), dtype=np.uint8)
    colors[seen] = np.atleast_3d(pixels)[row, column]
    mask = np.zeros(len(points), dtype=np.bool_)
    mask[seen] = True
    return colors, mask


def _in_front(points: Array, cells: Array) -> NDArray[np.bool_]:
    """(N,) which of points (N, 3) nothing hides, by the cells of the view (N, 2) in which they lie.

    Points are compared with the nearest in their cell and its neighbours, so that no border lets any through.
    """
    distance = np.linalg.norm(points, axis=1)
    column, row = np.floor(cells).astype(np.intp).T if len(cells) else np.zeros((2, 0), dtype=np.intp)
    column, row = column - column.min(initial=0) + 1, row - row.min(initial=0) + 1
    nearest = np.full((row.max(initial=0) + 2, column.max(initial=0) + 2), np.inf)
    np.minimum.at(nearest, (row, column), distance)
    around = np.min([nearest[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0, initial=np.inf)
    apart = distance > (1 + _SHARE) * around + _THICKNESS
    return np.asarray(~apart | (1 / around - 1 / np.maximum(distance, _THICKNESS) < _SLANT))
