"""The board in the scans of a 2-D scanner: a straight, contiguous segment of a plausible length.

Source: MSG-Cal, section III-B. Candidates are also scored by their ends: a board stands free, so both of its
ends are jumps in depth, which the ends of a piece of wall seldom are.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Board, RangeNoise
from calgraph.detection.board_edges import find_board_edges, select_beams_with_margin
from calgraph.detection.detections import Segment
from calgraph.detection.line_plane_fit import SurfaceFit, fit_line
from calgraph.detection.scan_averaging import AveragedScan, average_scans
from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.ransac import find_consensus
from calgraph.sensors import LaserScan, ScanBackground

Indices = NDArray[np.intp]

_MAX_CANDIDATES = 8
_MIN_POINTS = 5
_MIN_LENGTH = 0.15
_MIN_MATCH = 0.05
# Two neighbouring beams lie on one surface if it is inclined no more than this against them (Borges and Aldon,
# "Line extraction in 2D range images for mobile robotics", 2004), rad.
_GRAZING = np.radians(10.0)
# Beams may be missing within a board (dark print), but not over more than this, m.
_MAX_GAP = 0.12
# A cut that bulges by more than this, m, is a body.
_BULGE = 0.01
_FREE_END = 0.10
# Beams whose mean tells whether an end of the line is bent.
_BLOCK = 5
# Scanners bend a straight board by this much, m.
_SYSTEMATIC = 0.006
_Z_VARIANCE = 1e-8
# Around the longest cut, so much is looked at for where it ends, m.
_BESIDE = 0.15
# A beam within this of the line, m, hits the board, be it bent.
_THICKNESS = 0.03
# Flatter than this a beam grazes the board.
_MIN_COSINE = 0.05


@dataclass(frozen=True, eq=False)
class _LineCandidate:
    """A run of beams with the line through them."""

    beams: Indices
    """(N,) beams of the averaged scan, in order."""
    fit: SurfaceFit
    length: float


def find_segments(
    scans: Sequence[LaserScan],
    boards: Sequence[Board],
    noise: RangeNoise,
    background: ScanBackground | None,
    rng: np.random.Generator,
) -> tuple[Segment, ...] | Rejected:
    """Finds the board in the scans of one capture.

    Args:
        scans: all scans of one scanner that were measured while the board rested; they are averaged.
        boards: the boards to look for.
        noise: of a single beam.
        background: model of the scene without the board; without it all lines of the scene are candidates.
        rng: for the random sampling.

    Returns:
        Up to eight candidates, the best match first, or why there is none.

    """
    if not scans:
        return Rejected("no scan was measured while the board rested")
    foreground = [scan.valid if background is None else background.foreground(scan) for scan in scans]
    scan = average_scans(scans, noise, foreground)
    if scan is None:
        return Rejected("the scans hold no steady returns")
    if not scan.foreground.any():
        return Rejected("no foreground beams: the board is not in view, or the background window contains it")
    lines = [line for run in _split_runs(scan, noise) for line in _extract_lines(scan, run, noise, rng)]
    if not lines:
        return Rejected(
            f"none of the {scan.foreground.sum()} {'foreground ' if background else ''}beams form a straight "
            f"line of {_MIN_POINTS} beams: the board is not in view or is seen edge-on"
        )
    matched = [(_score_line(scan, line, boards, noise), line) for line in lines]
    plausible = sorted((m for m in matched if m[0] >= _MIN_MATCH), key=lambda m: -m[0])[:_MAX_CANDIDATES]
    if not plausible:
        longest = max(lines, key=lambda line: line.length)
        sizes = " or ".join(f"{b.size[0]:g} x {b.size[1]:g} m" for b in boards)
        return Rejected(f"no line has a board's length: the longest is {longest.length:.2f} m, the board {sizes}")
    reach = max(0.5 * float(np.hypot(*board.size)) for board in boards) + _BESIDE
    return tuple(_make_segment(scan, line, match, reach) for match, line in plausible)


def _split_runs(scan: AveragedScan, noise: RangeNoise) -> list[Indices]:
    """Splits the foreground beams where the surface jumps in depth or too many beams are missing."""
    beams = np.flatnonzero(scan.foreground)
    step = np.diff(scan.angles[beams])
    gap = np.linalg.norm(np.diff(scan.points[beams], axis=0), axis=1)
    near = np.minimum(scan.ranges[beams[1:]], scan.ranges[beams[:-1]])
    reach = near * np.sin(step) / np.sin(np.maximum(_GRAZING - step, 1e-3)) + 4 * noise.range
    splits = (
        (gap > np.maximum(reach, 0)) | ((step > 3.5 * scan.spacing) & (gap > _MAX_GAP)) | (step > _GRAZING / 2)
    )
    return np.split(beams, np.flatnonzero(splits) + 1)


def _extract_lines(
    scan: AveragedScan, run: Indices, noise: RangeNoise, rng: np.random.Generator
) -> Iterator[_LineCandidate]:
    """The straight lines of a run: the largest consensus first, then those in the beams on either side of it."""
    pending = [run]
    while pending:
        beams = pending.pop()
        if len(beams) < _MIN_POINTS:
            continue
        consensus = _find_consensus_line(scan.points[beams], max(3 * noise.range, 0.02), rng)
        if consensus is None:
            continue
        first, last = _find_longest_run(scan, beams, consensus[1])
        line = _refine_line(scan, beams[first:last], consensus[0])
        if line is not None:
            yield line
        if last > first:
            pending += [beams[:first], beams[last:]]


def _find_consensus_line(
    points: Array, threshold: float, rng: np.random.Generator
) -> tuple[Array, NDArray[np.bool_]] | None:
    """The line (angle, distance) with the most inliers among points (N, 2), and the inliers."""

    def solve(samples: Indices) -> Array:
        chosen = points[samples]
        centre = chosen.mean(axis=1)
        d = chosen - centre[:, None]
        # Angle of the principal axis of a 2 x 2 scatter matrix, in closed form.
        xx, yy, xy = (d[..., 0] ** 2).sum(1), (d[..., 1] ** 2).sum(1), (d[..., 0] * d[..., 1]).sum(1)
        angle = 0.5 * np.arctan2(2 * xy, xx - yy) + np.pi / 2
        p = centre[:, 0] * np.cos(angle) + centre[:, 1] * np.sin(angle)
        return np.stack([np.where(p < 0, angle + np.pi, angle), np.abs(p)], axis=-1)

    def squared_residuals(lines: Array) -> Array:
        n = np.stack([np.cos(lines[:, 0]), np.sin(lines[:, 0])])
        return np.asarray(((points @ n).T - lines[:, 1:]) ** 2)

    groups = np.arange(len(points))
    consensus = find_consensus(groups, 2, solve, squared_residuals, threshold**2, rng=rng, max_samples=300)
    return None if consensus is None else (consensus.model, consensus.inliers)


def _find_longest_run(scan: AveragedScan, beams: Indices, inliers: NDArray[np.bool_]) -> tuple[int, int]:
    """First and one past the last of the beams in the longest contiguous run of inliers."""
    indices = np.flatnonzero(inliers)
    if not len(indices):
        return 0, 0
    points = scan.points[beams[indices]]
    gap = np.linalg.norm(np.diff(points, axis=0), axis=1)
    spacing = np.median(gap) if len(gap) else 0.0
    breaks = np.flatnonzero((np.diff(indices) > 3) & (gap > 3 * spacing)) + 1
    runs = np.split(np.arange(len(indices)), breaks)
    longest = max(runs, key=lambda s: float(np.linalg.norm(points[s[-1]] - points[s[0]])))
    return int(indices[longest[0]]), int(indices[longest[-1]]) + 1


def _refine_line(scan: AveragedScan, beams: Indices, start: Array) -> _LineCandidate | None:
    """The line by least squares in range, and its inliers; outliers are dropped, at the ends too."""
    if len(beams) < _MIN_POINTS:
        return None
    beams = _trim_bent_ends(scan, beams, start)
    # An end beam may be a mixed pixel of board and background: it counts for the end but not for the line.
    interior = beams[1:-1] if len(beams) >= 2 * _MIN_POINTS else beams
    fit = fit_line(
        scan.angles[interior], scan.ranges[interior], scan.sigma_range[interior], scan.sigma_angle[interior], start
    )
    if fit is None or fit.inliers.sum() < _MIN_POINTS or fit.parameters[1] <= 0:
        return None
    inliers = np.abs(_whitened_residuals(scan, beams, fit.parameters)) < 3 * fit.scale
    if inliers.sum() < _MIN_POINTS:
        return None
    kept = beams[inliers]
    s = _positions_along(scan.angles[kept[[0, -1]]], fit.parameters)
    return _LineCandidate(kept, fit, float(abs(s[1] - s[0])))


def _trim_bent_ends(scan: AveragedScan, beams: Indices, start: Array) -> Indices:
    """Drops the ends of a run that leave the line through its middle: legs, hands, corners beside the board.

    Each of their beams lies within the noise; their means, over a block of beams, do not.
    """
    blocks = np.array_split(beams, len(beams) // _BLOCK) if len(beams) >= 5 * _BLOCK else []
    outer = len(blocks) // 5
    if not outer:
        return beams
    middle = np.concatenate(blocks[outer:-outer])
    fit = fit_line(
        scan.angles[middle], scan.ranges[middle], scan.sigma_range[middle], scan.sigma_angle[middle], start
    )
    if fit is None:
        return beams
    straight = [_lies_on_line(scan, block, fit) for block in blocks]
    first, last = 0, len(blocks)
    for i in range(outer):
        first = i + 1 if not straight[i] else first
        last = len(blocks) - i - 1 if not straight[-1 - i] else last
    return np.concatenate(blocks[first:last])


def _lies_on_line(scan: AveragedScan, block: Indices, fit: SurfaceFit) -> bool:
    """Whether the median offset of a block of beams from a line is within three standard deviations of both."""
    angle, p = fit.parameters
    cosine = np.cos(scan.angles[block] - angle)
    offset = float(np.median(scan.ranges[block] * cosine - p))
    s = float(np.mean(_positions_along(scan.angles[block], fit.parameters)))
    J = np.array([-s, 1.0])
    sigma_offset = fit.scale * float(np.mean(scan.sigma_range[block] * cosine)) * np.sqrt(np.pi / 2 / len(block))
    return abs(offset) < max(_SYSTEMATIC, 3 * float(np.sqrt(sigma_offset**2 + J @ fit.covariance @ J)))


def _whitened_residuals(scan: AveragedScan, beams: Indices, line: Array) -> Array:
    """Whitened differences (N,) between measured ranges and the line's."""
    cosine = np.maximum(np.cos(scan.angles[beams] - line[0]), 0.05)
    tangent = np.sin(scan.angles[beams] - line[0]) / cosine
    sigma = np.hypot(scan.sigma_range[beams], scan.sigma_angle[beams] * scan.ranges[beams] * tangent)
    return np.asarray((scan.ranges[beams] - line[1] / cosine) / sigma)


def _positions_along(angles: Array, line: Array) -> Array:
    """Intersections of beams with the line, as coordinates along it from its foot point, m."""
    return np.asarray(line[1] * np.tan(angles - line[0]))


def _score_line(scan: AveragedScan, line: _LineCandidate, boards: Sequence[Board], noise: RangeNoise) -> float:
    """Score, 0 to 1, of a line as a section of one of the boards: length, straightness and free ends."""
    end_spacing = float(np.median(np.abs(np.diff(_positions_along(scan.angles[line.beams], line.fit.parameters)))))
    tolerance = 2 * end_spacing + 2 * noise.range
    length = max(_score_length(line.length, board, tolerance) for board in boards)
    if length <= 0:
        return 0.0
    s = _positions_along(scan.angles[line.beams], line.fit.parameters)
    cosine = np.cos(scan.angles[line.beams] - line.fit.parameters[0])
    offset = scan.ranges[line.beams] * cosine - line.fit.parameters[1]
    half = 0.5 * float(np.ptp(s))
    bulge = float(np.polyfit((s - s.mean()) / half, offset, 2)[0])
    straight = np.exp(-0.5 * (bulge / max(_BULGE, noise.range)) ** 2)
    ends = _score_end(scan, line, -1) * _score_end(scan, line, +1)
    return float(length * straight * np.sqrt(ends))


def _score_length(length: float, board: Board, tolerance: float) -> float:
    """1 between the shorter side and the diagonal, falling to 0 at a third of the side and above the diagonal."""
    side, diagonal = min(board.size), float(np.hypot(*board.size))
    shortest = max(_MIN_LENGTH, side / 3)
    if length < shortest - tolerance or length > diagonal + tolerance:
        return 0.0
    return min(1.0, length / side)


def _score_end(scan: AveragedScan, line: _LineCandidate, direction: int) -> float:
    """Score of one end: 1 if the next beams end behind the line, 0.7 if occluded, 0.2 if the surface continues."""
    end = line.beams[0] if direction < 0 else line.beams[-1]
    # Two beams may be mixed pixels of the edge.
    beyond = end + 3 * direction
    if not 0 <= beyond < len(scan.angles):
        return 0.7
    step = abs(scan.angles[beyond] - scan.angles[end])
    if step > 10 * scan.spacing:
        return 0.8
    cosine = np.cos(scan.angles[beyond] - line.fit.parameters[0])
    predicted = line.fit.parameters[1] / max(cosine, 0.05)
    margin = _FREE_END + scan.ranges[end] * step
    excess = scan.ranges[beyond] - predicted
    if excess > margin:
        return 1.0
    return 0.7 if excess < -margin else 0.2


def _make_segment(scan: AveragedScan, line: _LineCandidate, match: float, reach: float) -> Segment:
    points = np.column_stack([scan.points[line.beams], np.zeros(len(line.beams))])
    segment = build_segment(scan.angles[line.beams[[0, -1]]], scan.spacing, line.fit, points, match)
    return replace(segment, edges=_find_edges(scan, line.fit, segment.center[:2], reach))


def _find_edges(scan: AveragedScan, line: SurfaceFit, middle: Array, radius: float) -> Array:
    """(M, 2, 3) edges of the line within ``radius`` of its middle (2,)."""
    angle, p = line.parameters
    cosine = np.cos(scan.angles - angle)
    predicted = np.where(cosine > _MIN_COSINE, p / np.maximum(cosine, _MIN_COSINE), np.inf)
    along = np.where(np.isfinite(predicted), p * np.tan(scan.angles - angle), np.inf)
    center = float(middle @ [-np.sin(angle), np.cos(angle)])
    near = select_beams_with_margin(np.abs(along - center) < radius)
    directions = np.stack([np.cos(scan.angles), np.sin(scan.angles), np.zeros_like(scan.angles)], axis=-1)[near]
    thickness = max(4 * line.scale * float(np.median(scan.sigma_range[near])), _THICKNESS)
    # Beams that are not consecutive are different scan lines.
    return find_board_edges(directions, (scan.ranges - predicted)[near], near - np.arange(len(near)), thickness)


def build_segment(ends: Array, spacing: float, line: SurfaceFit, points: Array, match: float = 1.0) -> Segment:
    """Builds the detection: outermost beams projected on the line, with the covariance of line and beam spacing.

    Args:
        ends: (2,) angles of the outermost beams, ascending, rad.
        spacing: angle between neighbouring beams, rad.
        line: through all beams.
        points: (N, 3) their ends, m.
        match: as in :class:`Segment`.

    """
    angle, p = line.parameters
    n, t = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
    s = _positions_along(ends, line.parameters)
    # The last beam is up to one spacing inside the end of the board.
    spacings = np.abs(
        _positions_along(ends + spacing / 2, line.parameters)
        - _positions_along(ends - spacing / 2, line.parameters)
    )
    J = np.concatenate([np.outer(n, [-s_end, 1.0]) for s_end in s])
    covariance = J @ line.covariance @ J.T
    for i in range(2):
        block = slice(3 * i, 3 * i + 3)
        covariance[block, block] += np.outer(t, t) * spacings[i] ** 2 / 12 + np.diag([0, 0, _Z_VARIANCE])
    return Segment(p * n + s[:, None] * t, covariance, points, match)
