"""Whether several boards of one rig can be told apart by what is printed on them."""

from collections.abc import Sequence

import numpy as np
from pydantic_core import PydanticCustomError

from calgraph.config.board_print import Print, prints
from calgraph.config.strict_model import wrong
from calgraph.config.target import AprilGrid, Board, Charuco, Checkerboard


def check_told_apart(boards: Sequence[Board]) -> None:
    """Refuses boards that cameras would take for each other.

    Tags and markers are known by their squares: numbers may be the same in different families. Checkerboards are
    known by their numbers of corners alone, and are found in ChArUco boards, too.

    Raises:
        PydanticCustomError: to be raised within a validator of a model with the boards under ``target``.

    """
    owners: dict[tuple[int, bytes], int] = {}
    shapes: dict[frozenset[int], int] = {}
    for i, board in enumerate(boards):
        for one in prints(board):
            if one.number is None:
                continue
            for border in _borders_read(board):
                other = owners.setdefault((border, _code(board, one)), i)
                if other != i:
                    raise _shared(i, board, one, other)
        if isinstance(board.pattern, Checkerboard):
            shape = frozenset((board.pattern.columns, board.pattern.rows))
            other = shapes.setdefault(shape, i)
            if other != i:
                raise _alike(i, other, "checkerboards differ by columns and rows only")
    chessboards = {type(board.pattern): i for i, board in reversed(list(enumerate(boards)))}
    if Checkerboard in chessboards and Charuco in chessboards:
        i, other = chessboards[Checkerboard], chessboards[Charuco]
        raise _alike(i, other, "its corners are those of a checkerboard, too")


def _alike(i: int, other: int, reason: str) -> PydanticCustomError:
    return wrong(f"target[{i}].pattern", f"cannot be told from that of target[{other}]: {reason}")


def _shared(i: int, board: Board, one: Print, other: int) -> PydanticCustomError:
    if board.pattern:
        return wrong(
            f"target[{i}].pattern",
            f"has a square that is also on target[{other}], its number {one.number}; choose another first_id",
        )
    tag = [tag.id for tag in board.tags].index(one.number or 0)
    return wrong(f"target[{i}].tags[{tag}].id", f"is also on target[{other}], got {one.number}")


def _borders_read(board: Board) -> tuple[int, ...]:
    """Which widths of borders its squares may have to the finder: that of ChArUco boards reads AprilGrids, too."""
    match board.pattern:
        case Charuco():
            return 1, 2
        case AprilGrid():
            return (2,)
        case _:
            return (1,)


def _code(board: Board, one: Print) -> bytes:
    """What is within a square's border: the same if it is turned, different for any other."""
    border = 2 if isinstance(board.pattern, AprilGrid) else 1
    bits = one.bitmap[border:-border, border:-border]
    return min(np.ascontiguousarray(np.rot90(bits, k)).tobytes() for k in range(4))
