"""Corners that another program detected: assigned to the print of the board, also from behind."""

import numpy as np
import pytest

from calgraph.boards.camera import CameraDetector
from calgraph.boards.detections import BoardCorners
from calgraph.boards.printed_boards import compute_landmarks
from calgraph.config import Board, Charuco, Checkerboard, PixelNoise, Tag
from calgraph.config.settings import CameraDetectionSettings
from calgraph.errors import InputError, Rejected
from calgraph.geometry import Array, plane, se3, so3
from calgraph.rig.detection.board_views import BoardViewFinder
from calgraph.sensors import CameraModel, DetectedCorners

CHARUCO = Board(
    size=(0.3, 0.4),
    pattern=Charuco(
        kind="charuco", columns=4, rows=5, square=0.05, marker=0.04, dictionary="DICT_4X4_50", center=(0.02, -0.03)
    ),
)
CHECKERBOARD = Board(size=(0.6, 0.5), pattern=Checkerboard(kind="checkerboard", columns=6, rows=5, square=0.07))
CAMERA = CameraModel("pinhole", 640, 480, np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]), np.zeros(0))
T_CAMERA_BOARD = se3.pose(
    so3.exp(np.array([0.3, -0.2, 0.1])) @ np.diag([1.0, -1, -1]), np.array([0.05, -0.02, 1.2])
)
BEHIND = T_CAMERA_BOARD @ np.diag([-1.0, 1, -1, 1])
"""The camera looks at the back of the board."""


def opencv_points(board: Board) -> Array:
    """OpenCV's object points of all corners: from the top left, x right, y down."""
    assert isinstance(board.pattern, Charuco | Checkerboard)
    square, columns, rows = board.pattern.square, board.pattern.columns, board.pattern.rows
    if isinstance(board.pattern, Charuco):
        x, y = np.meshgrid(np.arange(1, columns), np.arange(1, rows))
    else:
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.asarray(square * np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]))


def detect(
    board: Board, T: Array, keep: slice = slice(None), shift: tuple[float, float] = (0.0, 0.0)
) -> BoardCorners | Rejected:
    """What the camera detects in corners that it sees of a board with the pose ``T``."""
    pixels = CAMERA.project(se3.apply(T, compute_landmarks(board).corners[:, 0]))[keep] + np.array(shift)
    message = DetectedCorners(1.0, "", opencv_points(board)[keep], pixels)
    found = CameraDetector([board], CAMERA, PixelNoise(), settings=CameraDetectionSettings()).find([message])
    return found if isinstance(found, Rejected) else found[0]


@pytest.mark.parametrize("board", [CHARUCO, CHECKERBOARD], ids=["charuco", "checkerboard"])
@pytest.mark.parametrize("T", [T_CAMERA_BOARD, BEHIND], ids=["front", "behind"])
def test_positions_on_the_board_are_those_of_its_print(board: Board, T: Array) -> None:
    found = detect(board, T, slice(2, None, 2))
    assert isinstance(found, BoardCorners)
    np.testing.assert_allclose(found.T_camera_board, T, atol=1e-6)
    np.testing.assert_allclose(found.plane, plane.from_pose(T), atol=1e-6)
    np.testing.assert_allclose(CAMERA.project(se3.apply(T, found.corners_board)), found.pixels, atol=1e-3)


def test_a_view_from_behind_has_the_covariance_of_its_plane_about_its_normal() -> None:
    """Planes are compared by their front; the deviations that covariance predicts are those of the pose."""
    near = se3.pose(BEHIND[:3, :3], 0.4 * BEHIND[:3, 3])
    found = detect(CHARUCO, near, slice(0, 6))
    assert isinstance(found, BoardCorners)
    rng = np.random.default_rng(0)
    L = np.linalg.cholesky(found.covariance)
    normals = [se3.retract(found.T_camera_board, L @ rng.normal(size=6))[:3, 2] for _ in range(4000)]
    basis = plane.tangent_basis(found.plane[:3])
    scatter = np.cov((np.array(normals) @ basis).T)
    np.testing.assert_allclose(scatter, found.plane_covariance[:2, :2], rtol=0.1, atol=0.05 * scatter.max())


def test_corners_of_another_square_are_an_error() -> None:
    message = DetectedCorners(1.0, "", opencv_points(CHARUCO) * 1.08, np.ones((12, 2)))
    with pytest.raises(
        InputError, match=r"corner detected at \(0\.162, 0\.216, 0\) m .* 20\.0 mm from the nearest"
    ):
        CameraDetector([CHARUCO], CAMERA, PixelNoise(), settings=CameraDetectionSettings()).find([message])


def test_corners_outside_of_the_image_are_an_error() -> None:
    with pytest.raises(InputError, match="outside of images of 640x480, which the intrinsics are for"):
        detect(CHARUCO, T_CAMERA_BOARD, shift=(400.0, 0.0))


def test_corners_of_boards_with_tags_are_an_error() -> None:
    board = Board(size=(1, 1), tags=(Tag(id=0, size=0.3),))
    with pytest.raises(InputError, match="detected corners are of a checkerboard or a ChArUco board"):
        CameraDetector([board], CAMERA, PixelNoise(), settings=CameraDetectionSettings()).find(
            [DetectedCorners(1, "", np.zeros((1, 3)), np.ones((1, 2)))]
        )


@pytest.mark.parametrize(
    ("keep", "reason"),
    [(slice(0, 0), "no corner of the board was detected"), (slice(0, 3), "do not determine a pose: too few")],
)
def test_too_few_corners_are_rejected_with_the_reason(keep: slice, reason: str) -> None:
    found = detect(CHARUCO, T_CAMERA_BOARD, keep)
    assert isinstance(found, Rejected)
    assert reason in found.reason


def test_intrinsics_are_not_estimated_from_corners() -> None:
    finder = BoardViewFinder([CHARUCO], PixelNoise(), settings=CameraDetectionSettings())
    with pytest.raises(InputError, match="do not state the size of the images: state the intrinsics"):
        finder.find([DetectedCorners(1, "", np.zeros((1, 3)), np.ones((1, 2)))])


def test_corners_of_a_board_that_moves_within_a_capture_are_rejected() -> None:
    points = opencv_points(CHARUCO)
    pixels = CAMERA.project(se3.apply(T_CAMERA_BOARD, compute_landmarks(CHARUCO).corners[:, 0]))
    detector = CameraDetector([CHARUCO], CAMERA, PixelNoise(), settings=CameraDetectionSettings())
    still = [DetectedCorners(t, "", points, pixels + 0.1 * t) for t in (0.0, 1.0)]
    moved = [DetectedCorners(t, "", points, pixels + 20.0 * t) for t in (0.0, 1.0)]
    assert not isinstance(detector.find(still), Rejected)
    found = detector.find(moved)
    assert isinstance(found, Rejected)
    assert "board moved between images" in found.reason


def test_images_without_corners_do_not_count() -> None:
    points = opencv_points(CHECKERBOARD)
    pixels = CAMERA.project(se3.apply(T_CAMERA_BOARD, compute_landmarks(CHECKERBOARD).corners[:, 0]))
    finder = CameraDetector([CHECKERBOARD], CAMERA, PixelNoise(), settings=CameraDetectionSettings())
    nothing = DetectedCorners(0.0, "", points[:0], pixels[:0])
    found = finder.find([nothing, DetectedCorners(1.0, "", points, pixels), nothing])
    assert not isinstance(found, Rejected)
    assert finder.find([nothing, nothing]) == Rejected("no corner of the board was detected")
