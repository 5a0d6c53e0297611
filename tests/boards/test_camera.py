"""Boards in images drawn with known poses."""

import pickle
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.boards.camera import CameraDetector, PlaneEstimator
from calgraph.boards.detections import BoardCorners, InconsistentTags
from calgraph.boards.printed_boards import average_marks, compute_landmarks
from calgraph.boards.tags import Marks
from calgraph.config import AprilGrid, Board, Charuco, Checkerboard, PixelNoise, Tag
from calgraph.config.settings import CameraDetectionSettings
from calgraph.errors import InputError, Rejected
from calgraph.geometry import Array, plane, se3, so3
from calgraph.rig.published.mean_plane import estimate_mean_plane
from calgraph.sensors import CameraModel, Image

Gray = NDArray[np.uint8]
Render = Callable[..., Gray]

NOISE = PixelNoise(pixel=0.2)
K = np.array([[700.0, 0, 640], [0, 700, 480], [0, 0, 1]])
HALF = np.array([[350.0, 0, 320], [0, 350, 240], [0, 0, 1]])
CAMERA = CameraModel("pinhole", 1280, 960, K, np.zeros(0))
SMALL = CameraModel("pinhole", 640, 480, HALF, np.zeros(0))
BARREL = CameraModel("pinhole", 640, 480, HALF, np.array([-0.3, 0.1, 0.001, -0.002]))
FISHEYE = CameraModel(
    "fisheye", 640, 480, HALF * [[0.8, 1, 1], [1, 0.8, 1], [1, 1, 1]], np.array([0.05, 0.01, 0, 0])
)

TAGS = (
    Tag(id=3, size=0.3, center=(-0.28, 0.16)),
    Tag(id=5, size=0.3, center=(0.28, 0.16)),
    Tag(id=7, size=0.24, center=(0, -0.2)),
)
TAGGED = Board(size=(1.0, 0.8), tags=TAGS)
CHECKERBOARD = Board(
    size=(1.0, 0.8), pattern=Checkerboard(kind="checkerboard", columns=8, rows=5, square=0.1, center=(0.01, -0.02))
)
SYMMETRIC = Board(size=(1.0, 0.8), pattern=Checkerboard(kind="checkerboard", columns=7, rows=5, square=0.1))
SQUARE = Board(size=(0.8, 0.8), pattern=Checkerboard(kind="checkerboard", columns=5, rows=5, square=0.1))
CHARUCO = Board(
    size=(1.0, 0.8),
    pattern=Charuco(kind="charuco", columns=8, rows=6, square=0.1, marker=0.07, dictionary="DICT_5X5_100"),
)
APRILGRID = Board(
    size=(0.8, 0.8), pattern=AprilGrid(kind="aprilgrid", columns=5, rows=5, tag_size=0.1, tag_spacing=0.3)
)
BOARDS = {
    "tags": TAGGED, "checkerboard": CHECKERBOARD, "charuco": CHARUCO, "aprilgrid": APRILGRID,
    "tag25h9": Board(size=(1.0, 0.8), family="tag25h9", tags=TAGS),
    "tag16h5": Board(size=(1.0, 0.8), family="tag16h5", tags=TAGS),
}  # fmt: skip
UPSIDE = np.diag([1.0, -1, -1])


def a_pose(
    turn: tuple[float, float, float] = (0.3, 0.25, 0.1), t: tuple[float, float, float] = (0.1, -0.1, 2)
) -> Array:
    return se3.pose(so3.exp(np.array(turn)) @ UPSIDE, np.array(t))


def image(pixels: Gray, stamp: float = 0.0) -> Image:
    return Image(stamp, "camera", pixels)


def find_boards(
    images: Sequence[Image],
    boards: Sequence[Board],
    camera: CameraModel,
    noise: PixelNoise,
    plane_estimator: PlaneEstimator | None = None,
) -> tuple[BoardCorners, ...] | Rejected:
    return CameraDetector(boards, camera, noise, CameraDetectionSettings(), plane_estimator).find(images)


def one(found: tuple[BoardCorners, ...] | Rejected) -> BoardCorners:
    assert not isinstance(found, Rejected), found.reason
    (board,) = found
    return board


def reason(found: tuple[BoardCorners, ...] | Rejected) -> str:
    assert isinstance(found, Rejected)
    return found.reason


def detect(board: Board, pixels: Gray, camera: CameraModel = CAMERA) -> BoardCorners:
    return one(find_boards([image(pixels)], [board], camera, NOISE))


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS.keys())
def test_board_is_found_where_it_is(board: Board, render: Render, rng: np.random.Generator) -> None:
    T = a_pose()
    error = se3.difference(detect(board, render(board, CAMERA, T, rng)).T_camera_board, T)
    assert np.linalg.norm(error[:3]) < 0.002
    assert np.degrees(np.linalg.norm(error[3:])) < 0.2


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS.keys())
def test_an_inverted_print_is_found_where_it_is(board: Board, render: Render, rng: np.random.Generator) -> None:
    T, inverted = a_pose(), board.model_copy(update={"inverted": True})
    error = se3.difference(detect(inverted, render(inverted, CAMERA, T, rng)).T_camera_board, T)
    assert np.linalg.norm(error[:3]) < 0.002
    assert np.degrees(np.linalg.norm(error[3:])) < 0.2


def test_boards_of_one_family_may_be_inverted_and_not(render: Render, rng: np.random.Generator) -> None:
    inverted = Board(size=(0.5, 0.5), tags=(Tag(id=11, size=0.3),), inverted=True)
    picture = render(TAGGED, CAMERA, a_pose(t=(-0.7, 0.0, 2.2)), rng)
    picture[:, 640:] = render(inverted, CAMERA, a_pose(t=(0.7, 0.0, 2.2)), rng)[:, 640:]
    found = find_boards([image(picture)], [TAGGED, inverted], CAMERA, NOISE)
    assert isinstance(found, tuple)
    assert [board.board for board in found] == [0, 1]


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS.keys())
def test_corners_are_unbiased_to_a_twentieth_pixel(board: Board, render: Render, rng: np.random.Generator) -> None:
    offsets = []
    for turn in ((0.3, 0.25, 0.1), (-0.2, 0.3, 0.8)):
        T = a_pose(turn)
        found = detect(board, render(board, CAMERA, T, rng))
        offsets.append(found.pixels - CAMERA.project(se3.apply(T, found.corners_board)))
    np.testing.assert_allclose(np.concatenate(offsets).mean(axis=0), 0, atol=0.05)


@pytest.mark.parametrize("camera", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
@pytest.mark.parametrize("board", [TAGGED, CHECKERBOARD], ids=["tags", "checkerboard"])
def test_distortion_is_respected(
    board: Board, camera: CameraModel, render: Render, rng: np.random.Generator
) -> None:
    T = a_pose(t=(-0.3, 0.2, 1.3))
    error = se3.difference(detect(board, render(board, camera, T, rng), camera).T_camera_board, T)
    assert np.linalg.norm(error[:3]) < 0.002
    assert np.degrees(np.linalg.norm(error[3:])) < 0.3


def test_error_of_a_drawn_board_is_within_its_covariance(render: Render, rng: np.random.Generator) -> None:
    T = a_pose()
    found = detect(TAGGED, render(TAGGED, CAMERA, T, rng))
    error = se3.difference(found.T_camera_board, T)
    assert error @ np.linalg.solve(found.covariance, error) < 22.5  # χ²(6), 99.9 %


@pytest.mark.parametrize("plane_estimator", [None, estimate_mean_plane])
def test_plane_points_at_the_camera(
    plane_estimator: PlaneEstimator | None, render: Render, rng: np.random.Generator
) -> None:
    T = a_pose()
    pixels = render(TAGGED, CAMERA, T, rng)
    found = one(find_boards([image(pixels)], [TAGGED], CAMERA, NOISE, plane_estimator=plane_estimator))
    np.testing.assert_allclose(found.plane, plane.from_pose(T), atol=0.01)
    assert found.plane[3] > 0


def test_mean_of_the_tags_planes_is_less_certain_than_one_pnp(render: Render, rng: np.random.Generator) -> None:
    pixels = render(TAGGED, CAMERA, a_pose(), rng)
    pnp, mean = (
        one(CameraDetector([TAGGED], CAMERA, NOISE, CameraDetectionSettings(), estimator).find([image(pixels)]))
        for estimator in (None, estimate_mean_plane)
    )
    assert (np.diag(mean.plane_covariance) > 1.5 * np.diag(pnp.plane_covariance)).all()


@pytest.mark.parametrize(
    ("board", "roll"),
    [(CHECKERBOARD, 0.0), (CHECKERBOARD, 1.5), (CHECKERBOARD, 3.1), (SQUARE, 0.0), (SQUARE, 1.5), (SQUARE, -1.5)],
)
def test_colours_determine_which_side_of_a_checkerboard_is_up(
    board: Board, roll: float, render: Render, rng: np.random.Generator
) -> None:
    T = a_pose((0.1, 0.2, 0))
    T[:3, :3] = T[:3, :3] @ so3.exp(np.array([0, 0, roll]))
    error = se3.difference(detect(board, render(board, SMALL, T, rng), SMALL).T_camera_board, T)
    assert np.linalg.norm(error[3:]) < 0.02


def test_symmetric_checkerboard_is_taken_as_upright(render: Render, rng: np.random.Generator) -> None:
    T = a_pose((0.1, 0.2, 0))
    upside_down = T @ np.diag([-1.0, -1, 1, 1])
    found = detect(SYMMETRIC, render(SYMMETRIC, SMALL, upside_down, rng), SMALL)
    assert np.linalg.norm(se3.difference(found.T_camera_board, T)[3:]) < 0.02


def test_a_covered_tag_is_left_out(render: Render, rng: np.random.Generator) -> None:
    T = a_pose()
    two = Board(size=(1.0, 0.8), tags=TAGS[:2])
    found = detect(TAGGED, render(two, CAMERA, T, rng))
    assert len(found.pixels) == 8


def test_a_tag_half_out_of_the_image_is_left_out(render: Render, rng: np.random.Generator) -> None:
    found = detect(TAGGED, render(TAGGED, CAMERA, a_pose((0, 0, 0), (-1.45, 0, 2)), rng))
    assert found.corners_board[:, 0].min() > -0.13


def test_a_tag_that_stands_elsewhere_is_an_outlier(render: Render, rng: np.random.Generator) -> None:
    stated = Board(size=(1.0, 0.8), tags=(*TAGS[:2], Tag(id=7, size=0.24, center=(0, -0.1))))
    found = detect(stated, render(TAGGED, CAMERA, a_pose(), rng))
    assert found.outlier_tags == (7,)
    assert len(found.pixels) == 8


def test_exchanged_tags_are_inconsistent(render: Render, rng: np.random.Generator) -> None:
    stated = Board(
        size=(1.0, 0.8), tags=(Tag(id=5, size=0.3, center=(-0.28, 0.16)), Tag(id=3, size=0.3, center=(0.28, 0.16)))
    )
    found = find_boards([image(render(TAGGED, CAMERA, a_pose(), rng))], [stated], CAMERA, NOISE)
    assert isinstance(found, InconsistentTags)
    assert found.tags == (3, 5)


def test_small_tags_are_found_where_large_ones_predict_them(render: Render, rng: np.random.Generator) -> None:
    board = Board(size=(1.0, 0.8), tags=(*TAGS[:2], Tag(id=9, size=0.06, center=(0, -0.2))))
    found = detect(board, render(board, CAMERA, a_pose((0.2, 0.1, 0), (0, 0, 2.6)), rng))
    assert len(found.pixels) == 12


def test_board_is_detected_in_a_dim_and_noisy_image(render: Render, rng: np.random.Generator) -> None:
    pixels = render(TAGGED, CAMERA, a_pose(), rng, contrast=0.15, noise=3.0)
    assert len(detect(TAGGED, pixels).pixels) == 12


def test_board_is_detected_in_colour_images(render: Render, rng: np.random.Generator) -> None:
    pixels = cv2.cvtColor(render(TAGGED, CAMERA, a_pose(), rng), cv2.COLOR_GRAY2BGR)
    assert len(detect(TAGGED, np.asarray(pixels, dtype=np.uint8)).pixels) == 12


def test_several_boards_are_distinguished(render: Render, rng: np.random.Generator) -> None:
    left = Board(size=(0.4, 0.4), tags=(Tag(id=1, size=0.3),))
    right = Board(size=(0.4, 0.4), tags=(Tag(id=2, size=0.3),))
    a, b = (render(board, CAMERA, a_pose(t=(x, 0, 2)), rng) for board, x in ((left, -0.5), (right, 0.5)))
    pixels = np.where(np.arange(1280) < 640, a, b)
    found = find_boards([image(pixels)], [left, right], CAMERA, NOISE)
    assert not isinstance(found, Rejected)
    assert [(board.board, round(float(board.center[0]), 1)) for board in found] == [(0, -0.5), (1, 0.5)]


def test_images_of_a_resting_board_are_averaged(render: Render, rng: np.random.Generator) -> None:
    images = [image(render(TAGGED, SMALL, a_pose(), rng, noise=8), 0.1 * i) for i in range(4)]
    truth = SMALL.project(se3.apply(a_pose(), one(find_boards(images, [TAGGED], SMALL, NOISE)).corners_board))
    detector = CameraDetector([TAGGED], SMALL, NOISE, settings=CameraDetectionSettings())
    single = [np.std(one(detector.find([shot])).pixels - truth) for shot in images]
    assert np.std(one(detector.find(images)).pixels - truth) < 0.8 * np.mean(single)


@pytest.mark.parametrize(("pixels", "moved"), [(1.6, False), (2.6, True)])
def test_a_board_may_move_by_a_pixel_from_the_mean(
    pixels: float, moved: bool, render: Render, rng: np.random.Generator
) -> None:
    shift = (2 * pixels / 350, 0.0, 2.0)
    images = [image(render(TAGGED, SMALL, a_pose((0, 0, 0), t), rng)) for t in ((0.0, 0.0, 2.0), shift)]
    assert isinstance(find_boards(images, [TAGGED], SMALL, NOISE), Rejected) == moved


def test_a_board_that_moved_is_rejected(render: Render, rng: np.random.Generator) -> None:
    images = [image(render(TAGGED, SMALL, a_pose(t=(x, 0, 2)), rng)) for x in (0, 0.02)]
    assert "moved between images" in reason(find_boards(images, [TAGGED], SMALL, NOISE))


def test_images_whose_marks_all_have_a_corner_that_jumps_are_rejected() -> None:
    """Most corners rest, so that the board has not moved by the median of all."""
    ids, corners = np.arange(2), np.tile(100.0 * np.eye(4, 2), (2, 1, 1))
    jump = np.zeros((2, 4, 2))
    jump[:, 0, 0] = 8.0
    found = average_marks([Marks(ids, corners), Marks(ids, corners + jump)], PixelNoise(pixel=0.3))
    assert found == Rejected("board moved between images: its corners by up to 8.0 px")


def test_an_image_without_the_board_is_left_out(render: Render, rng: np.random.Generator) -> None:
    empty = np.full((480, 640), 90, dtype=np.uint8)
    images = [image(empty), image(render(TAGGED, SMALL, a_pose(), rng))]
    assert len(one(find_boards(images, [TAGGED], SMALL, NOISE)).pixels) == 12


def noise_image(rng: np.random.Generator) -> Gray:
    return np.asarray(np.clip(rng.normal(100, 20, (480, 640)), 0, 255), dtype=np.uint8)


@pytest.mark.parametrize(
    ("board", "message"),
    [
        (TAGGED, "no tag of family tag36h11 found; ids 3, 5, 7 expected"),
        (BOARDS["tag16h5"], "no tag of family tag16h5 found; ids 3, 5, 7 expected"),
        (CHECKERBOARD, "checkerboard of 8x5 inner corners not found"),
        (CHARUCO, "no corner of the 8x6 ChArUco board of DICT_5X5_100 found"),
        (APRILGRID, "no tag of family tag36h11 found; ids 0 to 24 expected"),
    ],
)
def test_rejection_names_what_was_expected(board: Board, message: str, rng: np.random.Generator) -> None:
    assert reason(find_boards([image(noise_image(rng))], [board], SMALL, NOISE)) == message


def test_tags_of_another_board_are_named(render: Render, rng: np.random.Generator) -> None:
    other = Board(size=(1.0, 0.8), tags=(Tag(id=17, size=0.3),))
    found = find_boards([image(render(other, SMALL, a_pose(), rng))], [TAGGED], SMALL, NOISE)
    assert reason(found) == "only id 17 detected, which is not on the board; ids 3, 5, 7 expected"


def test_rejection_names_a_dark_image() -> None:
    dark = np.full((480, 640), 3, dtype=np.uint8)
    assert "too dark" in reason(find_boards([image(dark)], [TAGGED], SMALL, NOISE))


def test_rejection_names_a_blank_image() -> None:
    assert "blank" in reason(
        find_boards([image(np.full((480, 640), 200, dtype=np.uint8))], [TAGGED], SMALL, NOISE)
    )


def test_no_images_are_rejected() -> None:
    assert reason(find_boards([], [TAGGED], SMALL, NOISE)) == "no image in this capture"


def test_a_board_without_a_print_is_rejected() -> None:
    bare = Board(size=(1, 1))
    assert "no board with tags" in reason(
        find_boards([image(np.zeros((480, 640), np.uint8))], [bare], SMALL, NOISE)
    )


def test_images_of_another_size_than_the_intrinsics_are_refused() -> None:
    with pytest.raises(InputError, match=r"is 640x480, its intrinsics are for 1280x960"):
        find_boards([image(np.zeros((480, 640), np.uint8))], [TAGGED], CAMERA, NOISE)


@pytest.mark.parametrize("board", BOARDS.values(), ids=BOARDS.keys())
def test_a_pickled_detector_finds_the_same(board: Board, render: Render, rng: np.random.Generator) -> None:
    pixels = render(board, CAMERA, a_pose(), rng)
    detector = CameraDetector([board], CAMERA, NOISE, settings=CameraDetectionSettings())
    here = one(detector.find([image(pixels)]))
    pickled = pickle.dumps(detector)
    there = one(pickle.loads(pickled).find([image(pixels)]))  # noqa: S301 (made here)
    np.testing.assert_array_equal(there.pixels, here.pixels)
    np.testing.assert_array_equal(there.T_camera_board, here.T_camera_board)


def test_boards_that_share_a_tag_are_refused() -> None:
    with pytest.raises(InputError, match="boards 0 and 1 both have tag 3 of tag36h11"):
        CameraDetector([TAGGED, TAGGED], CAMERA, NOISE, settings=CameraDetectionSettings())


def test_detectors_can_be_built_and_deleted_repeatedly() -> None:
    """The AprilTag library corrupts the heap when it frees its families by itself."""
    blank = [image(np.zeros((480, 640), np.uint8))]
    found = [
        CameraDetector([BOARDS["tag25h9"]], SMALL, NOISE, settings=CameraDetectionSettings()).find(blank)
        for _ in range(10)
    ]
    assert [type(result) for result in found] == 10 * [Rejected]


@pytest.mark.parametrize("camera", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
def test_bent_edges_do_not_shift_the_corners_of_tags(
    camera: CameraModel, render: Render, rng: np.random.Generator
) -> None:
    """Straight lines through bent edges are off by 0.17 pixels, and boards nearer by millimetres."""
    depths, offsets = [], []
    for _ in range(8):
        t = rng.uniform([-0.9, -0.5, 1.2], [0.9, 0.5, 1.6])
        T = a_pose((0.2, -0.2, 0.1), (t[0], t[1], t[2]))
        found = detect(TAGGED, render(TAGGED, camera, T, rng), camera)
        offsets.append(found.pixels - camera.project(se3.apply(T, found.corners_board)))
        depths.append(np.linalg.norm(found.center) - np.linalg.norm(t))
    assert np.sqrt(np.mean(np.concatenate(offsets) ** 2)) < 0.09
    assert abs(np.mean(depths)) < 0.0007


@pytest.mark.parametrize("camera", [SMALL, BARREL, FISHEYE], ids=["pinhole", "barrel", "fisheye"])
@pytest.mark.parametrize("name", ["tags", "charuco", "aprilgrid"])
def test_a_board_partly_outside_the_image_is_detected(
    name: str, camera: CameraModel, render: Render, rng: np.random.Generator
) -> None:
    """Its centre lies near the image's left edge."""
    (ray,) = camera.rays(np.array([[70.0, 250.0]]))
    x, y, z = 1.1 * ray
    T = a_pose((0.1, np.arctan2(x, z) + 0.2, 0.05), (x, y, z))
    found = detect(BOARDS[name], render(BOARDS[name], camera, T, rng), camera)
    whole = compute_landmarks(BOARDS[name]).corners[..., 0].size
    assert len(found.pixels) < 0.8 * whole
    error = se3.difference(found.T_camera_board, T)
    assert np.linalg.norm(error[:3]) < 0.015
    assert np.degrees(np.linalg.norm(error[3:])) < 1.0
