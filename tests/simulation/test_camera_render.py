from dataclasses import replace

import cv2
import numpy as np
import pytest
from pupil_apriltags import Detector

from calgraph.config import Board, Checkerboard, Tag
from calgraph.geometry import Array, se3, so3
from calgraph.simulation import CameraOptions, RigScenario
from calgraph.simulation.camera_render import (
    Gray,
    PrintedBoard,
    RenderContext,
    blur_image,
    build_render_context,
    build_texture_pyramid,
    draw_board,
    draw_noise_pool,
    render_board_texture,
)
from calgraph.simulation.motion import draw_placements, pose_from_placement
from calgraph.simulation.robot import camera_model

T_WORLD_CAMERA = se3.pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.0, 0, 0.9]))
LENSES = {
    "pinhole": CameraOptions(width=960, height=720),
    "plumb_bob": CameraOptions(width=960, height=720, distortion=(-0.28, 0.09, 0.001, -0.0005, -0.01)),
    "fisheye": CameraOptions(
        model="fisheye", width=960, height=720, field_of_view=150.0, distortion=(0.02, -0.01, 0.002, -0.0005)
    ),
}
CHECKERBOARD = Board(size=(1.2, 0.9), pattern=Checkerboard(kind="checkerboard", columns=9, rows=6, square=0.1))


def printed(board: Board) -> PrintedBoard:
    return build_texture_pyramid(render_board_texture(board, 2000), board.size)


def render_board(context: RenderContext, T_world_board: Array, board: PrintedBoard, blur: float) -> Gray:
    image = context.background.copy()
    draw_board(image, context, T_world_board, board)
    return blur_image(image, blur)


def tag_corners(board: Board) -> Array:
    """(tags, 4, 3) board frame."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) / 2
    return np.stack([[*tag.center, 0] + tag.size * square for tag in board.tags])


@pytest.mark.parametrize("lens", LENSES)
def test_detected_checkerboard_corners_match_their_projection(lens: str, rng: np.random.Generator) -> None:
    camera = camera_model(LENSES[lens])
    context, board = build_render_context(camera, T_WORLD_CAMERA, (), rng), printed(CHECKERBOARD)
    grid = np.stack(np.meshgrid((np.arange(9) - 4) * 0.1, (np.arange(6) - 2.5) * 0.1), axis=-1).reshape(-1, 2)
    errors = []
    for placement in draw_placements(
        rng, np.radians([-20, -5, 15]).tolist(), [1.5, 2.2], 1, np.radians(25), (0.8, 1.0)
    ):
        image = cv2.convertScaleAbs(render_board(context, pose_from_placement(placement), board, 0.6))
        T_camera_board = se3.inverse(T_WORLD_CAMERA) @ pose_from_placement(placement)
        pixels = camera.project(se3.apply(T_camera_board, np.pad(grid, ((0, 0), (0, 1)))))
        pixels = pixels[((pixels > 15) & (pixels < [944, 704])).all(axis=1)]
        # The search starts off the truth, so that finding it is the image's merit.
        start = (pixels + 0.3).astype(np.float32).reshape(-1, 1, 2)
        errors.append(cv2.cornerSubPix(image, start, (5, 5), (-1, -1), (3, 50, 1e-4)).reshape(-1, 2) - pixels)
    assert len(np.concatenate(errors)) > 250
    assert np.concatenate(errors).mean(axis=0) == pytest.approx([0, 0], abs=0.01)


def test_detected_tag_corners_match_their_projection(rng: np.random.Generator) -> None:
    tags = RigScenario().board
    camera = camera_model(LENSES["pinhole"])
    context, board, detector = (
        build_render_context(camera, T_WORLD_CAMERA, (), rng),
        printed(tags),
        Detector("tag36h11"),
    )
    # When it is collected it frees its families and then uses them, which corrupts the heap. Let it forget them.
    detector.tag_families.clear()
    errors = []
    for placement in draw_placements(
        rng, np.radians([-15, 0, 15]).tolist(), [1.6, 2.4], 2, np.radians(25), (0.8, 1.0)
    ):
        image = cv2.convertScaleAbs(render_board(context, pose_from_placement(placement), board, 0.6))
        T_camera_board = se3.inverse(T_WORLD_CAMERA) @ pose_from_placement(placement)
        truth = camera.project(se3.apply(T_camera_board, tag_corners(tags).reshape(-1, 3)))
        for detection in detector.detect(image):
            # The detector puts the centre of the top-left pixel at (0.5, 0.5).
            detected = detection.corners - 0.5
            nearest = np.linalg.norm(detected[:, None] - truth, axis=2).argmin(axis=1)
            errors.append(detected - truth[nearest])
    assert len(errors) > 30
    assert np.concatenate(errors).mean(axis=0) == pytest.approx([0, 0], abs=0.02)


def test_tags_are_upright_in_the_image(rng: np.random.Generator) -> None:
    tag = Board(size=(0.8, 0.8), tags=(Tag(id=3, size=0.4),))
    camera = camera_model(CameraOptions(width=640, height=480))
    (placement,) = draw_placements(rng, [0.0], [1.5], 1, 0.0, (0.9, 0.9))
    image = cv2.convertScaleAbs(
        render_board(
            build_render_context(camera, T_WORLD_CAMERA, (), rng),
            pose_from_placement(placement),
            printed(tag),
            0.5,
        )
    )
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, _, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
    half = 320 * 0.2 / 1.5
    expected = np.array([319.5, 239.5]) + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    assert np.reshape(corners[0], (4, 2)) == pytest.approx(expected, abs=1.0)


def test_the_back_of_the_board_shows_no_tags(rng: np.random.Generator) -> None:
    camera = camera_model(CameraOptions(width=640, height=480))
    (placement,) = draw_placements(rng, [0.0], [1.5], 1, 0.0, (0.9, 0.9))
    turned = pose_from_placement(placement) @ se3.pose(np.diag([-1.0, 1, -1]), np.zeros(3))
    image = render_board(
        build_render_context(camera, T_WORLD_CAMERA, (), rng), turned, printed(RigScenario().board), 0.0
    )
    assert image[200:280, 250:390] == pytest.approx(image[240, 320], abs=0.01)


def test_a_board_outside_the_view_leaves_the_image_unchanged(rng: np.random.Generator) -> None:
    camera = camera_model(CameraOptions(width=320, height=240))
    context = build_render_context(camera, T_WORLD_CAMERA, (), rng)
    (placement,) = draw_placements(rng, [np.pi], [1.5], 1, 0.0, (0.9, 0.9))
    assert (
        render_board(context, pose_from_placement(placement), printed(CHECKERBOARD), 0.0) == context.background
    ).all()


def test_image_noise_has_the_stated_deviation(rng: np.random.Generator) -> None:
    camera = camera_model(CameraOptions(width=320, height=240))
    noisy = draw_noise_pool(camera, 3.0, rng).add(np.full((240, 320), 100, dtype=np.float32), rng)
    assert noisy.mean() == pytest.approx(100, abs=0.05)
    # Rounding to whole grey values adds 1/12 to the variance.
    assert noisy.std() == pytest.approx(np.sqrt(9 + 1 / 12), rel=0.02)


def test_a_board_that_leans_back_is_brighter_under_lamps_at_the_ceiling(rng: np.random.Generator) -> None:
    """Normals 30° up and down: 0.91 and 0.72 of full light."""
    camera = camera_model(LENSES["pinhole"])
    context = build_render_context(camera, T_WORLD_CAMERA, (), rng)
    (placement,) = draw_placements(rng, [0.0], [1.5], 1, 0.0, (0.9, 0.9))
    blank = printed(Board(size=(1.2, 0.9)))
    up, down = (
        render_board(context, pose_from_placement(replace(placement, R_facing_board=so3.exp(turn))), blank, 0.0)
        for turn in (np.array([-np.pi / 6, 0, 0]), np.array([np.pi / 6, 0, 0]))
    )
    assert up[360, 480] / down[360, 480] == pytest.approx(0.91 / 0.72, rel=0.01)
