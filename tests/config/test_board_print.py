"""What is printed where on a sheet."""

import numpy as np
import pytest

from calgraph.config import AprilGrid, Board, Charuco, Checkerboard, Tag, black_rectangles, printed_bitmaps
from calgraph.geometry import Array

BOARDS = {
    "tags": Board(size=(1, 0.8), tags=(Tag(id=0, size=0.2, center=(0.1, -0.2)), Tag(id=9, size=0.1))),
    "checkerboard": Board(size=(1, 0.8), pattern=Checkerboard(kind="checkerboard", columns=7, rows=5, square=0.1)),
    "charuco": Board(
        size=(1, 0.8),
        pattern=Charuco(kind="charuco", columns=8, rows=6, square=0.1, marker=0.07, dictionary="DICT_5X5_100"),
    ),
    "aprilgrid": Board(
        size=(1, 0.8), pattern=AprilGrid(kind="aprilgrid", columns=4, rows=3, tag_size=0.12, tag_spacing=0.3)
    ),
}


def area(rectangles: Array) -> float:
    return float(np.prod(rectangles[:, 2:] - rectangles[:, :2], axis=1).sum())


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS.keys())
def test_ink_is_as_much_as_the_bitmaps_have(board: Board) -> None:
    blank = sum(float((1 - one.bitmap).mean() * np.prod(one.size)) for one in printed_bitmaps(board))
    assert area(black_rectangles(board)) == pytest.approx(blank)


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS.keys())
def test_no_two_pieces_of_ink_overlap(board: Board) -> None:
    r = black_rectangles(board)
    low, high = np.maximum(r[:, None, :2], r[None, :, :2]), np.minimum(r[:, None, 2:], r[None, :, 2:])
    common = np.prod(np.clip(high - low, 0, None), axis=-1)
    assert common[~np.eye(len(r), dtype=bool)].max() < 1e-12


def test_black_rectangles_end_at_the_edge_of_the_board() -> None:
    pattern = Checkerboard(kind="checkerboard", columns=7, rows=5, square=0.1)
    cropped = Board(size=(0.7, 0.5), pattern=pattern)
    r = black_rectangles(cropped)
    assert (r.min(axis=0)[:2].tolist(), r.max(axis=0)[2:].tolist()) == ([-0.35, -0.25], [0.35, 0.25])


def test_the_black_border_of_a_tag_has_its_size() -> None:
    r = black_rectangles(Board(size=(1, 0.8), tags=(Tag(id=3, size=0.16, center=(0.2, 0.1)),)))
    top = r[r[:, 3] > 0.18 - 1e-9]
    np.testing.assert_allclose(top, [[0.12, 0.16, 0.28, 0.18]])


def test_markers_are_numbered_from_the_first() -> None:
    pattern = Charuco(
        kind="charuco", columns=4, rows=3, square=0.1, marker=0.07, dictionary="DICT_5X5_100", first_id=20
    )
    numbers = [
        one.number for one in printed_bitmaps(Board(size=(0.5, 0.4), pattern=pattern)) if one.number is not None
    ]
    assert numbers == list(range(20, 26))


def test_a_bare_board_has_no_ink() -> None:
    assert black_rectangles(Board(size=(1, 1))).shape == (0, 4)
