"""Boards located by each camera alone, where its lens or the print is not as stated."""

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners
from calgraph.geometry import Array, se3
from calgraph.rig.bundle.camera_boards import locate_boards
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from detected_rigs import DetectedRig, detect_rig
from rig_errors import BoardErrors, CameraErrors, ModelErrors


def camera_detections(captures: CaptureSet) -> dict[int, BoardCorners]:
    found = {c: one for c, (one,) in captures.detections["camera"].items() if isinstance(one, BoardCorners)}
    assert len(found) == len(captures.detections["camera"])
    return found


def position_errors(one: DetectedRig, captures: CaptureSet) -> Array:
    """Of the boards before the camera, m."""
    T_camera_root = se3.inverse(one.truth.T_root_sensor["camera"])
    true = {c: T_camera_root @ one.truth.boards[c].T_root_board for c in captures.detections["camera"]}
    found = camera_detections(captures)
    return np.array([np.linalg.norm(found[c].center - T[:3, 3]) for c, T in true.items()])


@pytest.mark.parametrize("focal_length", [(0.05, 0.05), (-0.1, 0.0)])
def test_boards_are_located_with_the_lens_that_all_views_imply(focal_length: tuple[float, float]) -> None:
    one = detect_rig(errors=ModelErrors(cameras={"camera": CameraErrors(focal_length=focal_length)}))
    located = locate_boards(one.rig, one.captures)
    assert np.median(position_errors(one, located)) < 0.25 * np.median(position_errors(one, one.captures))


def test_boards_hardly_move_where_the_lens_is_as_stated() -> None:
    one = detect_rig()
    located = locate_boards(one.rig, one.captures)
    assert np.median(position_errors(one, located)) < 0.01
    before, after = camera_detections(one.captures), camera_detections(located)
    assert all(np.array_equal(before[c].pixels, after[c].pixels) for c in before)
    assert {name: one.captures.detections[name] for name in ("lidar", "laser_front")} == {
        name: located.detections[name] for name in ("lidar", "laser_front")
    }


@pytest.mark.parametrize("print_scale", [-0.05, 0.1])
def test_camera_keeps_its_captures_where_the_print_has_another_size(print_scale: float) -> None:
    one = detect_rig(errors=ModelErrors(BoardErrors(print_scale=print_scale)))
    problem = build_problem_from_captures(one.rig, one.captures, RigOptions(), np.random.default_rng(0))
    calibration = solve_problem(problem)
    used = [row.used for row in calibration.evidence.captures if row.sensor == "camera"]
    assert np.mean(used) > 0.9
    off = calibration["camera"].T_root_sensor[:3, 3] - one.truth.T_root_sensor["camera"][:3, 3]
    assert np.linalg.norm(off) < 0.005
