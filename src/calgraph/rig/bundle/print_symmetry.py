"""Gives corners of symmetric checkerboards the same numbers in all cameras.

A checkerboard whose colours a half turn or quarter turn preserves looks the same in several orientations. Each
camera takes the end that is up in its image for the top of the print, so that cameras that are mounted upside-down
number the corners in another order. Pairs compare the boards' planes, which do not depend on the orientation; the
poses that they imply determine it.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calgraph.boards.detections import BoardCorners, Detection
from calgraph.config import Checkerboard, Rig
from calgraph.geometry import Array, se3, so3
from calgraph.rig.captures.detect import CaptureSet


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
