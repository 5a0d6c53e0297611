"""What each sensor saw of the board, beside where the joint solution has it: for pictures."""

from dataclasses import dataclass

from calgraph.geometry import Array


@dataclass(frozen=True, eq=False)
class BoardOutline:
    """Where the board was in one capture, for pictures."""

    capture: int
    corners: Array
    """(4, 3) corners of the sheet or of the patch seen, root frame, m; of a sheet whose print was seen,
    anticlockwise from the bottom left as its reader sees it."""
    board: int | None = None
    """Which of the rig's boards, where a camera saw its print."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """What one sensor saw of one board in one capture, and how far that is from the joint solution."""

    capture: int
    sensor: str
    used: bool
    """Whether the joint solution used it."""
    measured: Array
    """(M, 2) printed corners, px, of a camera; (M, 3) points in the frame of a scanner, m, thinned."""
    residuals: Array | None = None
    """Measured minus predicted by the joint solution: (M, 2) px of a camera; of a scanner (M,) distances from the
    board's plane, m, positive beyond it. None where it was not used, or the estimator has no boards."""
