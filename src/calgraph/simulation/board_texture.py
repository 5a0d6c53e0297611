"""The printed face of a board as an image, every texel the exact mean of the print over its area."""

import cv2
import numpy as np

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.rig import AprilGrid, Board, Charuco, Checkerboard

_FAMILIES = {
    "tag36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "tag25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "tag16h5": cv2.aruco.DICT_APRILTAG_16h5,
}


def board_texture(board: Board, texels_per_meter: float) -> Array:
    """The face of a board as a reader sees it, reflectance 0 (ink) to 1 (paper).

    Args:
        board: what is printed where.
        texels_per_meter: resolution; the sheet's edges fall on texel edges to the nearest whole texel.

    Returns:
        (rows, columns); texel (row, column) is centred at ``x = (column + 0.5) / columns * width - width / 2``
        and ``y = height / 2 - (row + 0.5) / rows * height`` in the board frame.

    Raises:
        InputError: a pattern needs more markers than its dictionary has.

    """
    width, height = board.size
    columns, rows = (max(1, round(length * texels_per_meter)) for length in (width, height))
    face = np.ones((rows, columns))
    for bitmap, center, size in _prints(board):
        _stamp(face, board.size, bitmap, center, size)
    return face


def _prints(board: Board) -> list[tuple[Array, tuple[float, float], tuple[float, float]]]:
    """Bitmaps (1 paper, 0 ink) with the centre and the width and height of each, m."""
    pattern = board.pattern
    if pattern is None:
        family = cv2.aruco.getPredefinedDictionary(_FAMILIES[board.family])
        return [(_marker(family, tag.id), tag.center, (tag.size, tag.size)) for tag in board.tags]
    if isinstance(pattern, Checkerboard):
        rows, columns = np.indices((pattern.rows + 1, pattern.columns + 1))
        squares = ((rows + columns) % 2).astype(np.float64)
        size = (pattern.square * (pattern.columns + 1), pattern.square * (pattern.rows + 1))
        return [(squares, pattern.center, size)]
    if isinstance(pattern, Charuco):
        return _charuco(pattern)
    return _aprilgrid(pattern)


def _charuco(pattern: Charuco) -> list[tuple[Array, tuple[float, float], tuple[float, float]]]:
    """OpenCV's layout: black top-left square, markers numbered row by row through the white squares."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, pattern.dictionary))
    rows, columns = np.indices((pattern.rows, pattern.columns))
    squares = ((rows + columns) % 2).astype(np.float64)
    x0, y0 = pattern.center
    prints = [(squares, pattern.center, (pattern.square * pattern.columns, pattern.square * pattern.rows))]
    for number, (row, column) in enumerate(np.argwhere(squares == 1)):
        center = (
            x0 + (column + 0.5 - pattern.columns / 2) * pattern.square,
            y0 + (pattern.rows / 2 - row - 0.5) * pattern.square,
        )
        prints.append((_marker(dictionary, number), center, (pattern.marker, pattern.marker)))
    return prints


def _aprilgrid(pattern: AprilGrid) -> list[tuple[Array, tuple[float, float], tuple[float, float]]]:
    """Kalibr's layout: ids count from the bottom left along rows; black squares sit on the tags' corners."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    gap = pattern.tag_size * pattern.tag_spacing
    pitch = pattern.tag_size + gap
    x0 = pattern.center[0] - pitch * (pattern.columns - 1) / 2
    y0 = pattern.center[1] - pitch * (pattern.rows - 1) / 2
    size = (pattern.tag_size, pattern.tag_size)
    prints = []
    for number in range(pattern.columns * pattern.rows):
        row, column = divmod(number, pattern.columns)
        bitmap = _marker(family, pattern.first_id + number, border=2)
        prints.append((bitmap, (x0 + column * pitch, y0 + row * pitch), size))
    for row in range(pattern.rows + 1):
        for column in range(pattern.columns + 1):
            center = (x0 + (column - 0.5) * pitch, y0 + (row - 0.5) * pitch)
            prints.append((np.zeros((1, 1)), center, (gap, gap)))
    return prints


def _marker(dictionary: cv2.aruco.Dictionary, number: int, border: int = 1) -> Array:
    """The bitmap of a marker, one pixel a module, upright as OpenCV draws it."""
    available = len(dictionary.bytesList)
    if number >= available:
        raise InputError(f"target.pattern: needs marker {number}, but its dictionary ends at {available - 1}")
    modules = dictionary.markerSize + 2 * border
    image = cv2.aruco.generateImageMarker(dictionary, number, modules, borderBits=border)
    return np.asarray(image, dtype=np.float64) / 255


def _stamp(
    face: Array, sheet: tuple[float, float], bitmap: Array, center: tuple[float, float], size: tuple[float, float]
) -> None:
    """Prints a bitmap on the face, in place: area weights are separable, so each axis is one small matrix."""
    columns = _overlaps(face.shape[1], sheet[0], bitmap.shape[1], center[0] - size[0] / 2, size[0])
    rows = _overlaps(face.shape[0], sheet[1], bitmap.shape[0], -center[1] - size[1] / 2, size[1])
    covered = np.outer(rows.sum(axis=1), columns.sum(axis=1))
    face *= 1 - covered
    face += rows @ bitmap @ columns.T


def _overlaps(texels: int, length: float, modules: int, start: float, extent: float) -> Array:
    """(texels, modules): the fraction of each texel that each module covers, along one axis."""
    texel_edges = np.linspace(-length / 2, length / 2, texels + 1)
    module_edges = start + np.linspace(0, extent, modules + 1)
    low = np.maximum(texel_edges[:-1, None], module_edges[None, :-1])
    high = np.minimum(texel_edges[1:, None], module_edges[None, 1:])
    return np.asarray(np.maximum(high - low, 0) / (length / texels))
