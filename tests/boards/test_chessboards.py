"""Where the fast search of a checkerboard fails or errs, the searches by saddle points find the same corners."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from calgraph.boards import chessboards
from calgraph.boards.chessboards import CheckerboardFinder, take_whole
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
    x, y = np.meshgrid(0.08 * (np.arange(8) - 3.5), -0.08 * (np.arange(5) - 2.0))
    return CAMERA.project(se3.apply(POSE, np.stack([x.ravel(), y.ravel(), np.zeros(40)], axis=-1)))


def corners(image: Gray) -> Array:
    return CheckerboardFinder(PATTERN).find(image).pixels[:, 0]


def test_the_fast_search_alone_finds_the_corners(
    image: Gray, expected: Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "findChessboardCornersSB", lambda *_args, **_options: (False, None))
    np.testing.assert_allclose(corners(image), expected, atol=0.15)


def test_the_search_by_saddle_points_finds_what_the_fast_one_does_not(
    image: Gray, expected: Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "findChessboardCorners", lambda *_args, **_options: (False, None))
    np.testing.assert_allclose(corners(image), expected, atol=0.15)


@pytest.mark.parametrize("corner", [0, 12, 39])
def test_a_corner_of_the_fast_search_that_is_off_the_lattice_is_not_used(
    corner: int, image: Gray, expected: Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    displaced = np.ascontiguousarray(expected, dtype=np.float32).reshape(-1, 1, 2)
    displaced[corner, 0, 0] += 11
    monkeypatch.setattr(cv2, "findChessboardCorners", lambda *_args, **_options: (True, displaced))
    np.testing.assert_allclose(corners(image), expected, atol=0.15)


def test_the_search_by_saddle_points_starts_with_the_same_random_numbers(
    image: Gray, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = []

    def draw(*_args: object, **_options: object) -> tuple[bool, None]:
        drawn.append(cv2.randu(np.zeros(4, dtype=np.float32), np.zeros(1), np.ones(1)).tolist())
        return False, None

    monkeypatch.setattr(cv2, "findChessboardCorners", lambda *_args, **_options: (False, None))
    monkeypatch.setattr(cv2, "findChessboardCornersSB", draw)
    for _ in range(2):
        assert len(corners(image)) == 0
    first, second = np.array_split(np.array(drawn), 2)
    np.testing.assert_array_equal(first, second)


def only_by_saddles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "findChessboardCorners", lambda *_args, **_options: (False, None))


def add_glare(image: Gray) -> Gray:
    """Adds a bright spot in the middle of the board."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    spot = 120 * np.exp(-((x - 330) ** 2 + (y - 240) ** 2) / (2 * 60**2))
    return np.asarray(np.clip(image + spot, 0, 255), dtype=np.uint8)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_board_with_glare_is_found_without_normalisation(
    seed: int, render: Callable[..., Gray], expected: Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    only_by_saddles(monkeypatch)
    board, rng = Board(size=(1.0, 0.8), pattern=PATTERN), np.random.default_rng(seed)
    image = add_glare(render(board, CAMERA, POSE, rng, background=20))
    assert not cv2.findChessboardCornersSB(image, (8, 5), flags=cv2.CALIB_CB_NORMALIZE_IMAGE)[0]
    np.testing.assert_allclose(corners(image), expected, atol=0.5)


@pytest.mark.parametrize("contrast", [0.05, 0.08])
def test_a_board_of_low_contrast_is_found_with_normalisation(
    contrast: float,
    render: Callable[..., Gray],
    expected: Array,
    rng: np.random.Generator,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    only_by_saddles(monkeypatch)
    image = render(Board(size=(1.0, 0.8), pattern=PATTERN), CAMERA, POSE, rng, contrast=contrast, noise=0.5)
    assert not cv2.findChessboardCornersSB(image, (8, 5))[0]
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


@pytest.fixture
def searches(image: Gray, monkeypatch: pytest.MonkeyPatch) -> list[tuple[tuple[int, ...], int]]:
    """Shapes and flags of the searches by saddle points in an image, all of which fail."""
    tried: list[tuple[tuple[int, ...], int]] = []

    def search(gray: Gray, _shape: tuple[int, int], flags: int) -> tuple[bool, None]:
        tried.append((gray.shape, flags))
        return False, None

    only_by_saddles(monkeypatch)
    monkeypatch.setattr(cv2, "findChessboardCornersSB", search)
    corners(image)
    return tried


def test_the_first_searches_are_without_normalisation(searches: list[tuple[tuple[int, ...], int]]) -> None:
    flags = [flag for shape, flag in searches[:-1]]
    assert flags[0] == 0
    assert flags == sorted(flags)


def test_the_full_image_is_searched_last(image: Gray, searches: list[tuple[tuple[int, ...], int]]) -> None:
    assert [shape == image.shape for shape, _ in searches] == [False] * (len(searches) - 1) + [True]


def test_an_image_without_saddle_points_is_searched_once_and_reduced(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def search(gray: Gray, _shape: tuple[int, int], flags: int) -> tuple[bool, None]:
        tried.append((gray.shape, flags))
        return False, None

    monkeypatch.setattr(cv2, "findChessboardCornersSB", search)
    empty = np.full((1440, 1920), 90, dtype=np.uint8)
    cv2.rectangle(empty, (300, 300), (900, 1050), (200,), -1)
    assert len(corners(empty)) == 0
    assert tried == [((720, 960), 0)]


def test_a_board_whose_saddle_points_are_in_no_group_is_found(
    image: Gray, expected: Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    only_by_saddles(monkeypatch)
    monkeypatch.setattr(chessboards, "find_regions", lambda *_args: iter([]))
    np.testing.assert_allclose(corners(image), expected, atol=0.3)


def test_corners_that_refinement_moves_away_are_kept_as_they_were_found(
    image: Gray, expected: Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refine(_gray: Gray, start: Array, *_args: object) -> Array:
        moved = start.copy()
        moved[12] += (20, 0)
        return moved

    only_by_saddles(monkeypatch)
    monkeypatch.setattr(cv2, "cornerSubPix", refine)
    np.testing.assert_allclose(corners(image), expected, atol=0.5)


def test_saddle_points_that_are_no_lattice_are_not_used(
    image: Gray, expected: Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = expected.copy()
    wrong[12] += (20, 0)
    only_by_saddles(monkeypatch)
    search_whole_images(monkeypatch)
    monkeypatch.setattr(cv2, "findChessboardCornersSB", lambda *_args, **_options: (True, wrong[:, None]))
    monkeypatch.setattr(cv2, "cornerSubPix", lambda _gray, start, *_args: start)
    assert len(corners(image)) == 0


def search_whole_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """Corners that a test returns from a search are those in the whole image then."""
    monkeypatch.setattr(chessboards, "find_regions", lambda gray, *_args: iter([take_whole(gray)]))
