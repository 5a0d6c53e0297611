"""When the beams of detections were measured, and the random numbers of their detectors."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calgraph.boards.detections import Detection, PlanePatch, Segment
from calgraph.geometry import Array, measure_lengths
from calgraph.sensors import LaserScan, PointCloud


def make_generator(seed: int, messages: Sequence[PointCloud | LaserScan]) -> np.random.Generator:
    """The generator of one sensor and capture, independent of the order in which captures are searched."""
    first = messages[0].stamp if messages else 0.0
    return np.random.default_rng([seed, int(np.float64(first).view(np.uint64))])


# Directions of detections are those of beams but for rounding.
_MARGIN = 1e-6


def add_beam_times(
    detections: Sequence[Detection], messages: Sequence[PointCloud | LaserScan]
) -> tuple[Detection, ...]:
    """The detections in one message with the times of their beams; unchanged where these are not known.

    Args:
        detections: of a scanner.
        messages: that they were found in.
    """
    beams = _find_timed_beams(messages[0]) if len(messages) == 1 else None
    if beams is None:
        return tuple(detections)
    from scipy.spatial import cKDTree

    directions, times = _select_beams_near(*beams, detections)
    nearest = cKDTree(directions)  # one for all candidates: making it takes as long as all searches
    return tuple(
        replace(one, times=np.asarray(times[nearest.query(one.directions)[1]], dtype=np.float64))
        if isinstance(one, PlanePatch | Segment)
        else one
        for one in detections
    )


def _select_beams_near(directions: Array, times: Array, detections: Sequence[Detection]) -> tuple[Array, Array]:
    """The beams in the bounding boxes of the detections' directions, a tenth of a sweep."""
    near = np.zeros(len(directions), dtype=np.bool_)
    columns = np.ascontiguousarray(directions.T)
    for one in detections:
        if isinstance(one, PlanePatch | Segment):
            low, high = one.directions.min(axis=0) - _MARGIN, one.directions.max(axis=0) + _MARGIN
            inside = [(along >= a) & (along <= b) for along, a, b in zip(columns, low, high, strict=True)]
            near |= inside[0] & inside[1] & inside[2]
    return directions[near], times[near]


def _find_timed_beams(message: PointCloud | LaserScan) -> tuple[Array, Array] | None:
    """Directions (N, 3) and times (N,) of the beams with a measurement; None without times."""
    if isinstance(message, LaserScan):
        if message.time_increment == 0:
            return None
        angles = message.angles
        directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
        return directions, np.arange(len(angles), dtype=np.float64) * message.time_increment
    if message.times is None:
        return None
    norm = measure_lengths(message.points)
    some = norm > 0
    return np.asarray(message.points[some] / norm[some, None], dtype=np.float64), message.times[some]
