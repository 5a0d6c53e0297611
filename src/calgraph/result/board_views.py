"""Measurements of the board by each sensor, and its estimated outline: for pictures."""

from dataclasses import dataclass

from calgraph.geometry import Array


@dataclass(frozen=True, eq=False)
class BoardOutline:
    """The estimated outline of the board in one capture, for pictures."""

    capture: int
    corners: Array
    """(4, 3) corners of the board, or of the detected patch, root frame, m; of a board whose print was detected,
    anticlockwise from the bottom left as a reader sees it."""
    board: int | None = None
    """Index of the board among the rig's boards, where a camera detected its print."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """Measurements of one board by one sensor in one capture, and their residuals under the joint solution."""

    capture: int
    sensor: str
    used: bool
    """Whether the joint solution used it."""
    measured: Array
    """(M, 2) printed corners, px, of a camera; (M, 3) points in the frame of a scanner, m, thinned."""
    residuals: Array | None = None
    """Measured minus predicted by the joint solution: (M, 2) px of a camera; of a scanner (M,) distances from the
    board's plane, m, positive beyond it. None where it was not used, or the estimator has no boards."""
