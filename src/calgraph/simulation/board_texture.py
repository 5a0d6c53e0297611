"""The printed face of a board as an image, every texel the exact mean of the print over its area."""

import numpy as np

from calgraph.config import Board, PrintedBitmap, printed_bitmaps
from calgraph.geometry import Array


def board_texture(board: Board, texels_per_meter: float) -> Array:
    """The face of a board as a reader sees it, reflectance 0 (ink) to 1 (paper).

    Args:
        board: what is printed where.
        texels_per_meter: resolution; the sheet's edges fall on texel edges to the nearest whole texel.

    Returns:
        (rows, columns); texel (row, column) is centred at ``x = (column + 0.5) / columns * width - width / 2``
        and ``y = height / 2 - (row + 0.5) / rows * height`` in the board frame.

    """
    width, height = board.size
    columns, rows = (max(1, round(length * texels_per_meter)) for length in (width, height))
    face = np.ones((rows, columns))
    for one in printed_bitmaps(board):
        _stamp(face, board.size, one)
    return face


def _stamp(face: Array, sheet: tuple[float, float], one: PrintedBitmap) -> None:
    """Prints a bitmap on the face, in place: area weights are separable, so each axis is one small matrix."""
    (rows, columns), (x, y), (width, height) = one.bitmap.shape, one.center, one.size
    across = _overlaps(face.shape[1], sheet[0], columns, x - width / 2, width)
    down = _overlaps(face.shape[0], sheet[1], rows, -y - height / 2, height)
    face *= 1 - np.outer(down.sum(axis=1), across.sum(axis=1))
    face += down @ one.bitmap @ across.T


def _overlaps(texels: int, length: float, modules: int, start: float, extent: float) -> Array:
    """(texels, modules): the fraction of each texel that each module covers, along one axis."""
    texel_edges = np.linspace(-length / 2, length / 2, texels + 1)
    module_edges = start + np.linspace(0, extent, modules + 1)
    low = np.maximum(texel_edges[:-1, None], module_edges[None, :-1])
    high = np.minimum(texel_edges[1:, None], module_edges[None, 1:])
    return np.asarray(np.maximum(high - low, 0) / (length / texels))
