"""Colours of points in the pictures of several cameras."""

import cv2
import numpy as np
import pytest

from calgraph.geometry.se3 import pose
from calgraph.result import Snapshot, colorize_from_snapshots
from calgraph.sensors import CameraModel

CAMERA = CameraModel("pinhole", 64, 48, np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), np.zeros(0))
# Beside each other, looking the same way: both see the middle, each alone one side.
T_ROOT_SENSOR = {"left": pose(np.eye(3), np.array([-0.5, 0, 0])), "right": pose(np.eye(3), np.array([0.5, 0, 0]))}
CAMERAS = dict.fromkeys(T_ROOT_SENSOR, CAMERA)
POINTS = np.array([[-1.5, 0, 2], [0, 0, 2], [1.5, 0, 2], [0, 0, -2]])
RED, BLUE, NONE = [254, 0, 0], [0, 0, 254], [0, 0, 0]


def taken(sensor: str, rgb: list[int]) -> Snapshot:
    bgr = np.broadcast_to(np.array(rgb[::-1], dtype=np.uint8), (48, 64, 3))
    return Snapshot(0, sensor, 0.0, cv2.imencode(".jpg", bgr)[1].tobytes(), 64, 48)


def test_each_point_has_the_colour_of_the_first_picture_that_shows_it() -> None:
    colors, seen = colorize_from_snapshots(
        POINTS, [taken("left", RED), taken("right", BLUE)], CAMERAS, T_ROOT_SENSOR
    )
    assert seen.tolist() == [True, True, True, False]
    assert np.abs(colors.astype(int) - [RED, RED, BLUE, NONE]).max() <= 2


@pytest.mark.parametrize("unknown", [{"cameras": {}}, {"T_root_sensor": {}}])
def test_pictures_of_cameras_without_intrinsics_or_pose_are_left(unknown: dict[str, dict[str, object]]) -> None:
    known = {"cameras": CAMERAS, "T_root_sensor": T_ROOT_SENSOR} | unknown
    colors, seen = colorize_from_snapshots(POINTS, [taken("left", RED)], **known)  # type: ignore[arg-type]
    assert not seen.any()
    assert not colors.any()
