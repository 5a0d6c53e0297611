"""Boards located by each camera alone, with the errors of its lens and of the prints estimated from all its views.

Pairs compare boards as single views locate them: a focal length that is wrong by 3 %, or tags of another size,
move boards by several centimetres, which RANSAC takes for outliers. The views of one camera determine these errors
without any other sensor.

Source: Zhang, "A flexible new technique for camera calibration", 2000.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calgraph.boards.board_pose import plane_covariance
from calgraph.boards.detections import BoardCorners, Detection
from calgraph.config import Rig
from calgraph.errors import CalibrationError
from calgraph.geometry import plane
from calgraph.rig.bundle.board_observations import BoardObservation
from calgraph.rig.bundle.bundle_setup import build_bundle
from calgraph.rig.bundle.bundle_solver import COARSE_TOLERANCE, minimize_bundle
from calgraph.rig.captures.detect import CaptureSet


def locate_boards(rig: Rig, captured: CaptureSet) -> CaptureSet:
    """The captures with the boards' poses before cameras as the systematic errors of lens and print imply them.

    The errors have the priors of rig.yaml. Pixels and covariances stay as they are.

    Args:
        rig: the rig.
        captured: all detections.
    """
    detections = {
        name: _locate(rig, captured, name) if name in captured.cameras else found
        for name, found in captured.detections.items()
    }
    return replace(captured, detections=detections)


def scale_boards(captured: CaptureSet, print_scale: Mapping[int, float]) -> CaptureSet:
    """The captures with the boards as far from cameras as prints of another size are.

    A camera alone does not determine the size of a print: its positions of the board are proportional to it.

    Args:
        captured: all detections.
        print_scale: true over stated size by index of the board; 1 for others.
    """
    return replace(
        captured,
        detections={
            name: {
                capture: tuple(_scale(one, print_scale) for one in found) for capture, found in by_capture.items()
            }
            if name in captured.cameras
            else by_capture
            for name, by_capture in captured.detections.items()
        },
    )


def _scale(detection: Detection, print_scale: Mapping[int, float]) -> Detection:
    assert isinstance(detection, BoardCorners)
    T = detection.T_camera_board.copy()
    T[:3, 3] *= print_scale.get(detection.board, 1.0)
    return _move(detection, T)


def _locate(rig: Rig, captured: CaptureSet, name: str) -> Mapping[int, tuple[Detection, ...]]:
    """The detections of one camera with other poses."""
    detections = captured.detections[name]
    boards = [
        BoardObservation(capture, {name: k}) for capture, found in detections.items() for k in range(len(found))
    ]
    if not boards:
        return detections
    bundle, start = build_bundle(rig, captured, boards, {name: np.eye(4)})
    try:
        # A bias of a view displaces its board, and nothing else.
        exact = replace(bundle, bias_variance=np.zeros_like(bundle.bias_variance))
        solution = minimize_bundle(exact, start, tolerance=COARSE_TOLERANCE, exact=False)
    except CalibrationError:
        return detections
    poses = {
        (board.capture, board.detection_index[name]): T
        for board, T in zip(boards, solution.state.T_root_board, strict=True)
    }
    return {
        capture: tuple(_move(one, poses[capture, k]) for k, one in enumerate(found))
        for capture, found in detections.items()
    }


def _move(detection: Detection, T_camera_board: np.ndarray) -> Detection:
    assert isinstance(detection, BoardCorners)
    return replace(
        detection,
        T_camera_board=T_camera_board,
        plane=plane.from_pose(T_camera_board),
        plane_covariance=plane_covariance(T_camera_board, detection.covariance),
    )
