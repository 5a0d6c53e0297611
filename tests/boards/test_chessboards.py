"""Corners of whole checkerboards are found, whatever the light; other things are no board."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from calgraph.boards.chessboards import CheckerboardFinder
from calgraph.config import Board, Checkerboard
from calgraph.geometry import Array, se3, so3
from calgraph.sensors import CameraModel

Gray = np.ndarray[tuple[int, int], np.dtype[np.uint8]]
PATTERN = Checkerboard(kind="checkerboard", columns=8, rows=5, square=0.08)
CAMERA = CameraModel("pinhole", 640, 480, np.array([[480.0, 0, 319.5], [0, 480, 239.5], [0, 0, 1]]), np.zeros(0))
POSE = se3.pose(so3.exp(np.array([0.2, 0.3, 0.1])) @ np.diag([1.0, -1, -1]), np.array([0.05, -0.02, 1.6]))


@pytest.fixture
def image(render: Callable[..., Gray], rng: np.random.Generator) -> Gray:
    return render(Board(size=(1.0, 0.8), pattern=PATTERN), CAMERA, POSE, rng)


@pytest.fixture
def expected() -> Array:
    """(40, 2) pixels of the inner corners, row by row from the top left."""
    return project_corners(POSE)


def project_corners(pose: Array) -> Array:
    x, y = np.meshgrid(0.08 * (np.arange(8) - 3.5), -0.08 * (np.arange(5) - 2.0))
    return CAMERA.project(se3.apply(pose, np.stack([x.ravel(), y.ravel(), np.zeros(40)], axis=-1)))


def corners(image: Gray) -> Array:
    return CheckerboardFinder(PATTERN).find(image).pixels[:, 0]


def test_corners_are_found_where_they_are(image: Gray, expected: Array) -> None:
    np.testing.assert_allclose(corners(image), expected, atol=0.15)


@pytest.mark.parametrize("sigma", [1.5, 3.0, 4.5])
def test_corners_of_a_board_out_of_focus_are_found(sigma: float, image: Gray, expected: Array) -> None:
    blurred = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.uint8)
    np.testing.assert_allclose(corners(blurred), expected, atol=0.3)


def add_glare(image: Gray) -> Gray:
    """Adds a bright spot in the middle of the board."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    spot = 120 * np.exp(-((x - 330) ** 2 + (y - 240) ** 2) / (2 * 60**2))
    return np.asarray(np.clip(image + spot, 0, 255), dtype=np.uint8)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_board_with_glare_is_found(seed: int, render: Callable[..., Gray], expected: Array) -> None:
    board, rng = Board(size=(1.0, 0.8), pattern=PATTERN), np.random.default_rng(seed)
    image = add_glare(render(board, CAMERA, POSE, rng, background=20))
    np.testing.assert_allclose(corners(image), expected, atol=0.5)


@pytest.mark.parametrize("contrast", [0.05, 0.08])
def test_a_board_of_low_contrast_is_found(
    contrast: float, render: Callable[..., Gray], expected: Array, rng: np.random.Generator
) -> None:
    image = render(Board(size=(1.0, 0.8), pattern=PATTERN), CAMERA, POSE, rng, contrast=contrast, noise=0.5)
    np.testing.assert_allclose(corners(image), expected, atol=0.3)


def test_small_squares_in_a_large_image_are_found(render: Callable[..., Gray], rng: np.random.Generator) -> None:
    pattern = Checkerboard(kind="checkerboard", columns=28, rows=17, square=0.01)
    K = np.array([[3200.0, 0, 1999.5], [0, 3200, 1499.5], [0, 0, 1]])
    camera = CameraModel("pinhole", 4000, 3000, K, np.zeros(0))
    pose = se3.pose(POSE[:3, :3], np.array([0.1, -0.05, 3.4]))
    image = render(Board(size=(0.32, 0.21), pattern=pattern), camera, pose, rng)
    x, y = np.meshgrid(0.01 * (np.arange(28) - 13.5), -0.01 * (np.arange(17) - 8.0))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    found = CheckerboardFinder(pattern).find(image).pixels[:, 0]
    np.testing.assert_allclose(found, camera.project(se3.apply(pose, points)), atol=0.3)


def test_corners_that_glare_hides_are_left_out(image: Gray, expected: Array) -> None:
    hidden = image.copy()
    for corner in (9, 30):
        u, v = np.rint(expected[corner]).astype(int)
        cv2.circle(hidden, (int(u), int(v)), 6, (255,), -1)
    found = CheckerboardFinder(PATTERN).find(hidden)
    assert found.ids.tolist() == [i for i in range(40) if i not in (9, 30)]
    np.testing.assert_allclose(found.pixels[:, 0], expected[found.ids], atol=0.15)


@pytest.mark.parametrize("angle", [0.0, 0.8])
def test_a_board_seen_at_65_degrees_is_found(
    angle: float, render: Callable[..., Gray], rng: np.random.Generator
) -> None:
    axis = np.array([np.cos(angle), np.sin(angle), 0.0])
    pose = se3.pose(so3.exp(np.radians(65) * axis) @ np.diag([1.0, -1, -1]), np.array([0.0, 0.0, 1.2]))
    image = render(Board(size=(1.0, 0.8), pattern=PATTERN), CAMERA, pose, rng)
    np.testing.assert_allclose(corners(image), project_corners(pose), atol=0.3)


@pytest.mark.parametrize(("columns", "rows"), [(7, 5), (8, 4), (9, 5), (8, 6), (10, 4)])
def test_a_board_of_another_shape_is_not_found(
    columns: int, rows: int, render: Callable[..., Gray], rng: np.random.Generator
) -> None:
    other = Checkerboard(kind="checkerboard", columns=columns, rows=rows, square=0.07)
    image = render(Board(size=(1.0, 0.8), pattern=other), CAMERA, POSE, rng)
    assert len(corners(image)) == 0


@pytest.mark.parametrize("hidden", [(0, 0, 280, 480), (0, 0, 640, 210)])
def test_a_board_that_is_partly_hidden_is_not_found(hidden: tuple[int, int, int, int], image: Gray) -> None:
    left, top, right, bottom = hidden
    covered = image.copy()
    covered[top:bottom, left:right] = 120
    assert len(corners(covered)) == 0


def draw_squares(columns: int, rows: int, behind: int, pitch: int = 40) -> Gray:
    """A board with inner corners from (139.5, 139.5) px, without a margin, in front of a wall."""
    squares = np.where(np.indices((rows + 1, columns + 1)).sum(axis=0) % 2, 220, 20)
    image = np.full((480, 640), behind, dtype=np.uint8)
    image[100 : 100 + pitch * (rows + 1), 100 : 100 + pitch * (columns + 1)] = np.kron(
        squares, np.ones((pitch,) * 2)
    )
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), dtype=np.uint8)


@pytest.mark.parametrize("behind", [20, 60, 120, 220])
@pytest.mark.parametrize(("columns", "rows"), [(2, 2), (7, 2), (2, 5), (3, 3), (7, 5), (6, 6)])
def test_corners_of_the_rim_are_no_inner_ones(columns: int, rows: int, behind: int) -> None:
    pattern = Checkerboard(kind="checkerboard", columns=columns, rows=rows, square=0.08)
    found = CheckerboardFinder(pattern).find(draw_squares(columns, rows, behind)).pixels[:, 0]
    x, y = np.meshgrid(139.5 + 40 * np.arange(columns), 139.5 + 40 * np.arange(rows))
    np.testing.assert_allclose(found, np.column_stack([x.ravel(), y.ravel()]), atol=0.1)


@pytest.mark.parametrize("behind", [60, 120])
@pytest.mark.parametrize("cut", [slice(0, 410), slice(160, 640)])
def test_a_board_cut_off_by_the_image_is_not_continued_beyond_its_rim(behind: int, cut: slice) -> None:
    assert len(corners(draw_squares(8, 5, behind)[:, cut])) == 0


def test_holes_of_a_sheet_are_no_board() -> None:
    sheet = np.full((480, 640), 120, dtype=np.uint8)
    for row in range(22):
        for column in range(30):
            cv2.circle(sheet, (10 + 20 * column + 10 * (row % 2), 10 + 20 * row), 7, (20,), -1)
    for columns, rows in ((3, 3), (4, 3), (7, 5)):
        pattern = Checkerboard(kind="checkerboard", columns=columns, rows=rows, square=0.08)
        assert len(CheckerboardFinder(pattern).find(sheet)) == 0


def test_an_image_of_few_pixels_has_no_board() -> None:
    assert len(corners(np.full((2, 3), 90, dtype=np.uint8))) == 0


def test_a_square_that_stands_on_a_blank_wall_is_no_board() -> None:
    empty = np.full((1440, 1920), 90, dtype=np.uint8)
    cv2.rectangle(empty, (300, 300), (900, 1050), (200,), -1)
    assert len(corners(empty)) == 0


def test_corners_that_refinement_moves_away_are_left_out(
    image: Gray, expected: Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    refine_all = cv2.cornerSubPix

    def refine(gray: Gray, start: Array, *args: Any) -> Array:
        moved = np.array(refine_all(gray, start, *args))
        moved[12] += (20, 0)
        return np.asarray(moved, dtype=np.float64)

    monkeypatch.setattr(cv2, "cornerSubPix", refine)
    found = CheckerboardFinder(PATTERN).find(image)
    assert len(found) == 39
    np.testing.assert_allclose(found.pixels[:, 0], expected[found.ids], atol=0.15)


def test_where_refinement_fails_at_most_corners_they_stay_where_they_were_found(
    image: Gray, expected: Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "cornerSubPix", lambda _gray, start, *_: start + 20)
    found = CheckerboardFinder(PATTERN).find(image)
    assert len(found) == 40
    np.testing.assert_allclose(found.pixels[:, 0], expected, atol=1.5)  # in an image of a quarter of the size
