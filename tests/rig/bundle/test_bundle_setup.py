"""Bundles of boards that a camera's model projects in part only."""

import numpy as np
import pytest

from calgraph.boards.detections import BoardCorners
from calgraph.boards.printed_boards import compute_landmarks
from calgraph.errors import CalibrationError
from calgraph.geometry import plane, se3, so3
from calgraph.rig.bundle.board_observations import BoardObservation
from calgraph.rig.bundle.bundle_setup import build_bundle
from calgraph.rig.bundle.bundle_solver import Bundle, minimize_bundle
from calgraph.rig.bundle.corner_observations import CornerObservations
from calgraph.rig.captures.detect import CaptureSet
from calgraph.sensors import CameraModel
from camera_views import checkerboard_rig

K = np.array([[500, 0, 639.5], [0, 500, 479.5], [0, 0, 1]])
CAMERA = CameraModel("pinhole", 1280, 960, K, np.array([-0.3, 0.0, 0.0, 0.0, 0.0]))
"""Its polynomial has an extremum at 46.5 degrees."""


def build(angle: float) -> Bundle:
    """The bundle of one view of a board, 1 m before the camera and at an angle (degrees) from its axis."""
    rig = checkerboard_rig()
    corners = compute_landmarks(rig.boards[0]).corners.reshape(-1, 3)
    R = so3.exp(np.array([0, np.radians(angle), 0]))
    T = se3.pose(R @ np.diag([1.0, -1.0, -1.0]), R @ [0, 0, 1.0])
    exact = CameraModel("pinhole", 1280, 960, K, np.zeros(5))
    found = BoardCorners(
        corners_board=corners, pixels=exact.project(se3.apply(T, corners)), T_camera_board=T,
        covariance=1e-6 * np.eye(6), plane=plane.from_pose(T), plane_covariance=np.eye(3), rms=0.1,
    )  # fmt: skip
    captures = CaptureSet(0.0, {"camera": ""}, (), {"camera": {0: (found,)}}, {}, {"camera": CAMERA})
    bundle, start = build_bundle(rig, captures, [BoardObservation(0, {"camera": 0})], {"camera": np.eye(4)})
    minimize_bundle(bundle, start, iterations=1)
    return bundle


def count_corners(bundle: Bundle) -> int:
    return sum(len(views.pixels) for views in bundle.views if isinstance(views, CornerObservations))


def test_all_corners_before_a_camera_are_used() -> None:
    assert count_corners(build(10.0)) == 48


def test_corners_beyond_the_model_of_a_lens_are_left_out() -> None:
    assert 4 <= count_corners(build(40.0)) < 48


def test_a_board_beyond_the_model_of_a_lens_is_behind_the_camera() -> None:
    with pytest.raises(CalibrationError, match="a board is behind a camera"):
        build(89.0)
