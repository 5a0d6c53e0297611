"""The printed face of a board as an image; each texel is the exact mean of the print over its area."""

import numpy as np

from calgraph.config import Board, PrintedBitmap, printed_bitmaps
from calgraph.geometry import Array


def render_board_texture(board: Board, texels_per_meter: float) -> Array:
    """Renders the face of a board, upright for a reader: reflectance 0 (ink) to 1 (paper).

    Args:
        board: its print.
        texels_per_meter: resolution; the board's edges fall on texel edges to the nearest whole texel.

    Returns:
        (rows, columns); texel (row, column) is centred at ``x = (column + 0.5) / columns * width - width / 2``
        and ``y = height / 2 - (row + 0.5) / rows * height`` in the board frame.
    """
    width, height = board.size
    columns, rows = (max(1, round(length * texels_per_meter)) for length in (width, height))
    face = np.ones((rows, columns))
    for one in printed_bitmaps(board):
        _draw_print(face, board.size, one)
    return 1 - face if board.inverted else face


def _draw_print(face: Array, size: tuple[float, float], print_: PrintedBitmap) -> None:
    """Draws a bitmap on the face, in place: area weights are separable, so each axis is one small matrix."""
    (rows, columns), (x, y), (width, height) = print_.bitmap.shape, print_.center, print_.size
    across = _overlap_weights(face.shape[1], size[0], columns, x - width / 2, width)
    down = _overlap_weights(face.shape[0], size[1], rows, -y - height / 2, height)
    face *= 1 - np.outer(down.sum(axis=1), across.sum(axis=1))
    face += down @ print_.bitmap @ across.T


def _overlap_weights(texels: int, length: float, modules: int, start: float, extent: float) -> Array:
    """(texels, modules): the fraction of each texel that each module covers, along one axis."""
    texel_edges = np.linspace(-length / 2, length / 2, texels + 1)
    module_edges = start + np.linspace(0, extent, modules + 1)
    low = np.maximum(texel_edges[:-1, None], module_edges[None, :-1])
    high = np.minimum(texel_edges[1:, None], module_edges[None, 1:])
    return np.asarray(np.maximum(high - low, 0) / (length / texels))
