"""Edges of a board in a scan: between the last beam on it and the first one past it.

The end of a board in a scan is an edge of the board only if the next beam ends behind it. Where something nearer
begins (a hand, an occluder), or the field of view ends, the board may continue.
"""

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import ScannerDetectionSettings
from calgraph.geometry import Array, Index, measure_lengths
from calgraph.sensors import SAME_DIRECTION

# Bound of ranges before the plane, m: beams that do not intersect it have an infinite one.
_FAR = 1e3


def select_beams_with_margin(near: NDArray[np.bool_]) -> Index:
    """Indices of the beams (N,) that pass near the board, and of two beams on either side of each."""
    return np.flatnonzero(np.convolve(near, np.ones(5), mode="same") > 0.5)


def find_board_edges(
    directions: Array,
    excess: Array,
    scan_line: Index,
    thickness: float,
    settings: ScannerDetectionSettings,
    parallax: float,
) -> Array:
    """Pairs of beams between which the board ends.

    Args:
        directions: (N, 3) unit vectors of beams that measured something, line by line, each in order of angle;
            equal for several returns of one beam.
        excess: (N,) range beyond the board's plane, m; negative where a beam ends before the plane, and where it
            does not intersect it.
        scan_line: (N,) scan line of each beam.
        thickness: a beam ends on the board up to this distance from its plane along the beam, m.
        settings: of the detection.
        parallax: error of the directions of beams that miss the board, as they do not start in the sensor's
            origin, rad. If it is not zero, directions do not show how many beams without return lie between two.

    Returns:
        (M, 2, 3) unit vectors: the last beam on the board, and the direction of the first one past it.
    """
    if not len(directions):
        return np.empty((0, 2, 3))
    directions, excess, scan_line = _join_returns(directions, np.maximum(excess, -_FAR), scan_line, thickness)
    on_board = np.abs(excess) < thickness
    adjacent = on_board[1:] & on_board[:-1] & (scan_line[1:] == scan_line[:-1])
    steps = measure_lengths(np.diff(directions, axis=0))[adjacent]
    if not len(steps):
        return np.empty((0, 2, 3))
    step = float(np.median(steps))
    orders = (slice(None), slice(None, None, -1))
    beams = [(directions[o], excess[o], on_board[o], scan_line[o]) for o in orders]
    return np.concatenate([_find_trailing_edges(*ordered, step, settings, parallax) for ordered in beams])


def _join_returns(
    directions: Array, excess: Array, scan_line: Index, thickness: float
) -> tuple[Array, Array, Index]:
    """One beam for each direction: neighbouring beams that differ measure the step, and are where an edge may be.

    A beam with returns from the board and from behind it ends between both, as a mixed pixel does. Of one that hit
    something nearer than the board, the nearest return counts: it may hide the edge.
    """
    starts = measure_lengths(np.diff(directions, axis=0)) > SAME_DIRECTION
    first = np.append(0, np.flatnonzero(starts | (np.diff(scan_line) != 0)) + 1)
    nearest = np.minimum.reduceat(excess, first)
    mean = np.add.reduceat(excess, first) / np.diff(np.append(first, len(excess)))
    return directions[first], np.where(nearest < -thickness, nearest, mean), scan_line[first]


# Maximum angle between beams on either side of an edge, in beam spacings: three beams may be missing.
_MAX_STEP_RATIO = 4.0
# Depth jump from a beam past the board to the next one, m, that makes it a mixed pixel of board and background:
# three times min_depth_jump, so that it ends clearly between both.
_MIN_MIXED_JUMP = 0.3


def _find_trailing_edges(
    directions: Array,
    excess: Array,
    on_board: NDArray[np.bool_],
    scan_line: Index,
    step: float,
    settings: ScannerDetectionSettings,
    parallax: float,
) -> Array:
    """Edges at which beams, in this order, leave the board."""
    # One beam off the board, on another scan line, ends the last one.
    directions, excess = np.pad(directions, ((0, 1), (0, 0)), mode="edge"), np.append(excess, 0.0)
    on_board, scan_line = np.append(on_board, False), np.append(scan_line, scan_line.max() + 1)
    if len(scan_line) < 4:
        return np.empty((0, 2, 3))
    previous, last, next_beam, after_next = (slice(i, len(scan_line) - 3 + i) for i in range(4))
    max_step = _MAX_STEP_RATIO * step
    gap = measure_lengths(directions[next_beam] - directions[last])
    last_step = directions[last] - directions[previous]
    step_length = measure_lengths(last_step)
    same_line = (scan_line[previous] == scan_line[last]) & (scan_line[last] == scan_line[next_beam])
    board_ends = same_line & on_board[previous] & on_board[last] & ~on_board[next_beam]
    board_ends &= step_length < max_step
    # Beams without return between others did not hit the board.
    near = gap < max_step + parallax
    no_return = ~near & (parallax == 0)
    behind = excess > settings.min_depth_jump
    # A beam between two depths is a mixed pixel: the edge may be on either side of it.
    mixed_pixel = near & (scan_line[after_next] == scan_line[next_beam]) & behind[after_next]
    mixed_pixel &= (excess[next_beam] > 0) & (excess[after_next] - excess[next_beam] > _MIN_MIXED_JUMP)
    is_edge = board_ends & (no_return | (near & behind[next_beam]) | mixed_pixel)
    steps = np.where(near, np.maximum(np.rint(gap / step), 1.0), 1.0) if parallax == 0 else np.ones(len(gap))
    angle_past = step * (steps + mixed_pixel)
    ratio = np.divide(angle_past, step_length, out=np.zeros_like(angle_past), where=step_length > 0)
    outside = directions[last] + last_step * ratio[:, None]
    pairs = np.stack([directions[last], outside / measure_lengths(outside)[:, None]], axis=1)
    return np.asarray(pairs[is_edge])
