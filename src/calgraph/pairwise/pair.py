"""From two sensors' detections to their relative pose: one table of (kind, kind), one consensus."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from calgraph.consensus import search
from calgraph.detection import BoardCorners, Detection, PlanePatch, Rejected, Segment, plane_of
from calgraph.geometry import Array
from calgraph.pairwise.estimate import Matches, PairwiseEstimate, information, squared_residuals
from calgraph.pairwise.lines import LineLine, PlaneLine
from calgraph.pairwise.planes import PlanePlane

Candidates = Mapping[int, Sequence[Detection]]
"""Detections of one sensor by capture; several where it is not known which of them is the board."""


def estimate_pair(
    sensor_a: str,
    sensor_b: str,
    candidates_a: Candidates,
    candidates_b: Candidates,
    board_size: tuple[float, float],
    rng: np.random.Generator,
) -> PairwiseEstimate | Rejected:
    """Estimates ``T_a_b`` from the captures in which both sensors have detections.

    Args:
        sensor_a: name of sensor a.
        sensor_b: name of sensor b.
        candidates_a: detections by a; all of one geometric kind (planes or lines).
        candidates_b: detections by b.
        board_size: width and height of the (largest) board, m.
        rng: source of the samples.

    Returns:
        The estimate, or the reason why the pair cannot be estimated.
    """
    common = sorted(set(candidates_a) & set(candidates_b))
    if not common:
        return Rejected("no capture shows the board to both")
    kinds = _kind(candidates_a[common[0]][0]), _kind(candidates_b[common[0]][0])
    if kinds == ("line", "plane"):
        swapped = estimate_pair(sensor_b, sensor_a, candidates_b, candidates_a, board_size, rng)
        return swapped if isinstance(swapped, Rejected) else swapped.inverse()

    table = match_table(candidates_a, candidates_b)
    matches = _MATCHES[kinds](
        [candidates_a[c][i] for c, i, _ in table], [candidates_b[c][j] for c, _, j in table], board_size, rng
    )
    if len(common) < matches.sample_size:
        return Rejected(f"{len(common)} captures show the board to both, {matches.sample_size} are needed")
    found = search(table[:, 0], matches.sample_size, matches.solve, squared_residuals(matches), 1.0, rng=rng)
    if found is None or found.count < matches.sample_size:
        return Rejected(f"no relative pose agrees with {matches.sample_size} of the {len(common)} common captures")
    at = matches.linearize(found.model[None])
    at_model = type(at)(at.residuals[0], at.jacobian[0], at.covariance[0])
    return PairwiseEstimate(
        sensor_a,
        sensor_b,
        found.model,
        information(at_model, found.inliers),
        table,
        found.inliers,
        np.sqrt(np.mean(at_model.residuals**2, axis=-1)),
    )


def match_table(candidates_a: Candidates, candidates_b: Candidates) -> NDArray[np.intp]:
    """All pairs of candidates in common captures: (M, 3) rows of capture, index in a, index in b."""
    rows = [
        (capture, i, j)
        for capture in sorted(set(candidates_a) & set(candidates_b))
        for i in range(len(candidates_a[capture]))
        for j in range(len(candidates_b[capture]))
    ]
    return np.array(rows, dtype=np.intp).reshape(-1, 3)


def _kind(detection: Detection) -> str:
    return "line" if isinstance(detection, Segment) else "plane"


def _planes(detections: Sequence[Detection]) -> tuple[Array, Array, Array]:
    seen = [d for d in detections if isinstance(d, PlanePatch | BoardCorners)]
    planes, covariances = zip(*(plane_of(d) for d in seen), strict=True)
    return np.array(planes), np.array(covariances), np.array([d.center for d in seen])


def _segments(detections: Sequence[Detection]) -> tuple[Array, Array]:
    seen = [d for d in detections if isinstance(d, Segment)]
    return np.array([d.endpoints for d in seen]), np.array([d.covariance for d in seen])


Build = Callable[[Sequence[Detection], Sequence[Detection], tuple[float, float], np.random.Generator], Matches]


def _plane_plane(
    a: Sequence[Detection], b: Sequence[Detection], size: tuple[float, float], _rng: np.random.Generator
) -> Matches:
    return PlanePlane(*_planes(a), *_planes(b), min(size) / 2, float(np.hypot(*size)))


def _plane_line(
    a: Sequence[Detection], b: Sequence[Detection], size: tuple[float, float], _rng: np.random.Generator
) -> Matches:
    return PlaneLine(*_planes(a), *_segments(b), float(np.hypot(*size)))


def _line_line(
    a: Sequence[Detection], b: Sequence[Detection], size: tuple[float, float], rng: np.random.Generator
) -> Matches:
    return LineLine(*_segments(a), *_segments(b), float(np.hypot(*size)), rng)


_MATCHES: Mapping[tuple[str, str], Build] = {
    ("plane", "plane"): _plane_plane,
    ("plane", "line"): _plane_line,
    ("line", "line"): _line_line,
}
