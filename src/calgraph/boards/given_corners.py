"""Corners that another program detected: which printed corners of a board they are."""

import numpy as np

from calgraph.boards.landmarks import Landmarks
from calgraph.boards.tags import Marks
from calgraph.config import Board, Charuco, Checkerboard
from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.sensors import DetectedCorners

_MAX_OFFSET = 0.01
"""Maximum distance of a corner from the printed one over the edge of a square: programs state positions that they
compute, and a board of another size differs by more at one corner at least."""
_TURN_OVER = np.diag([-1.0, 1.0, -1.0, 1.0])
"""Half a turn about the board's y axis."""


def assign_corners(message: DetectedCorners, board: Board, landmarks: Landmarks) -> Marks:
    """The printed corners that a message has, by their positions on the board.

    Positions are in OpenCV's frame of object points: x right, y down, the origin at the top left of a ChArUco
    board, and at the top left inner corner of a checkerboard.

    Args:
        message: as another program detected them.
        board: with a checkerboard or a ChArUco board.
        landmarks: of the board.

    Raises:
        InputError: the board has another print, or no printed corner at one of the positions.
    """
    pattern = board.pattern
    if not isinstance(pattern, Charuco | Checkerboard):
        raise InputError("target: detected corners are of a checkerboard or a ChArUco board; state its pattern")
    # The corner of the frame, of a ChArUco board a square away from the first inner corner.
    margin = pattern.square if isinstance(pattern, Charuco) else 0.0
    origin = landmarks.corners[0, 0] + [-margin, margin, 0.0]
    positions = message.board_points * [1.0, -1.0, 1.0] + origin
    distance = np.linalg.norm(positions[:, None] - landmarks.corners[None, :, 0], axis=-1)
    nearest = distance.argmin(axis=1)
    worst = distance.min(axis=1)
    if len(worst) and worst.max() > _MAX_OFFSET * pattern.square:
        x, y, z = message.board_points[worst.argmax()]
        raise InputError(
            f"target: the corner detected at ({x:g}, {y:g}, {z:g}) m of the board is {1000 * worst.max():.1f} mm "
            f"from the nearest corner of the {pattern.columns}x{pattern.rows} {pattern.kind} in rig.yaml: state "
            "the pattern that the corners were detected with"
        )
    return Marks(landmarks.ids[nearest], message.pixels[:, None])


def is_mirrored(corners: Array, pixels: Array) -> bool:
    """Whether an image shows a print from behind: mirrored on the back of the board, or through a transparent one.

    Args:
        corners: (N, 3) in the board frame, m.
        pixels: (N, 2) where they were detected.
    """
    A = np.column_stack([corners[:, :2], np.ones(len(corners))])
    affine = np.linalg.lstsq(A, pixels, rcond=None)[0][:2]
    # From the front, y is up on the board and down in the image.
    return bool(np.linalg.det(affine) > 0)


def mirror(corners: Array) -> Array:
    """Corners (..., 3) of a print on the back of the board, in the frame of a reader of that side."""
    return corners * [-1.0, 1.0, 1.0]


def turn_over(T_camera_back: Array) -> Array:
    """``T_camera_board`` (4, 4) from the pose of the board's back, whose print is behind the one on its front."""
    return np.asarray(T_camera_back @ _TURN_OVER)
