"""The beams of a scanner that measure a board, and the pairs of neighbours between which its outline runs."""

from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array, Index, se3
from calgraph.sensors.beam_pattern import BeamPattern

_OUTLINE_MARGIN = 0.02
"""Beams this near to the board's outline are left out, as detectors do, m."""
_MIN_GRAZING = 1e-6
"""Minimum cosine between a beam and the board's normal; keeps divisions finite."""
MIN_BEAMS, MIN_POINTS, MIN_RINGS = 5, 20, 3
"""Minimum numbers of beams of a 2-D scanner, and of beams and rings of a 3-D scanner, on a detected board."""

Pair = tuple[float, float]


def find_beams_on_board(pattern: BeamPattern, T_sensor_board: Array, size: Pair, limits: Pair) -> Index:
    """Indices of the beams of one sweep that hit a board clear of its outline, within range.

    Args:
        pattern: the beams.
        T_sensor_board: (4, 4).
        size: width and height of the board, m.
        limits: least and largest range, m.
    """
    reach, hit = _meet_plane(pattern, T_sensor_board)
    on = np.all(np.abs(hit) <= 0.5 * np.array(size) - _OUTLINE_MARGIN, axis=1)
    return np.flatnonzero(on & (reach >= limits[0]) & (reach <= limits[1]))


def _meet_plane(pattern: BeamPattern, T_sensor_board: Array) -> tuple[Array, Array]:
    """Distances (N,) along the beams to the plane of a board, m, and their places (N, 2) on it, in its frame."""
    T_board_sensor = se3.inverse(T_sensor_board)
    origins = se3.apply(T_board_sensor, np.broadcast_to(pattern.origins, pattern.directions.shape))
    along = pattern.directions @ T_board_sensor[:3, :3].T
    reach = -origins[:, 2] / np.where(np.abs(along[:, 2]) < _MIN_GRAZING, np.nan, along[:, 2])
    return reach, (origins + reach[:, None] * along)[:, :2]


@dataclass(frozen=True, eq=False)
class OutlineCrossings:
    """Pairs of neighbouring beams, of which the first hits a board and the second misses it."""

    last: Index
    """(M,) the beams that hit,"""
    past: Index
    """(M,) and those that miss."""
    hit: Array
    """(M, 2) where the former meet the plane of the board, in its frame, m."""
    step: Array
    """(M, 2) from there to where the latter meet it, m."""
    share: Array
    """(M, 1) share of this step at which the outline is."""


def find_crossings(pattern: BeamPattern, T_sensor_board: Array, size: Pair, limits: Pair) -> OutlineCrossings:
    """The outline's crossings with the beams of one sweep; arguments as of :func:`find_beams_on_board`."""
    half = 0.5 * np.array(size)
    reach, hit = _meet_plane(pattern, T_sensor_board)
    ahead = (reach >= limits[0]) & (reach <= limits[1])
    on = ahead & np.all(np.abs(hit) <= half, axis=1)
    ends = np.flatnonzero(ahead & ahead[pattern.neighbours] & (on != on[pattern.neighbours]))
    other = pattern.neighbours[ends]
    last, past = np.where(on[ends], ends, other), np.where(on[ends], other, ends)
    step = hit[past] - hit[last]
    # The side of the outline that is crossed first, and where.
    walls = (np.sign(step) * half - hit[last]) / np.where(step == 0, np.nan, step)
    side = np.nanargmin(walls, axis=1)[:, None]
    return OutlineCrossings(last, past, hit[last], step, np.take_along_axis(walls, side, axis=1))
