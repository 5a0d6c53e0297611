"""Whether cameras can distinguish the boards of one rig by their prints."""

from collections.abc import Sequence

import numpy as np
from pydantic_core import PydanticCustomError

from calgraph.config.board_print import PrintedBitmap, printed_bitmaps
from calgraph.config.target import AprilGrid, Board, Charuco, Checkerboard
from calgraph.io.strict_model import invalid


def check_boards_distinguishable(boards: Sequence[Board]) -> None:
    """Rejects boards that a camera cannot distinguish.

    Tags and markers are identified by their bitmaps: ids may repeat in different families. Checkerboards are
    identified by their numbers of corners alone, and are also detected in ChArUco boards.

    Raises:
        PydanticCustomError: to be raised within a validator of a model with the boards under ``target``.
    """
    board_of_marker: dict[tuple[int, bytes], int] = {}
    board_of_shape: dict[frozenset[int], int] = {}
    for i, board in enumerate(boards):
        for bitmap in printed_bitmaps(board):
            if bitmap.number is None:
                continue
            for border in _detectable_borders(board):
                other = board_of_marker.setdefault((border, _marker_code(board, bitmap)), i)
                if other != i:
                    raise _duplicate_marker(i, board, bitmap, other)
        if isinstance(board.pattern, Checkerboard):
            shape = frozenset((board.pattern.columns, board.pattern.rows))
            other = board_of_shape.setdefault(shape, i)
            if other != i:
                raise _ambiguous_pattern(i, other, "checkerboards differ by columns and rows only")
    chessboards = {type(board.pattern): i for i, board in reversed(list(enumerate(boards)))}
    if Checkerboard in chessboards and Charuco in chessboards:
        i, other = chessboards[Checkerboard], chessboards[Charuco]
        raise _ambiguous_pattern(i, other, "its corners are those of a checkerboard, too")


def _ambiguous_pattern(i: int, other: int, reason: str) -> PydanticCustomError:
    return invalid(f"target[{i}].pattern", f"cannot be distinguished from that of target[{other}]: {reason}")


def _duplicate_marker(i: int, board: Board, bitmap: PrintedBitmap, other: int) -> PydanticCustomError:
    if board.pattern:
        return invalid(
            f"target[{i}].pattern",
            f"has a square that is also on target[{other}], its number {bitmap.number}; choose another first_id",
        )
    tag = [tag.id for tag in board.tags].index(bitmap.number or 0)
    return invalid(f"target[{i}].tags[{tag}].id", f"is also on target[{other}], got {bitmap.number}")


def _detectable_borders(board: Board) -> tuple[int, ...]:
    """Border widths, modules, with which its markers are detected: the ChArUco detector also reads AprilGrids."""
    match board.pattern:
        case Charuco():
            return 1, 2
        case AprilGrid():
            return (2,)
        case _:
            return (1,)


def _marker_code(board: Board, printed: PrintedBitmap) -> bytes:
    """The bits within a marker's border: equal for rotated copies, different for any other marker."""
    border = 2 if isinstance(board.pattern, AprilGrid) else 1
    bits = printed.bitmap[border:-border, border:-border]
    return min(np.ascontiguousarray(np.rot90(bits, k)).tobytes() for k in range(4))
