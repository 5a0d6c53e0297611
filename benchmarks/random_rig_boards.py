"""Random boards for random_rigs.py."""

import numpy as np

from calgraph.config import AprilGrid, Board, Charuco, Checkerboard, Tag

KINDS = ("one tag", "four tags", "checkerboard", "charuco", "aprilgrid")


def draw_boards(rng: np.random.Generator, cameras: bool) -> tuple[tuple[Board, ...], str]:
    """One to three boards, and a label. Without cameras a board may be blank."""
    if not cameras and rng.random() < 0.5:
        return (Board(size=_draw_size(rng)),), "blank"
    kind = KINDS[rng.choice(len(KINDS), p=[0.2, 0.3, 0.2, 0.15, 0.15])]
    count = int(rng.choice([1, 2, 3], p=[0.85, 0.1, 0.05]))
    boards = tuple(_draw_board(rng, kind, _draw_size(rng), i) for i in range(count))
    while len({_shape(board, i) for i, board in enumerate(boards)}) < count:
        boards = tuple(_draw_board(rng, kind, _draw_size(rng), i) for i in range(count))
    return boards, kind if count == 1 else "several"


def smallest_feature(board: Board) -> float:
    """Edge of the smallest tag, marker or square of a board, m; 0 without a print."""
    match board.pattern:
        case None:
            return min((tag.size for tag in board.tags), default=0.0)
        case Checkerboard():
            return 2.5 * board.pattern.square
        case Charuco():
            return board.pattern.marker
        case AprilGrid():
            return board.pattern.tag_size


def _shape(board: Board, index: int) -> frozenset[int]:
    """What distinguishes a board from others: a checkerboard has only its numbers of corners."""
    pattern = board.pattern
    return frozenset((pattern.columns, pattern.rows) if isinstance(pattern, Checkerboard) else (-1 - index,))


def _draw_size(rng: np.random.Generator) -> tuple[float, float]:
    width = float(np.exp(rng.uniform(np.log(0.4), np.log(1.5))))
    ratio = 1.0 if rng.random() < 0.15 else float(rng.uniform(0.6, 1.4))
    return round(width, 3), round(float(np.clip(width * ratio, 0.4, 1.5)), 3)


def _draw_board(rng: np.random.Generator, kind: str, size: tuple[float, float], index: int) -> Board:
    """A board whose print, tags from 40 ``index`` on, differs from that of others."""
    width, height = size
    short = min(size)
    first = 40 * index
    match kind:
        case "one tag":
            edge = round(float(rng.uniform(0.5, 0.8)) * short, 3)
            return Board(size=size, tags=(Tag(id=first, size=edge),))
        case "four tags":
            edge = round(float(rng.uniform(0.22, 0.38)) * short, 3)
            x, y = 0.25 * width, 0.25 * height
            centers = ((-x, y), (x, y), (-x, -y), (x, -y))
            return Board(
                size=size, tags=tuple(Tag(id=first + i, size=edge, center=at) for i, at in enumerate(centers))
            )
        case "checkerboard":
            columns, rows = int(rng.integers(4, 9)) + index, int(rng.integers(4, 8))
            columns = columns + 1 if columns == rows and rng.random() < 0.5 else columns
            square = round(0.98 * min(width / (columns + 1), height / (rows + 1)), 4)
            return Board(
                size=size, pattern=Checkerboard(kind="checkerboard", columns=columns, rows=rows, square=square)
            )
        case "charuco":
            columns, rows = int(rng.integers(4, 8)), int(rng.integers(4, 7))
            square = round(0.98 * min(width / columns, height / rows), 4)
            return Board(
                size=size,
                pattern=Charuco(
                    kind="charuco",
                    columns=columns,
                    rows=rows,
                    square=square,
                    marker=round(0.75 * square, 4),
                    dictionary="DICT_5X5_250",
                    first_id=first,
                ),
            )
        case _:
            columns, rows = int(rng.integers(2, 6)), int(rng.integers(2, 5))
            spacing = 0.3
            edge = min(width / (columns * (1 + spacing) + spacing), height / (rows * (1 + spacing) + spacing))
            return Board(
                size=size,
                pattern=AprilGrid(
                    kind="aprilgrid",
                    columns=columns,
                    rows=rows,
                    tag_size=round(0.98 * edge, 4),
                    tag_spacing=spacing,
                    first_id=first,
                ),
            )
