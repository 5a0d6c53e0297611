"""Printed boards and photographs of them, drawn from the patterns' specification alone."""

import functools
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.config import AprilGrid, Board, Charuco, Checkerboard
from calgraph.geometry import Array
from calgraph.sensors import CameraModel

Gray = NDArray[np.uint8]
Render = Callable[..., Gray]

_PER_METRE = 1000
_DICTIONARIES = {
    "tag36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "tag25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "tag16h5": cv2.aruco.DICT_APRILTAG_16h5,
}


@pytest.fixture(scope="session")
def render() -> Render:
    """``render(board, camera, T_camera_board, rng)``: an 8-bit image with blur, shading and noise."""
    return _render


def _render(
    board: Board,
    camera: CameraModel,
    T_camera_board: Array,
    rng: np.random.Generator,
    *,
    blur: float = 0.6,
    noise: float = 2.0,
    contrast: float = 0.7,
    background: int = 90,
) -> Gray:
    fine, scale = 2, _PER_METRE
    sheet = 255 - _print(board) if board.inverted else _print(board)
    # Sheet pixel (0, 0) has its centre half a pixel inside the top left corner of the sheet.
    width, height = board.size
    board_sheet = np.array(
        [[1 / scale, 0, -width / 2 + 0.5 / scale], [0, -1 / scale, height / 2 - 0.5 / scale], [0, 0, 1]]
    )
    size = (fine * camera.width, fine * camera.height)
    if camera.model == "pinhole" and not camera.distortion.any():
        # Centres of coarse pixels lie between the centres of their fine ones.
        fine_pixel = np.array([[fine, 0, (fine - 1) / 2], [0, fine, (fine - 1) / 2], [0, 0, 1]])
        H = fine_pixel @ camera.K @ T_camera_board[:3, [0, 1, 3]] @ board_sheet
        image = cv2.warpPerspective(sheet, H, size, flags=cv2.INTER_LINEAR, borderValue=(background,))
    else:
        H = np.linalg.inv(T_camera_board[:3, [0, 1, 3]] @ board_sheet)
        x, y, w = (_rays(camera, fine) @ H.T).T
        ahead = w > 0
        x, y = (
            np.where(ahead, c / np.where(ahead, w, 1), -9).astype(np.float32).reshape(size[::-1]) for c in (x, y)
        )
        image = cv2.remap(sheet, x, y, cv2.INTER_LINEAR, borderValue=(background,))
    small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    if blur:
        small = cv2.GaussianBlur(small, (0, 0), blur)
    values = 20 + contrast * small.astype(np.float64) + noise * rng.normal(size=small.shape)
    return np.asarray(np.clip(np.rint(values), 0, 255), dtype=np.uint8)


@functools.cache
def _rays(camera: CameraModel, fine: int) -> Array:
    """Rays of an image's pixels, each divided in ``fine`` by ``fine``, row by row."""
    u, v = np.meshgrid(np.arange(fine * camera.width), np.arange(fine * camera.height))
    pixels = (np.stack([u, v], axis=-1).reshape(-1, 1, 2) - (fine - 1) / 2) / fine
    exact = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-9)
    if camera.model == "fisheye":
        flat = cv2.fisheye.undistortPoints(pixels, camera.K, camera.distortion, criteria=exact)
    else:
        flat = cv2.undistortPointsIter(pixels, camera.K, camera.distortion, np.eye(3), np.eye(3), exact)
    return np.concatenate([flat[:, 0], np.ones((len(flat), 1))], axis=-1)


def _print(board: Board) -> Gray:
    """The print at one pixel a millimetre."""
    sheet = np.full((_px(board.size[1]), _px(board.size[0])), 255, dtype=np.uint8)
    match board.pattern:
        case None:
            dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARIES[board.family])
            for tag in board.tags:
                drawn = cv2.aruco.generateImageMarker(dictionary, tag.id, _px(tag.size))
                _paste(sheet, np.asarray(drawn, np.uint8), tag.center)
        case Checkerboard() as p:
            squares = np.indices((p.rows + 1, p.columns + 1)).sum(axis=0) % 2
            _paste(sheet, np.kron(255 * squares, np.ones((_px(p.square),) * 2)).astype(np.uint8), p.center)
        case Charuco() as p:
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, p.dictionary))
            ids = np.arange(p.first_id, p.first_id + p.columns * p.rows // 2, dtype=np.int32)
            charuco = cv2.aruco.CharucoBoard((p.columns, p.rows), p.square, p.marker, dictionary, ids)
            drawn = charuco.generateImage((p.columns * _px(p.square), p.rows * _px(p.square)))
            _paste(sheet, np.asarray(drawn, np.uint8), p.center)
        case AprilGrid() as p:
            _paste(sheet, _kalibr(p, board.family), p.center)
    return sheet


def _kalibr(grid: AprilGrid, family: str) -> Gray:
    """Kalibr's print: tags upside down with a border of two bits, and a square at every tag's corner."""
    dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARIES[family])
    tag, gap = _px(grid.tag_size), _px(grid.tag_size * grid.tag_spacing)
    pitch = tag + gap
    image = np.full((grid.rows * pitch + gap, grid.columns * pitch + gap), 255, dtype=np.uint8)
    for row in range(grid.rows + 1):
        for column in range(grid.columns + 1):
            image[row * pitch : row * pitch + gap, column * pitch : column * pitch + gap] = 0
    for i in range(grid.rows * grid.columns):
        row, column = grid.rows - 1 - i // grid.columns, i % grid.columns
        marker = cv2.aruco.generateImageMarker(dictionary, grid.first_id + i, tag, borderBits=2)
        top, left = row * pitch + gap, column * pitch + gap
        image[top : top + tag, left : left + tag] = marker[::-1, ::-1]
    return image


def _paste(sheet: Gray, patch: Gray, center: tuple[float, float]) -> None:
    left = sheet.shape[1] / 2 + 1000 * center[0] - patch.shape[1] / 2
    top = sheet.shape[0] / 2 - 1000 * center[1] - patch.shape[0] / 2
    assert abs(left - round(left)) + abs(top - round(top)) < 1e-6, "the print must fall on whole pixels"
    sheet[round(top) : round(top) + patch.shape[0], round(left) : round(left) + patch.shape[1]] = patch


def _px(metres: float) -> int:
    return round(_PER_METRE * metres)
