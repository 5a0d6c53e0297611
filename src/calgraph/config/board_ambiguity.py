"""Whether several boards of one rig can be told apart by what is printed on them."""

from collections.abc import Sequence

import numpy as np
from pydantic_core import PydanticCustomError

from calgraph.config.board_print import PrintedBitmap, printed_bitmaps
from calgraph.config.strict_model import invalid
from calgraph.config.target import AprilGrid, Board, Charuco, Checkerboard


def check_boards_distinguishable(boards: Sequence[Board]) -> None:
    """Refuses boards that cameras would take for each other.

    Tags and markers are known by their squares: numbers may be the same in different families. Checkerboards are
    known by their numbers of corners alone, and are found in ChArUco boards, too.

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
    return invalid(f"target[{i}].pattern", f"cannot be told from that of target[{other}]: {reason}")


def _duplicate_marker(i: int, board: Board, bitmap: PrintedBitmap, other: int) -> PydanticCustomError:
    if board.pattern:
        return invalid(
            f"target[{i}].pattern",
            f"has a square that is also on target[{other}], its number {bitmap.number}; choose another first_id",
        )
    tag = [tag.id for tag in board.tags].index(bitmap.number or 0)
    return invalid(f"target[{i}].tags[{tag}].id", f"is also on target[{other}], got {bitmap.number}")


def _detectable_borders(board: Board) -> tuple[int, ...]:
    """Which widths of borders its squares may have to the finder: that of ChArUco boards reads AprilGrids, too."""
    match board.pattern:
        case Charuco():
            return 1, 2
        case AprilGrid():
            return (2,)
        case _:
            return (1,)


def _marker_code(board: Board, printed: PrintedBitmap) -> bytes:
    """What is within a square's border: the same if it is turned, different for any other."""
    border = 2 if isinstance(board.pattern, AprilGrid) else 1
    bits = printed.bitmap[border:-border, border:-border]
    return min(np.ascontiguousarray(np.rot90(bits, k)).tobytes() for k in range(4))
