"""Prints that other programs made: ChArUco boards of the older layout, ArUco markers, and other dictionaries."""

import cv2
import numpy as np
import pytest

from calgraph.boards.camera import CameraDetector
from calgraph.boards.detections import BoardCorners
from calgraph.config import Board, PixelNoise, dictionary, printed_bitmaps
from calgraph.config.settings import CameraDetectionSettings
from calgraph.errors import Rejected
from calgraph.geometry import se3, so3
from calgraph.rig.captures.detect import find_legacy_prints
from calgraph.sensors import CameraModel, Image

CAMERA = CameraModel("pinhole", 960, 720, np.array([[800, 0, 479.5], [0, 800, 359.5], [0, 0, 1.0]]), np.zeros(0))


def find(board: Board, gray: np.ndarray) -> tuple[BoardCorners, ...] | Rejected:
    detector = CameraDetector([board], CAMERA, PixelNoise(pixel=0.2), CameraDetectionSettings())
    return detector.find([Image(0.0, "", gray)])


def charuco(columns: int, rows: int, name: str = "DICT_5X5_100") -> Board:
    pattern = {"kind": "charuco", "columns": columns, "rows": rows, "square": 0.1, "marker": 0.075}
    size = [0.1 * columns, 0.1 * rows]
    return Board.model_validate({"size": size, "pattern": {**pattern, "dictionary": name}})


def photograph(columns: int, rows: int, legacy: bool, name: str = "DICT_5X5_100") -> np.ndarray:
    """A board of OpenCV, seen at an angle."""
    board = cv2.aruco.CharucoBoard((columns, rows), 0.1, 0.075, dictionary(name))
    board.setLegacyPattern(legacy)
    sheet = board.generateImage((80 * columns, 80 * rows), marginSize=0)
    corners = 80 * np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], dtype=np.float32)
    half = 0.05 * np.array([columns, rows, 0])
    T = se3.pose(so3.exp(np.array([np.pi - 0.3, 0.2, 0.1])), np.array([0.0, 0.0, 1.1]))
    edges = half * [[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]
    H = cv2.getPerspectiveTransform(corners - 0.5, CAMERA.project(se3.apply(T, edges)).astype(np.float32))
    return np.asarray(cv2.warpPerspective(sheet, H, (960, 720), flags=cv2.INTER_AREA, borderValue=200.0))


@pytest.mark.parametrize(("columns", "rows"), [(7, 6), (5, 4), (8, 4), (4, 8)])
@pytest.mark.parametrize("legacy", [False, True])
def test_both_layouts_of_charuco_boards_are_recognized(columns: int, rows: int, legacy: bool) -> None:
    gray = photograph(columns, rows, legacy)
    found = find(charuco(columns, rows), gray)
    assert not isinstance(found, Rejected)
    (corners,) = found
    assert len(corners.pixels) == (columns - 1) * (rows - 1)
    assert corners.rms < 0.5
    assert corners.legacy == legacy
    findings = [one.text for one in find_legacy_prints({"camera": {0: found, 1: found}})]
    assert [("before OpenCV 4.6" in one) for one in findings] == [True] * legacy


def test_a_part_of_an_older_board_is_recognized() -> None:
    gray = photograph(7, 6, legacy=True)
    gray[:, 480:] = 200
    found = find(charuco(7, 6), gray)
    assert not isinstance(found, Rejected)
    assert 6 <= len(found[0].pixels) <= 18
    assert found[0].rms < 0.5


def tags(family: str) -> Board:
    centers = [(-0.3, 0.15), (0.3, 0.15), (0.0, -0.15)]
    return Board.model_validate({
        "size": [1.0, 0.7], "family": family,
        "tags": [{"id": 3 * i + 1, "size": 0.24, "center": center} for i, center in enumerate(centers)],
    })  # fmt: skip


def draw(board: Board) -> np.ndarray:
    """The board from 1.2 m, face on: 667 pixels a metre."""
    gray = np.full((4 * 720, 4 * 960), 220, dtype=np.uint8)
    scale = 4 * 800 / 1.2
    for one in printed_bitmaps(board):
        edge = round(one.size[0] * scale)
        left = round(4 * 480 + one.center[0] * scale - edge / 2)
        top = round(4 * 360 - one.center[1] * scale - edge / 2)
        modules = (200 * one.bitmap + 20).astype(np.uint8)
        gray[top : top + edge, left : left + edge] = cv2.resize(
            modules, (edge, edge), interpolation=cv2.INTER_NEAREST
        )
    return np.asarray(cv2.resize(gray, (960, 720), interpolation=cv2.INTER_AREA))


@pytest.mark.parametrize("family", ["DICT_4X4_50", "DICT_5X5_250", "DICT_6X6_1000", "DICT_7X7_100",
                                    "DICT_ARUCO_ORIGINAL", "DICT_ARUCO_MIP_36h12", "tag36h11"])  # fmt: skip
def test_tags_of_all_families_are_detected(family: str) -> None:
    found = find(tags(family), draw(tags(family)))
    assert not isinstance(found, Rejected)
    assert len(found[0].pixels) == 12
    assert found[0].rms < 0.3
    np.testing.assert_allclose(found[0].T_camera_board[:3, 3], [0, 0, 1.2], atol=0.006)


@pytest.mark.parametrize("spelled", ["DICT_4X4_50", "dict_4x4_50", "4x4_50", "aruco_4x4_50", "ARUCO_4X4_50"])
def test_dictionaries_are_known_by_their_usual_names(spelled: str) -> None:
    assert tags(spelled).family == "DICT_4X4_50"


@pytest.mark.parametrize(
    ("printed", "stated"),
    [
        ("DICT_4X4_50", "DICT_6X6_250"),
        ("DICT_6X6_50", "tag36h11"),
        ("tag25h9", "tag36h11"),
        ("tag36h11", "DICT_5X5_50"),
    ],
)
def test_the_dictionary_of_other_tags_is_named(printed: str, stated: str) -> None:
    found = find(tags(stated), draw(tags(printed)))
    assert isinstance(found, Rejected)
    assert f"no tag of family {stated} found" in found.reason
    assert f"the markers in the image are of {printed}: correct rig.yaml" in found.reason


def test_the_dictionary_of_another_charuco_board_is_named() -> None:
    found = find(charuco(7, 5), photograph(7, 5, legacy=False, name="DICT_6X6_250"))
    assert isinstance(found, Rejected)
    assert (
        "no corner of the 7x5 ChArUco board of DICT_5X5_100 found; the markers in the image are of DICT_6X6_50"
        in (found.reason)
    )


def test_no_dictionary_is_named_for_an_image_without_markers() -> None:
    rng = np.random.default_rng(0)
    gray = cv2.GaussianBlur(rng.integers(0, 255, (720, 960)).astype(np.uint8), (0, 0), 6)
    found = find(tags("DICT_4X4_50"), np.clip(4.0 * gray - 380, 0, 255).astype(np.uint8))
    assert isinstance(found, Rejected)
    assert "markers in the image" not in found.reason
