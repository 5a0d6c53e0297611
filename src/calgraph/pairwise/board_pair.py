"""From two sensors' detections to their relative pose: one table of (kind, kind), one consensus."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calgraph.detection import BoardCorners, Detection, PlanePatch, Segment, plane_of
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3
from calgraph.pairwise.line_matches import LineLine, PlaneLine
from calgraph.pairwise.pairwise_estimate import (
    Linearization,
    Matches,
    PairwiseEstimate,
    excess,
    information,
    polished,
    settled,
    squared_residuals,
)
from calgraph.pairwise.plane_matches import PlanePlane
from calgraph.ransac import find_consensus, select_best_of_groups

Candidates = Mapping[int, Sequence[Detection]]
"""Detections of one sensor by capture; several where it is not known which of them is the board."""


def estimate_pair(
    sensor_a: str,
    sensor_b: str,
    candidates_a: Candidates,
    candidates_b: Candidates,
    board_size: tuple[float, float],
    rng: np.random.Generator,
    *,
    polish: bool = True,
) -> PairwiseEstimate | Rejected:
    """Estimates ``T_a_b`` from the captures in which both sensors have detections.

    Args:
        sensor_a: name of sensor a.
        sensor_b: name of sensor b.
        candidates_a: detections by a; all of one geometric kind (planes or lines).
        candidates_b: detections by b.
        board_size: width and height of the (largest) board, m.
        rng: source of the samples.
        polish: fit the inliers once more, weighted by their covariances; the paper leaves the pose as its solver,
            with equal weights, found it.

    Returns:
        The estimate, or the reason why the pair cannot be estimated.
    """
    common = sorted(set(candidates_a) & set(candidates_b))
    if not common:
        return Rejected("no capture shows the board to both")
    kinds = _kind(candidates_a[common[0]][0]), _kind(candidates_b[common[0]][0])
    if kinds == ("line", "plane"):
        swapped = estimate_pair(sensor_b, sensor_a, candidates_b, candidates_a, board_size, rng, polish=polish)
        return swapped if isinstance(swapped, Rejected) else swapped.inverse()

    table, matches = _matches(candidates_a, candidates_b, board_size)
    if len(common) < matches.sample_size:
        return Rejected(f"{len(common)} captures show the board to both, {matches.sample_size} are needed")
    groups = _alternatives(table, candidates_a, candidates_b)
    found = find_consensus(groups, matches.sample_size, matches.solve, squared_residuals(matches), 1.0, rng=rng)
    enough = max(matches.sample_size, _least(matches, len(table)))
    if found is None or found.inlier_count < enough:
        return Rejected(f"no relative pose agrees with {enough} of the {len(common)} common captures")
    T_a_b, rival = found.model, 0.0
    if polish and isinstance(matches, PlaneLine):
        T_a_b, rival = settled(T_a_b, matches.minima(found.inliers), matches, found.inliers)
    if polish:
        T_a_b = polished(T_a_b, matches, found.inliers)
    return replace(_estimate(sensor_a, sensor_b, T_a_b, table, matches, found.inliers), rival=rival)


def reconsider(
    estimate: PairwiseEstimate,
    T_a_b: Array,
    candidates_a: Candidates,
    candidates_b: Candidates,
    board_size: tuple[float, float],
) -> PairwiseEstimate | Rejected:
    """Selects a pair's inliers anew, under a pose that more than this pair's data determined.

    The consensus had to be lenient, as a pose from few captures is uncertain. Now the inliers' own scatter tells
    how far a good match strays, and matches beyond 3.5 times that are out.

    Args:
        estimate: as found by :func:`estimate_pair`.
        T_a_b: the better pose (4, 4).
        candidates_a: detections by the estimate's sensor a.
        candidates_b: detections by its sensor b.
        board_size: width and height of the (largest) board, m.

    Returns:
        The estimate at ``T_a_b`` with the new inliers; rejected if too few are left, as a wrong pose's would be.
    """
    if (
        _kind(candidates_a[estimate.matches[0, 0]][0]) == "line"
        and _kind(candidates_b[estimate.matches[0, 0]][0]) == "plane"
    ):
        swapped = reconsider(estimate.inverse(), se3.inverse(T_a_b), candidates_b, candidates_a, board_size)
        return swapped if isinstance(swapped, Rejected) else swapped.inverse()
    table, matches = _matches(candidates_a, candidates_b, board_size)
    r2 = squared_residuals(matches)(T_a_b[None])[0]
    scale2 = float(np.median(r2[estimate.inliers])) / 0.4549  # the median of χ² with one degree of freedom
    gate = min(1.0, 3.5**2 * scale2)
    inliers = select_best_of_groups(r2 / gate, _alternatives(table, candidates_a, candidates_b))
    if inliers.sum() < matches.sample_size:
        return Rejected(f"its {int(estimate.inliers.sum())} captures contradict what all sensors together say")
    found = _estimate(estimate.sensor_a, estimate.sensor_b, T_a_b, table, matches, inliers)
    return replace(found, rival=estimate.rival)


def _matches(
    candidates_a: Candidates, candidates_b: Candidates, size: tuple[float, float]
) -> tuple[NDArray[np.intp], Matches]:
    table = match_table(candidates_a, candidates_b)
    a = [candidates_a[capture][i] for capture, i, _ in table]
    b = [candidates_b[capture][j] for capture, _, j in table]
    return table, _MATCHES[_kind(a[0]), _kind(b[0])](a, b, size)


def _least(matches: Matches, count: int) -> int:
    """How many matches it takes to measure more numbers than a pose has: fewer agree with whatever they gave."""
    numbers = matches.linearize(np.eye(4)[None]).residuals.size // count
    return 7 // numbers + 1


def _estimate(
    sensor_a: str,
    sensor_b: str,
    T_a_b: Array,
    table: NDArray[np.intp],
    matches: Matches,
    inliers: NDArray[np.bool_],
) -> PairwiseEstimate:
    at = matches.linearize(T_a_b[None])
    at = Linearization(at.residuals[0], at.jacobian[0], at.covariance[0])
    rms = np.sqrt(np.mean(at.residuals**2, axis=-1))
    return PairwiseEstimate(
        sensor_a, sensor_b, T_a_b, information(at, inliers), table, inliers, rms, excess=excess(at, inliers)
    )


Pairs = Mapping[tuple[str, str], PairwiseEstimate | Rejected]
"""Estimate, or the reason why there is none, by pair of sensors."""


def estimate_pairs(
    detections: Mapping[str, Candidates],
    board_size: tuple[float, float],
    rng: np.random.Generator,
    progress: Callable[[float], None] = lambda _done: None,
    *,
    polish: bool = True,
) -> Pairs:
    """Estimates the relative pose of every pair of sensors, as :func:`estimate_pair` does.

    Args:
        detections: by sensor and capture.
        board_size: width and height of the (largest) board, m.
        rng: source of the samples.
        progress: told how much is done, 0..1.
        polish: as for :func:`estimate_pair`.
    """
    names = list(itertools.combinations(detections, 2))
    pairs = {}
    for done, (a, b) in enumerate(names, start=1):
        pairs[a, b] = estimate_pair(a, b, detections[a], detections[b], board_size, rng, polish=polish)
        progress(done / len(names))
    return pairs


def estimated(pairs: Pairs) -> list[PairwiseEstimate]:
    """The pairs that could be estimated."""
    return [pair for pair in pairs.values() if not isinstance(pair, Rejected)]


def reconsider_pairs(
    pairs: Pairs,
    T_root_sensor: Mapping[str, Array],
    detections: Mapping[str, Candidates],
    board_size: tuple[float, float],
) -> Pairs:
    """Selects the inliers of every pair anew under joint poses, as :func:`reconsider` does.

    Args:
        pairs: as estimated.
        T_root_sensor: joint poses (4, 4); pairs with a sensor that has none stay as they are.
        detections: by sensor and capture.
        board_size: width and height of the (largest) board, m.
    """
    chosen = dict(pairs)
    for (a, b), pair in pairs.items():
        if not isinstance(pair, Rejected) and a in T_root_sensor and b in T_root_sensor:
            T_a_b = se3.inverse(T_root_sensor[a]) @ T_root_sensor[b]
            chosen[a, b] = reconsider(pair, T_a_b, detections[a], detections[b], board_size)
    return chosen


def match_table(candidates_a: Candidates, candidates_b: Candidates) -> NDArray[np.intp]:
    """All pairs of candidates in common captures: (M, 3) rows of capture, index in a, index in b.

    Two boards that cameras tell apart are no pair.
    """
    rows = [
        (capture, i, j)
        for capture in sorted(set(candidates_a) & set(candidates_b))
        for i, a in enumerate(candidates_a[capture])
        for j, b in enumerate(candidates_b[capture])
        if _board(a) is None or _board(b) is None or _board(a) == _board(b)
    ]
    return np.array(rows, dtype=np.intp).reshape(-1, 3)


def _alternatives(table: NDArray[np.intp], candidates_a: Candidates, candidates_b: Candidates) -> NDArray[np.intp]:
    """(M,) groups of matches of which one at most is true: those of one capture, and board if it is known."""
    groups: dict[tuple[int, frozenset[int | None]], int] = {}
    numbers = []
    for capture, i, j in table.tolist():
        boards = {_board(candidates_a[capture][i]), _board(candidates_b[capture][j])}
        numbers.append(groups.setdefault((capture, frozenset(boards)), len(groups)))
    return np.array(numbers, dtype=np.intp)


def _board(detection: Detection) -> int | None:
    """Which of the rig's boards it is, if the sensor can tell."""
    return detection.board if isinstance(detection, BoardCorners) else None


def _kind(detection: Detection) -> str:
    return "line" if isinstance(detection, Segment) else "plane"


def _planes(detections: Sequence[Detection]) -> tuple[Array, Array, Array]:
    seen = [d for d in detections if isinstance(d, PlanePatch | BoardCorners)]
    planes, covariances = zip(*(plane_of(d) for d in seen), strict=True)
    return np.array(planes), np.array(covariances), np.array([d.center for d in seen])


def _segments(detections: Sequence[Detection]) -> tuple[Array, Array]:
    seen = [d for d in detections if isinstance(d, Segment)]
    return np.array([d.endpoints for d in seen]), np.array([d.covariance for d in seen])


Build = Callable[[Sequence[Detection], Sequence[Detection], tuple[float, float]], Matches]


def _plane_plane(a: Sequence[Detection], b: Sequence[Detection], size: tuple[float, float]) -> Matches:
    return PlanePlane(*_planes(a), *_planes(b), min(size) / 2, float(np.hypot(*size)))


def _plane_line(a: Sequence[Detection], b: Sequence[Detection], size: tuple[float, float]) -> Matches:
    return PlaneLine(*_planes(a), *_segments(b), float(np.hypot(*size)))


def _line_line(a: Sequence[Detection], b: Sequence[Detection], size: tuple[float, float]) -> Matches:
    return LineLine(*_segments(a), *_segments(b), float(np.hypot(*size)))


_MATCHES: Mapping[tuple[str, str], Build] = {
    ("plane", "plane"): _plane_plane,
    ("plane", "line"): _plane_line,
    ("line", "line"): _line_line,
}
