"""Where each pattern's corners are printed."""

import numpy as np
import pytest

from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import AprilGrid, Board, Charuco, Checkerboard, Tag

CHECKERBOARD = Checkerboard(kind="checkerboard", columns=7, rows=5, square=0.1, center=(0.02, -0.01))
CHARUCO = Charuco(kind="charuco", columns=8, rows=6, square=0.1, marker=0.075, dictionary="DICT_5X5_100")
APRILGRID = AprilGrid(kind="aprilgrid", columns=6, rows=4, tag_size=0.1, tag_spacing=0.3, first_id=12)


def test_tag_corners_go_clockwise_from_its_top_left() -> None:
    board = Board(size=(1, 0.8), tags=(Tag(id=3, size=0.2), Tag(id=9, size=0.1, center=(0.3, 0.2))))
    expected = [[0.25, 0.25, 0], [0.35, 0.25, 0], [0.35, 0.15, 0], [0.25, 0.15, 0]]
    np.testing.assert_allclose(compute_landmarks(board).corners_of(np.array([9]))[0], expected, atol=1e-15)


def test_checkerboard_corners_start_at_the_top_left() -> None:
    corners = compute_landmarks(Board(size=(1, 1), pattern=CHECKERBOARD)).corners[:, 0]
    np.testing.assert_allclose(
        corners[[0, 1, 7]], [[-0.28, 0.19, 0], [-0.18, 0.19, 0], [-0.28, 0.09, 0]], atol=1e-15
    )


@pytest.mark.parametrize("pattern", [CHARUCO, APRILGRID], ids=["charuco", "aprilgrid"])
def test_pattern_is_centred_on_the_board(pattern: Charuco | AprilGrid) -> None:
    corners = compute_landmarks(Board(size=(1, 1), pattern=pattern)).corners.reshape(-1, 3)
    np.testing.assert_allclose(corners.min(axis=0) + corners.max(axis=0), 0, atol=1e-15)


def test_charuco_has_the_inner_corners_only() -> None:
    assert len(compute_landmarks(Board(size=(1, 1), pattern=CHARUCO)).ids) == 7 * 5


def test_kalibr_numbers_its_tags_from_the_bottom_left() -> None:
    marks = compute_landmarks(Board(size=(1, 1), pattern=APRILGRID))
    centers = marks.corners_of(np.array([12, 13, 18])).mean(axis=1)
    np.testing.assert_allclose(
        centers, [[-0.325, -0.195, 0], [-0.195, -0.195, 0], [-0.325, -0.065, 0]], atol=1e-12
    )


def test_a_bare_board_has_no_marks() -> None:
    assert compute_landmarks(Board(size=(1, 1))).corners.shape == (0, 4, 3)
