"""What pictures of a calibration show: images and scans, outlines of boards, measurements, floor plans."""

from dataclasses import dataclass

from calgraph.geometry import Array
from calgraph.result.snapshots import Snapshot


@dataclass(frozen=True, eq=False)
class BoardOutline:
    """The estimated outline of the board in one capture, for pictures."""

    capture: int
    corners: Array
    """(4, 3) corners of the board, or of the detected patch, root frame, m; of a board whose print was detected,
    anticlockwise from the bottom left for a reader of the print."""
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


@dataclass(frozen=True, eq=False)
class BeamView:
    """Beams of one scanner of a network on moving objects, with their residuals; thinned."""

    sensor: str
    times: Array
    """(N,) of the beams by the root's clock, s from the start of the recording, ascending."""
    points: Array
    """(N, 2) ends of the beams in the scanner's frame, m."""
    residuals: Array
    """(N,) range measured minus predicted by the joint solution, m."""


@dataclass(frozen=True, eq=False)
class FloorView:
    """Static background and tracks of one scanner of a network."""

    sensor: str
    background: Array
    """(M, 2) static background, thinned, root frame, m."""
    tracks: tuple[Array, ...]
    """(N, 2) each, positions of a moving object, root frame, m."""
    times: tuple[Array, ...] = ()
    """(N,) each, times of the positions by the root's clock, s from the start of the recording."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """What pictures of a calibration show, kept in scene.npz; empty in a result read back without it."""

    snapshots: tuple[Snapshot, ...] = ()
    """Images, scans and clouds of captures."""
    board_outlines: tuple[BoardOutline, ...] = ()
    board_views: tuple[BoardView, ...] = ()
    floor_views: tuple[FloorView, ...] = ()
    """Static background and tracks of each connected scanner of a network."""
    beam_views: tuple[BeamView, ...] = ()
    """Beams of each scanner that took part in the joint solution of a network."""
