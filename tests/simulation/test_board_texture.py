import cv2
import numpy as np
import pytest

from calgraph.config import AprilGrid, Board, Charuco, Checkerboard, Tag
from calgraph.simulation.camera_render import render_board_texture


def to_image(face: np.ndarray) -> np.ndarray:
    return (255 * face).round().astype(np.uint8)


def test_tag_is_upright_and_where_it_is_stated() -> None:
    board = Board(size=(1.0, 0.8), tags=(Tag(id=7, size=0.24, center=(-0.2, 0.1)),))
    image = to_image(render_board_texture(board, 1000))
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
    assert np.ravel(ids).tolist() == [7]
    # Texels: x right of the left edge, y below the top edge; top left, top right, bottom right, bottom left.
    expected = [[180, 180], [420, 180], [420, 420], [180, 420]]
    assert np.reshape(corners[0], (4, 2)) == pytest.approx(np.array(expected), abs=1.5)


def test_an_inverted_print_has_black_and_white_exchanged() -> None:
    board = Board(size=(0.5, 0.4), tags=(Tag(id=7, size=0.24),))
    inverted = render_board_texture(board.model_copy(update={"inverted": True}), 300)
    np.testing.assert_array_equal(inverted, 1 - render_board_texture(board, 300))


def test_print_that_cuts_texels_keeps_its_exact_area() -> None:
    # A tag's outer ring is black; its bits are 6 x 6 modules of an eighth of its size.
    sizes = (0.2, 0.2037, 0.19991)
    ink = [
        (1 - render_board_texture(Board(size=(0.5, 0.5), tags=(Tag(id=0, size=s),)), 700)).mean() * 0.25
        for s in sizes
    ]
    fractions = np.array(ink) / np.square(sizes)
    assert fractions == pytest.approx(fractions[0], rel=1e-9)


def test_checkerboard_has_the_stated_inner_corners() -> None:
    pattern = Checkerboard(kind="checkerboard", columns=7, rows=5, square=0.095, center=(0.03, -0.02))
    image = to_image(render_board_texture(Board(size=(1.0, 0.8), pattern=pattern), 1000))
    found, corners = cv2.findChessboardCorners(image, (7, 5))
    assert found
    refined = cv2.cornerSubPix(image, corners, (9, 9), (-1, -1), (3, 40, 1e-4)).reshape(-1, 2)
    # The centre (0.03, -0.02) lies 530 texels from the left edge and 420 from the top; texel centres are at +0.5.
    assert refined.mean(axis=0) == pytest.approx([529.5, 419.5], abs=0.01)


def test_charuco_is_what_opencv_finds() -> None:
    pattern = Charuco(
        kind="charuco", columns=8, rows=6, square=0.1, marker=0.075, dictionary="DICT_5X5_100", center=(0, 0)
    )
    image = to_image(render_board_texture(Board(size=(1.0, 0.8), pattern=pattern), 1000))
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    charuco = cv2.aruco.CharucoBoard((8, 6), 0.1, 0.075, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(charuco).detectBoard(image)
    assert len(ids) == 7 * 5
    # OpenCV numbers corners from the top left of its image.
    assert np.reshape(corners[0], 2) == pytest.approx([199.5, 199.5], abs=0.3)


def test_aprilgrid_counts_from_the_bottom_left() -> None:
    pattern = AprilGrid(kind="aprilgrid", columns=4, rows=3, tag_size=0.16, tag_spacing=0.3, first_id=5)
    image = to_image(render_board_texture(Board(size=(1.0, 0.8), pattern=pattern), 1000))
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = 2
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    assert sorted(np.ravel(ids).tolist()) == list(range(5, 17))
    found = {int(i): np.reshape(c, (4, 2)) for i, c in zip(np.ravel(ids), corners, strict=True)}
    assert found[5].mean(axis=0) == pytest.approx([500 - 1.5 * 208, 400 + 208], abs=1.5)
    # Kalibr prints tags upside down: the top left corner of OpenCV is the bottom right one on the board.
    assert found[5][0] == pytest.approx([500 - 1.5 * 208 + 80, 400 + 208 + 80], abs=4)
