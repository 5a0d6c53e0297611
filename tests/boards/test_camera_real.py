"""Boards in real photographs."""

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from calgraph.boards.camera import CameraDetector
from calgraph.boards.detections import BoardCorners
from calgraph.boards.printed_boards import compute_landmarks
from calgraph.boards.tags import GridFinder, TagFinder
from calgraph.config import AprilGrid, Board, Checkerboard, PixelNoise, Tag
from calgraph.config.settings import CameraDetectionSettings, TagSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3
from calgraph.sensors import CameraModel, Image

GMSL = CameraModel(
    "fisheye", 1920, 1208, np.array([[1176.93, 0, 962.275], [0, 1177.72, 612.725], [0, 0, 1]]),
    np.array([-0.0540096, -0.0784275, 0.0959641, -0.0515253]),
)  # fmt: skip
RPG = CameraModel(
    "pinhole", 640, 480, np.array([[505.29124569, 0, 322.19927863], [0, 504.55350189, 236.33609581], [0, 0, 1]]),
    np.array([0.18421732, -0.31277364, -0.00041421, 0.00039006, -0.07993784]),
)  # fmt: skip
GMSL_BOARD = Board(size=(0.61, 0.85), pattern=Checkerboard(kind="checkerboard", columns=5, rows=7, square=0.095))
RPG_BOARD = Board(size=(0.2, 0.3), pattern=Checkerboard(kind="checkerboard", columns=8, rows=11, square=0.019))


def gray(path: Path) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None, path
    return np.asarray(image, dtype=np.uint8)


def detections(folder: Path, board: Board, camera: CameraModel) -> Iterator[tuple[str, BoardCorners | Rejected]]:
    detector = CameraDetector([board], camera, PixelNoise(pixel=0.3), settings=CameraDetectionSettings())
    for path in sorted(folder.glob("*.png")):
        found = detector.find([Image(0.0, "camera", gray(path))])
        yield path.stem, found if isinstance(found, Rejected) else found[0]


def residuals(found: BoardCorners, camera: CameraModel) -> Array:
    projected = camera.project(se3.apply(found.T_camera_board, found.corners_board))
    return np.asarray(np.linalg.norm(projected - found.pixels, axis=1))


def test_a_checkerboard_is_found_in_all_wide_angle_images_and_agrees_with_its_published_centre(
    data_dir: Path,
) -> None:
    folder = data_dir / "acfr-vlp16-checkerboard"
    published = np.loadtxt(folder / "poses.csv", delimiter=",").reshape(-1, 19, 3)
    samples = {int(row[18, 0]): row for row in published}
    medians, offsets = [], []
    for name, found in detections(folder / "images", GMSL_BOARD, GMSL):
        assert isinstance(found, BoardCorners), (name, found)
        medians.append(np.median(residuals(found, GMSL)))
        center = samples[int(name.removeprefix("pose"))][0] / 1000
        offsets.append(np.linalg.norm(found.center - center))
    assert len(medians) == 16
    assert np.median(medians) < 0.16
    # The published centre is that of the sheet, 2 mm beside the pattern's.
    assert np.median(offsets) < 0.004


def test_a_checkerboard_is_found_in_all_images_of_a_small_camera(data_dir: Path) -> None:
    found = dict(detections(data_dir / "acfr-rpg-camera-2dlidar" / "images", RPG_BOARD, RPG))
    assert [isinstance(one, BoardCorners) and one.rms < 0.16 for one in found.values()] == [True] * 5


def test_tags_of_robots_are_found_where_the_library_lists_them(data_dir: Path) -> None:
    finder = TagFinder("tag36h11", settings=TagSettings())
    for path in sorted((data_dir / "apriltag-images" / "robotics_test").glob("*.jpg")):
        rows = [line for line in path.with_suffix(".txt").read_text().splitlines() if line.strip()]
        listed = np.array([re.findall(r"[\d.]+", row)[1:] for row in rows], dtype=np.float64)
        centers = listed.reshape(-1, 4, 2).mean(axis=1) - 0.5
        found = finder.find(gray(path)).pixels.mean(axis=1)
        nearest = np.linalg.norm(centers[:, None] - found[None], axis=-1).min(axis=1)
        assert np.mean(nearest < 1.0) > 0.8, path.name


@pytest.mark.parametrize(
    ("name", "ids"),
    [
        ("test_image_multiple_01", [22, 24, 58, 85, 144, 198]),
        ("test_image_multiple_02", [22, 24, 85, 144, 198]),
        ("test_image_multiple_03", [22, 24, 58, 85, 144, 198]),
    ],
)
def test_tags_of_a_model_town_are_found(name: str, ids: list[int], data_dir: Path) -> None:
    found = TagFinder("tag36h11", settings=TagSettings()).find(
        gray(data_dir / "apriltag-images" / "duckietown" / f"{name}.png")
    )
    assert sorted(found.ids.tolist()) == ids


@pytest.mark.parametrize("angle", [-30, 0, 30])
def test_a_tag_on_a_turntable_is_turned_as_stated(angle: int, data_dir: Path) -> None:
    K = np.array([[329.8729619143081, 0, 528], [0, 332.94611303946357, 396], [0, 0, 1]])
    camera = CameraModel("pinhole", 1056, 792, K, np.zeros(0))
    board = Board(size=(0.1, 0.1), tags=(Tag(id=76, size=0.065),))
    path = data_dir / "apriltag-images" / "duckietown" / f"test_image_rotation_{angle}.png"
    found = CameraDetector([board], camera, PixelNoise(pixel=0.5), settings=CameraDetectionSettings()).find(
        [Image(0.0, "camera", gray(path))]
    )
    assert not isinstance(found, Rejected), found.reason
    normal = found[0].plane[:3]
    assert np.degrees(np.arctan2(normal[0], -normal[2])) == pytest.approx(angle, abs=4)


@pytest.mark.parametrize("name", ["001", "004"])
def test_tags_of_a_kalibr_grid_lie_on_one_plane_as_printed(name: str, data_dir: Path) -> None:
    board = Board(
        size=(0.8, 0.8), pattern=AprilGrid(kind="aprilgrid", columns=6, rows=6, tag_size=0.088, tag_spacing=0.3)
    )
    marks = GridFinder("tag36h11").find(gray(data_dir / "apriltag-images" / "aprilgrid_phone" / f"{name}.jpg"))
    corners = compute_landmarks(board).corners_of(marks.ids)[..., :2].reshape(-1, 2)
    H, _ = cv2.findHomography(corners, marks.pixels.reshape(-1, 2))
    away = np.linalg.norm(
        cv2.perspectiveTransform(corners[:, None], H)[:, 0] - marks.pixels.reshape(-1, 2), axis=1
    )
    assert len(marks) == {"001": 36, "004": 21}[name]
    assert np.median(away) < 3  # of 4080 pixels, through a lens of unknown distortion
