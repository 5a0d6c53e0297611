"""Checkerboards that look the same after a turn, before cameras of which some are mounted upside-down."""

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners
from calgraph.config import Board, CameraSpec, Charuco, Checkerboard, Rig, SensorSpec
from calgraph.geometry import Array, se3, so3
from calgraph.rig.bundle.camera_boards import align_symmetric_prints, symmetry_turns, turn_corners
from calgraph.rig.captures.from_detections import captures_from_detections
from calgraph.rig.detection.from_measurements import board_corners_from_pixels
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_jointly
from calgraph.sensors import CameraModel

CAMERA = CameraModel("pinhole", 640, 480, np.array([[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]]), np.zeros(0))
UPSIDE_DOWN = se3.pose(so3.exp(np.array([0.1, -0.2, 3.0])), np.array([0.3, 0.2, 0.1]))
"""Of the second camera before the first."""


def checkerboard(columns: int, rows: int, center: tuple[float, float] = (0.0, 0.0)) -> Checkerboard:
    return Checkerboard(kind="checkerboard", columns=columns, rows=rows, square=0.1, center=center)


def rig_with(pattern: Checkerboard) -> Rig:
    cameras: dict[str, SensorSpec] = {name: CameraSpec(topic=f"/{name}") for name in ("first", "second")}
    return Rig(root="first", target=Board(size=(1.2, 1.0), pattern=pattern), sensors=cameras)


def corners_of(pattern: Checkerboard) -> Array:
    x, y = np.meshgrid(np.arange(pattern.columns), np.arange(pattern.rows))
    middle = np.array([pattern.columns - 1, pattern.rows - 1]) / 2
    return (np.stack([x.ravel(), y.ravel()], axis=1) - middle) * [0.1, -0.1] + pattern.center


def numbered_from_the_top(pattern: Checkerboard, T_camera_board: Array, rng: np.random.Generator) -> BoardCorners:
    """The detection as of an image, where the end that is up is taken for the top of the print."""
    corners = corners_of(pattern)
    pixels = CAMERA.project(se3.apply(T_camera_board, np.column_stack([corners, np.zeros(len(corners))])))
    if pixels[0, 1] > pixels[-1, 1]:
        pixels = pixels[::-1]
    found = board_corners_from_pixels(corners, pixels + 0.1 * rng.normal(size=pixels.shape), CAMERA)
    assert isinstance(found, BoardCorners)
    return found


def detect(pattern: Checkerboard, captures: int, rng: np.random.Generator) -> dict[str, dict[int, BoardCorners]]:
    """By both cameras: the board tilted and turned at random."""
    by_sensor: dict[str, dict[int, BoardCorners]] = {"first": {}, "second": {}}
    for capture in range(captures):
        R = np.diag([1.0, -1.0, -1.0]) @ so3.exp(rng.uniform(-0.6, 0.6, 3))
        T = se3.pose(R, np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(1.6, 2.4)]))
        by_sensor["first"][capture] = numbered_from_the_top(pattern, T, rng)
        by_sensor["second"][capture] = numbered_from_the_top(pattern, se3.inverse(UPSIDE_DOWN) @ T, rng)
    return by_sensor


def test_a_camera_upside_down_is_calibrated_with_a_symmetric_print(rng: np.random.Generator) -> None:
    pattern, cameras = checkerboard(6, 4), {"first": CAMERA, "second": CAMERA}
    rig = rig_with(pattern)
    captures = captures_from_detections(rig, detect(pattern, 15, rng), cameras)
    joint, _ = solve_jointly(build_problem_from_captures(rig, captures, RigOptions(), rng))
    off = se3.difference(joint.T_root_sensor["second"], UPSIDE_DOWN)
    assert np.abs(off[:3]).max() < 2e-3
    assert np.abs(off[3:]).max() < 3e-3
    assert not joint.rejected


@pytest.mark.parametrize("center", [(0.0, 0.0), (0.05, -0.03)])
def test_corners_have_one_number_in_all_cameras(center: tuple[float, float], rng: np.random.Generator) -> None:
    """Each corner is where the first camera locates it, and its pose and covariance are those of a new fit."""
    pattern = checkerboard(6, 4, center)
    cameras = {"first": CAMERA, "second": CAMERA}
    found = captures_from_detections(rig_with(pattern), detect(pattern, 4, rng), cameras)
    aligned = align_symmetric_prints(rig_with(pattern), found, {"first": np.eye(4), "second": UPSIDE_DOWN})
    for capture in range(4):
        first, second = (aligned.detections[name][capture][0] for name in ("first", "second"))
        assert first is found.detections["first"][capture][0]
        assert isinstance(first, BoardCorners)
        assert isinstance(second, BoardCorners)
        np.testing.assert_allclose(UPSIDE_DOWN @ second.T_camera_board, first.T_camera_board, atol=0.03)
        again = board_corners_from_pixels(second.corners_board, second.pixels, CAMERA)
        assert isinstance(again, BoardCorners)
        np.testing.assert_allclose(second.T_camera_board, again.T_camera_board, atol=1e-5)
        # The noise of corners is that which all detections have.
        scale = np.trace(second.covariance) / np.trace(again.covariance)
        np.testing.assert_allclose(second.covariance, scale * again.covariance, rtol=1e-2, atol=1e-10)


@pytest.mark.parametrize(("columns", "rows", "count"), [(6, 4, 1), (7, 5, 1), (7, 4, 0), (6, 6, 3), (5, 5, 1)])
def test_turns_preserve_corners_and_colours(columns: int, rows: int, count: int) -> None:
    pattern = checkerboard(columns, rows, (0.2, 0.1))
    turns, corners = symmetry_turns(pattern), corners_of(pattern)
    assert len(turns) == count
    squares = np.array([
        corners[0] + [0.1 * (column - 0.5), -0.1 * (row - 0.5)]
        for row in range(rows + 1)
        for column in range(columns + 1)
    ])  # fmt: skip
    dark = np.add.outer(np.arange(rows + 1), np.arange(columns + 1)).ravel() % 2 == 0
    for turn in turns:
        for points in (corners, squares, squares[dark]):
            turned = se3.apply(turn, np.column_stack([points, np.zeros(len(points))]))[:, :2]
            distance = np.linalg.norm(turned[:, None] - points, axis=-1)
            assert distance.min(axis=1).max() < 1e-9


def test_identified_corners_have_no_symmetry() -> None:
    charuco = Charuco(kind="charuco", columns=7, rows=5, square=0.1, marker=0.07, dictionary="DICT_5X5_100")
    assert symmetry_turns(charuco) == ()


def test_two_half_turns_are_none(rng: np.random.Generator) -> None:
    pattern = checkerboard(6, 4, (0.05, 0.02))
    one, (turn,) = detect(pattern, 1, rng)["first"][0], symmetry_turns(pattern)
    twice = turn_corners(turn_corners(one, turn), turn)
    np.testing.assert_allclose(twice.corners_board, one.corners_board, atol=1e-12)
    np.testing.assert_allclose(twice.T_camera_board, one.T_camera_board, atol=1e-12)
    np.testing.assert_allclose(twice.covariance, one.covariance, atol=1e-15)
