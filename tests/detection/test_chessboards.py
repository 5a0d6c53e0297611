"""Where the fast search of a checkerboard fails or errs, the slower one finds the same corners."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from calgraph.config import Board, Checkerboard
from calgraph.detection.chessboards import CheckerboardFinder
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
