"""Observations of boards: their start poses, and which board of the rig they are of."""

import numpy as np
import pytest

from board_scenes import detect_boards, make_boards
from calgraph.boards.detections import Detection, Segment
from calgraph.geometry import Array, se3, so3
from calgraph.rig.bundle.board_observations import BoardObservation, board_number, initial_board_pose

T_ROOT_SENSOR = {"level": np.eye(4), "rolled": se3.pose(so3.exp(np.array([1.0, 0, 0])), np.array([0.1, 0, 0.2]))}


def detect_segments(scene: Array, rng: np.random.Generator) -> dict[str, dict[int, tuple[Detection, ...]]]:
    return {name: detect_boards("line", se3.inverse(T), scene, rng) for name, T in T_ROOT_SENSOR.items()}


@pytest.mark.parametrize("distance", [0.0, 2.0])
@pytest.mark.parametrize("seed", range(4))
def test_boards_before_two_line_scanners_face_them(seed: int, distance: float) -> None:
    """The normal z points to the scanners, whether the root is beside them or behind the board."""
    rng = np.random.default_rng(seed)
    detections = detect_segments(make_boards(rng, 40), rng)
    capture = next(i for i in detections["level"] if i in detections["rolled"])
    (first,) = detections["level"][capture]
    assert isinstance(first, Segment)
    T_root_level = se3.pose(np.eye(3), -distance * first.center)
    poses = {name: T_root_level @ T for name, T in T_ROOT_SENSOR.items()}
    T = initial_board_pose(BoardObservation(capture, {"level": 0, "rolled": 0}), detections, poses)
    assert T[:3, 2] @ (T_root_level[:3, 3] - T[:3, 3]) > 0
    assert np.abs((se3.apply(T_root_level, first.points) - T[:3, 3]) @ T[:3, 2]).max() < 0.05
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_without_a_camera_the_board_is_of_no_number(rng: np.random.Generator) -> None:
    scene = make_boards(rng, 40)
    detections = detect_segments(scene, rng)
    capture = next(i for i in detections["level"] if i in detections["rolled"])
    observation = BoardObservation(capture, {"level": 0, "rolled": 0})
    assert board_number(observation, detections) == -1
