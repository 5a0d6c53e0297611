"""Matches of two sensors' detections of the board, which pairs and inliers are estimated from."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import BoardCorners, Detection, PlanePatch, Segment, plane_of
from calgraph.geometry import Array
from calgraph.graph.pairwise_estimate import Matches
from calgraph.rig.pairs.line_matches import LineLineMatches, PlaneLineMatches
from calgraph.rig.pairs.plane_matches import PlanePlaneMatches

Candidates = Mapping[int, Sequence[Detection]]
"""Detections of one sensor by capture; several if it is ambiguous which of them is the board."""


def build_matches(
    candidates_a: Candidates, candidates_b: Candidates, size: tuple[float, float]
) -> tuple[NDArray[np.intp], Matches]:
    """The matches of two sensors by the geometric kinds of their detections, and their table (M, 3).

    Args:
        candidates_a: planes where one of the two sensors detects planes.
        candidates_b: planes or lines; with at least one common capture.
        size: width and height of the (largest) board, m.
    """
    table = tabulate_matches(candidates_a, candidates_b)
    a = [candidates_a[capture][i] for capture, i, _ in table]
    b = [candidates_b[capture][j] for capture, _, j in table]
    radius, diagonal = min(size) / 2, float(np.hypot(*size))
    match geometric_kind(a[0]), geometric_kind(b[0]):
        case "plane", "plane":
            return table, PlanePlaneMatches(*_stack_planes(a), *_stack_planes(b), radius, diagonal)
        case "plane", "line":
            return table, PlaneLineMatches(*_stack_planes(a), *_stack_segments(b), diagonal)
        case "line", "line":
            return table, LineLineMatches(*_stack_segments(a), *_stack_segments(b), diagonal)
        case kinds:
            raise ValueError(f"no matches between {' and '.join(kinds)}")


def tabulate_matches(candidates_a: Candidates, candidates_b: Candidates) -> NDArray[np.intp]:
    """Lists all pairs of candidates in common captures: (M, 3) rows of capture, index in a, index in b.

    Detections that cameras identified as different boards are not paired.
    """
    rows = [
        (capture, i, j)
        for capture in sorted(set(candidates_a) & set(candidates_b))
        for i, a in enumerate(candidates_a[capture])
        for j, b in enumerate(candidates_b[capture])
        if _board_index(a) is None or _board_index(b) is None or _board_index(a) == _board_index(b)
    ]
    return np.array(rows, dtype=np.intp).reshape(-1, 3)


def group_alternatives(
    table: NDArray[np.intp], candidates_a: Candidates, candidates_b: Candidates
) -> NDArray[np.intp]:
    """Numbers (M,) the groups of mutually exclusive matches: those of one capture, and board if identified."""
    groups: dict[tuple[int, frozenset[int | None]], int] = {}
    numbers = []
    for capture, i, j in table.tolist():
        boards = {_board_index(candidates_a[capture][i]), _board_index(candidates_b[capture][j])}
        numbers.append(groups.setdefault((capture, frozenset(boards)), len(groups)))
    return np.array(numbers, dtype=np.intp)


def _board_index(detection: Detection) -> int | None:
    """Index of the board in the rig, if the sensor can identify it."""
    return detection.board if isinstance(detection, BoardCorners) else None


def geometric_kind(detection: Detection) -> str:
    """``line`` or ``plane``: what the detection measures of the board."""
    return "line" if isinstance(detection, Segment) else "plane"


def _stack_planes(detections: Sequence[Detection]) -> tuple[Array, Array, Array]:
    with_plane = [d for d in detections if isinstance(d, PlanePatch | BoardCorners)]
    planes, covariances = zip(*(plane_of(d) for d in with_plane), strict=True)
    return np.array(planes), np.array(covariances), np.array([d.center for d in with_plane])


def _stack_segments(detections: Sequence[Detection]) -> tuple[Array, Array]:
    segments = [d for d in detections if isinstance(d, Segment)]
    return np.array([d.endpoints for d in segments]), np.array([d.covariance for d in segments])
