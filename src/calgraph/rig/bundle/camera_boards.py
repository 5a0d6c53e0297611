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
from calgraph.config import Checkerboard, Rig
from calgraph.errors import CalibrationError
from calgraph.geometry import Array, plane, se3, so3
from calgraph.rig.bundle.board_observations import BoardObservation
from calgraph.rig.bundle.bundle_setup import build_bundle
from calgraph.rig.bundle.bundle_solver import COARSE_TOLERANCE, minimize_bundle
from calgraph.rig.captures.detect import CaptureSet


def locate_boards(rig: Rig, captured: CaptureSet) -> CaptureSet:
    """The captures with the boards' poses before cameras as the systematic errors of lens and print imply them.

    The errors have the priors of rig.yaml. Pixels and covariances stay as they are.
    """
    detections = {
        name: _locate(rig, captured, name) if name in captured.cameras else found
        for name, found in captured.detections.items()
    }
    return replace(captured, detections=detections)


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


def align_symmetric_prints(rig: Rig, captured: CaptureSet, T_root_sensor: Mapping[str, Array]) -> CaptureSet:
    """The captures with corners of symmetric prints as the first camera numbers them that detected the board.

    Args:
        rig: the rig.
        captured: all detections.
        T_root_sensor: approximate poses (4, 4) of the connected sensors.
    """
    turns = [symmetry_turns(board.pattern) for board in rig.boards]
    if not any(turns):
        return captured
    detections = dict(captured.detections)
    first: dict[tuple[int, int], Array] = {}
    for name, T in T_root_sensor.items():
        if name in captured.cameras:
            detections[name] = {
                capture: tuple(_align(one, turns, T, first, capture) for one in found)
                for capture, found in detections[name].items()
            }
    return replace(captured, detections=detections)


def symmetry_turns(pattern: object) -> tuple[Array, ...]:
    """Turns (4, 4) of the board, besides none, by which a print maps to itself."""
    if not isinstance(pattern, Checkerboard) or (pattern.columns + pattern.rows) % 2:
        return ()
    # A quarter turn preserves the colours of an odd number of squares only.
    quarter = pattern.columns == pattern.rows and pattern.columns % 2 == 0
    center = np.array([*pattern.center, 0.0])
    turns = []
    for angle in (np.pi / 2, np.pi, -np.pi / 2) if quarter else (np.pi,):
        R = np.rint(so3.exp(np.array([0.0, 0.0, angle])))
        turns.append(se3.pose(R, center - R @ center))
    return tuple(turns)


def _align(
    detection: Detection,
    turns: list[tuple[Array, ...]],
    T_root_camera: Array,
    first: dict[tuple[int, int], Array],
    capture: int,
) -> Detection:
    """A detection as the first camera numbers its corners: ``first`` has its rotations by capture and board."""
    assert isinstance(detection, BoardCorners)
    R = T_root_camera[:3, :3] @ detection.T_camera_board[:3, :3]
    reference = first.setdefault((capture, detection.board), R)
    between = reference.T @ R
    # The cosine of an angle of rotation grows with the trace.
    best = max([np.eye(4), *turns[detection.board]], key=lambda turn: float(np.trace(between @ turn[:3, :3])))
    return detection if np.array_equal(best, np.eye(4)) else turn_corners(detection, best)


def turn_corners(detection: BoardCorners, turn: Array) -> BoardCorners:
    """The detection in a board frame that is turned: ``T_camera_board @ turn`` (4, 4)."""
    T = detection.T_camera_board @ turn
    J = np.eye(6)
    J[:3, 3:] = -so3.hat(T[:3, 3] - detection.T_camera_board[:3, 3])
    return replace(
        detection,
        corners_board=se3.apply(se3.inverse(turn), detection.corners_board),
        T_camera_board=T,
        covariance=J @ detection.covariance @ J.T,
    )
