"""The board in the scans of a 2-D scanner: a straight, contiguous segment of a plausible length.

Source: MSG-Cal, section III-B. Candidates are also scored by their ends: a board stands free, so both of its
ends are jumps in depth, which the ends of a piece of wall seldom are.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import Segment
from calgraph.config import Board, RangeNoise
from calgraph.config.settings import DetectionSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, find_median
from calgraph.rig.detection.line_plane_fit import (
    MIN_COSINE,
    OUTLIER_SIGMAS,
    SurfaceFit,
    find_board_edges,
    fit_line,
    select_beams_with_margin,
    whiten_line,
)
from calgraph.rig.detection.scan_averaging import MIN_THICKNESS, SAME_SURFACE_SIGMAS, AveragedScan, average_scans
from calgraph.sensors import LaserScan, ScanBackground
from calgraph.solver.ransac import find_consensus

Indices = NDArray[np.intp]

# Variance in z of end points, m²: keeps their covariance invertible.
_Z_VARIANCE = 1e-8
# Least difference of two angles whose sine is divided by, rad: keeps the quotient finite.
_MIN_ANGLE = 1e-3


@dataclass(frozen=True, eq=False)
class _LineCandidate:
    """A run of beams with the line through them."""

    beams: Indices
    """(N,) beams of the averaged scan, in order."""
    fit: SurfaceFit
    length: float


# Minimum score of a candidate: a continued end (0.2) at both ends and a third of the length have 0.07.
_MIN_SCORE = 0.05
# Width around the board, m, that is searched for its edges, and in which it must stand free: wider, arms and body
# of the operator are inside.
SURROUNDINGS = 0.15
# Maximum number of candidates for the board in one capture: without a background, walls and doors resemble it;
# the pairwise step tries all combinations of two sensors, 64.
MAX_CANDIDATES = 8


def find_segments(
    scans: Sequence[LaserScan],
    boards: Sequence[Board],
    noise: RangeNoise,
    background: ScanBackground | None,
    rng: np.random.Generator,
    settings: DetectionSettings,
) -> tuple[Segment, ...] | Rejected:
    """Finds the board in the scans of one capture.

    Args:
        scans: all scans of one scanner that were measured while the board rested; they are averaged.
        boards: the boards to look for.
        noise: of a single beam.
        background: model of the scene without the board; without it all lines of the scene are candidates.
        rng: for the random sampling.
        settings: of the detection.

    Returns:
        Candidates for the board, the best score first, or why there is none.
    """
    if not scans:
        return Rejected("no scan was measured while the board rested")
    # A scan without any return is a lost message, and no evidence against the returns of the others.
    scans = [scan for scan in scans if scan.valid.any()] or scans
    foreground = [scan.valid if background is None else background.foreground(scan) for scan in scans]
    scan = average_scans(scans, noise, foreground)
    if scan is None:
        return Rejected("the scans hold no steady returns")
    if not scan.foreground.any():
        return Rejected(
            "no foreground beams: the board is not in view, or the background window "
            "(capture.background, or found at the start) contains it"
        )
    runs = _split_runs(scan, noise)
    lines = [line for run in runs for line in _extract_lines(scan, run, noise, rng, settings)]
    if not lines:
        return Rejected(
            f"none of the {scan.foreground.sum()} {'foreground ' if background else ''}beams form a straight "
            f"line of {settings.lidar2d.min_beams} beams: the board is not in view or is edge-on"
        )
    scored = [(_score_line(scan, line, boards, noise, settings), line) for line in lines]
    plausible = sorted((s for s in scored if s[0] >= _MIN_SCORE), key=lambda s: -s[0])
    if not plausible:
        longest = max(lines, key=lambda line: line.length)
        sizes = " or ".join(f"{b.size[0]:g} x {b.size[1]:g} m" for b in boards)
        return Rejected(f"no line has a board's length: the longest is {longest.length:.2f} m, the board {sizes}")
    radius = max(0.5 * float(np.hypot(*board.size)) for board in boards) + SURROUNDINGS
    best = plausible[:MAX_CANDIDATES]
    return tuple(_make_segment(scan, line, score, radius, settings) for score, line in best)


# Neighbouring beams are on one surface if it is inclined by no less than this against them, 10° (Borges and
# Aldon, "Line extraction in 2D range images for mobile robotics", 2004).
_MAX_GRAZING_ANGLE = math.radians(10.0)
# Beams farther apart than this many beam spacings have others missing between them: three spacings, for beams
# left out as unsteady, and half a one for jitter.
_GAP_SPACINGS = 3.5
# Maximum gap in a line, m, where beams are missing: dark print absorbs the beams of a tag's bar.
_MAX_GAP = 0.12


def _split_runs(scan: AveragedScan, noise: RangeNoise) -> list[Indices]:
    """Splits the foreground beams where the surface jumps in depth or too many beams are missing."""
    beams = np.flatnonzero(scan.foreground)
    step = np.diff(scan.angles[beams])
    gap = np.linalg.norm(np.diff(scan.points[beams], axis=0), axis=1)
    near = np.minimum(scan.ranges[beams[1:]], scan.ranges[beams[:-1]])
    max_gap = near * np.sin(step) / np.sin(np.maximum(_MAX_GRAZING_ANGLE - step, _MIN_ANGLE))
    max_gap = max_gap + SAME_SURFACE_SIGMAS * noise.range
    missing = step > _GAP_SPACINGS * scan.spacing
    splits = (gap > np.maximum(max_gap, 0)) | (missing & (gap > _MAX_GAP)) | (step > _MAX_GRAZING_ANGLE / 2)
    return np.split(beams, np.flatnonzero(splits) + 1)


def _extract_lines(
    scan: AveragedScan, run: Indices, noise: RangeNoise, rng: np.random.Generator, settings: DetectionSettings
) -> Iterator[_LineCandidate]:
    """The straight lines of a run: the largest consensus first, then those in the beams on either side of it."""
    threshold = max(OUTLIER_SIGMAS * noise.range, MIN_THICKNESS)
    pending = [run]
    while pending:
        beams = pending.pop()
        if len(beams) < settings.lidar2d.min_beams:
            continue
        consensus = _find_consensus_line(scan.points[beams], threshold, rng)
        if consensus is None:
            continue
        first, last = _find_longest_run(scan, beams, consensus[1])
        line = _refine_line(scan, beams[first:last], consensus[0], settings)
        if line is not None:
            yield line
        if last > first:
            pending += [beams[:first], beams[last:]]


# Probability of a sample without outliers at which RANSAC stops: a surface is missed by chance once in 10,000.
RANSAC_CONFIDENCE = 0.9999
# Samples of RANSAC: a line with a fifth of the beams is drawn with 99.9 % by 169 pairs.
_RANSAC_SAMPLES = 300


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

    consensus = find_consensus(
        np.arange(len(points)), 2, solve, squared_residuals, threshold**2, rng=rng,
        confidence=RANSAC_CONFIDENCE, max_samples=_RANSAC_SAMPLES,
    )  # fmt: skip
    return None if consensus is None else (consensus.model, consensus.inliers)


def _find_longest_run(scan: AveragedScan, beams: Indices, inliers: NDArray[np.bool_]) -> tuple[int, int]:
    """First and one past the last of the beams in the longest contiguous run of inliers."""
    indices = np.flatnonzero(inliers)
    if not len(indices):
        return 0, 0
    points = scan.points[beams[indices]]
    gap = np.linalg.norm(np.diff(points, axis=0), axis=1)
    spacing = np.median(gap) if len(gap) else 0.0
    breaks = np.flatnonzero((np.diff(indices) > _GAP_SPACINGS) & (gap > _GAP_SPACINGS * spacing)) + 1
    runs = np.split(np.arange(len(indices)), breaks)
    longest = max(runs, key=lambda s: float(np.linalg.norm(points[s[-1]] - points[s[0]])))
    return int(indices[longest[0]]), int(indices[longest[-1]]) + 1


def _refine_line(
    scan: AveragedScan, beams: Indices, start: Array, settings: DetectionSettings
) -> _LineCandidate | None:
    """The line by least squares in range, and its inliers; outliers are dropped, at the ends too."""
    min_beams = settings.lidar2d.min_beams
    if len(beams) < min_beams:
        return None
    beams = _trim_bent_ends(scan, beams, start)
    # An end beam may be a mixed pixel of board and background: it counts for the end but not for the line.
    interior = beams[1:-1] if len(beams) >= 2 * min_beams else beams
    fit = fit_line(*scan.measurements(interior), start)
    if fit is None or fit.inliers.sum() < min_beams or fit.parameters[1] <= 0:
        return None
    residuals, _ = whiten_line(fit.parameters, *scan.measurements(beams))
    inliers = np.abs(residuals) < OUTLIER_SIGMAS * fit.scale
    if inliers.sum() < min_beams:
        return None
    kept = beams[inliers]
    s = _positions_along(scan.angles[kept[[0, -1]]], fit.parameters)
    return _LineCandidate(kept, fit, float(abs(s[1] - s[0])))


# Beams whose median offset decides whether an end of the line is bent: it has 0.56 of the noise of a beam.
_END_BLOCK = 5
# Parts of a line, in whole blocks of beams: the first and the last one may be bent, the others determine the
# line. Lines of fewer blocks are not trimmed.
_END_PARTS = 5


def _trim_bent_ends(scan: AveragedScan, beams: Indices, start: Array) -> Indices:
    """Drops the ends of a run that leave the line through its middle: legs, hands, corners beside the board.

    Each of their beams lies within the noise; their means, over a block of beams, do not.
    """
    blocks = np.array_split(beams, len(beams) // _END_BLOCK) if len(beams) >= _END_PARTS * _END_BLOCK else []
    outer = len(blocks) // _END_PARTS
    if not outer:
        return beams
    middle = np.concatenate(blocks[outer:-outer])
    fit = fit_line(*scan.measurements(middle), start)
    if fit is None:
        return beams
    straight = [_lies_on_line(scan, block, fit) for block in (*blocks[:outer], *blocks[-outer:])]
    first, last = 0, len(blocks)
    for i in range(outer):
        first = i + 1 if not straight[i] else first
        last = len(blocks) - i - 1 if not straight[-1 - i] else last
    return np.concatenate(blocks[first:last])


# Minimum offset of a block of beams at an end of the line, m, at which it is cut off: scanners bend straight
# boards by this much. With legs next to the board, whitened errors of end points fall from 5.0 to 1.3.
_MAX_END_OFFSET = 0.006


def _lies_on_line(scan: AveragedScan, block: Indices, fit: SurfaceFit) -> bool:
    """Whether the median offset of a block of beams from a line is within the noise of both."""
    angle, p = fit.parameters
    cosine = np.cos(scan.angles[block] - angle)
    offset = find_median(scan.ranges[block] * cosine - p)
    s = float(np.mean(_positions_along(scan.angles[block], fit.parameters)))
    J = np.array([-s, 1.0])
    sigma_offset = fit.scale * float(np.mean(scan.sigma_range[block] * cosine)) * np.sqrt(np.pi / 2 / len(block))
    max_offset = OUTLIER_SIGMAS * float(np.sqrt(sigma_offset**2 + J @ fit.covariance @ J))
    return abs(offset) < max(_MAX_END_OFFSET, max_offset)


def _positions_along(angles: Array, line: Array) -> Array:
    """Intersections of beams with the line, as coordinates along it from its foot point, m."""
    return np.asarray(line[1] * np.tan(angles - line[0]))


# Bulge of a line at which its score falls to 0.6, m: legs and bodies bulge by centimetres.
_MAX_BULGE = 0.01


def _score_line(
    scan: AveragedScan,
    line: _LineCandidate,
    boards: Sequence[Board],
    noise: RangeNoise,
    settings: DetectionSettings,
) -> float:
    """Score, 0 to 1, of a line as a section of one of the boards: length, straightness and free ends."""
    s = _positions_along(scan.angles[line.beams], line.fit.parameters)
    # Either end may be off by a beam spacing and by the noise of a range.
    tolerance = 2 * float(np.median(np.abs(np.diff(s)))) + 2 * noise.range
    length = max(_score_length(line.length, board, tolerance, settings.lidar2d.min_length) for board in boards)
    if length <= 0:
        return 0.0
    cosine = np.cos(scan.angles[line.beams] - line.fit.parameters[0])
    offset = scan.ranges[line.beams] * cosine - line.fit.parameters[1]
    half = 0.5 * float(np.ptp(s))
    bulge = float(np.polyfit((s - s.mean()) / half, offset, 2)[0])
    straight = np.exp(-0.5 * (bulge / max(_MAX_BULGE, noise.range)) ** 2)
    ends = _score_end(scan, line, -1, settings) * _score_end(scan, line, +1, settings)
    return float(length * straight * np.sqrt(ends))


# Minimum length over the shorter side of the board: shorter cuts pass through a corner of it.
_MIN_SIDE_RATIO = 1 / 3


def _score_length(length: float, board: Board, tolerance: float, least: float) -> float:
    """1 between the shorter side and the diagonal, less below, 0 for implausibly short or long lines."""
    side, diagonal = min(board.size), float(np.hypot(*board.size))
    shortest = max(least, side * _MIN_SIDE_RATIO)
    if length < shortest - tolerance or length > diagonal + tolerance:
        return 0.0
    return min(1.0, length / side)


# Beams next to an end that may be mixed pixels: the one after them shows what follows.
_MIXED_BEAMS = 2
# Score of an end that something nearer occludes, or at the end of the field of view; a free end has 1.
_OCCLUDED_END_SCORE = 0.7
# An end with no return over more beam spacings next to it counts as without return.
_NO_RETURN_SPACINGS = 10.0
# Score of an end without return next to it: free, unless the surface absorbs beams there.
_NO_RETURN_END_SCORE = 0.8
# Score of an end behind which the surface goes on, as walls do; five times less than of a free end.
_CONTINUED_END_SCORE = 0.2


def _score_end(scan: AveragedScan, line: _LineCandidate, direction: int, settings: DetectionSettings) -> float:
    """Score of one end: 1 if the next beams end behind the line, less if it is occluded or the surface goes on."""
    end = line.beams[0] if direction < 0 else line.beams[-1]
    beyond = end + (1 + _MIXED_BEAMS) * direction
    if not 0 <= beyond < len(scan.angles):
        return _OCCLUDED_END_SCORE
    step = abs(scan.angles[beyond] - scan.angles[end])
    if step > _NO_RETURN_SPACINGS * scan.spacing:
        return _NO_RETURN_END_SCORE
    cosine = np.cos(scan.angles[beyond] - line.fit.parameters[0])
    predicted = line.fit.parameters[1] / max(cosine, MIN_COSINE)
    margin = settings.scanner.min_depth_jump + scan.ranges[end] * step
    excess = scan.ranges[beyond] - predicted
    if excess > margin:
        return 1.0
    return _OCCLUDED_END_SCORE if excess < -margin else _CONTINUED_END_SCORE


def _make_segment(
    scan: AveragedScan, line: _LineCandidate, match: float, radius: float, settings: DetectionSettings
) -> Segment:
    ranges, directions = scan.ranges[line.beams], scan.directions[line.beams]
    segment = build_segment(scan.angles[line.beams[[0, -1]]], scan.spacing, line.fit, ranges, directions, match)
    return replace(segment, edges=_find_edges(scan, line.fit, segment.center[:2], radius, settings))


def _find_edges(
    scan: AveragedScan, line: SurfaceFit, middle: Array, radius: float, settings: DetectionSettings
) -> Array:
    """(M, 2, 3) edges of the line within ``radius`` of its middle (2,)."""
    angle, p = line.parameters
    cosine = np.cos(scan.angles - angle)
    predicted = np.where(cosine > MIN_COSINE, p / np.maximum(cosine, MIN_COSINE), np.inf)
    along = np.where(np.isfinite(predicted), p * np.tan(scan.angles - angle), np.inf)
    center = float(middle @ [-np.sin(angle), np.cos(angle)])
    near = select_beams_with_margin(np.abs(along - center) < radius)
    sigma = line.scale * float(np.median(scan.sigma_range[near]))
    thickness = max(SAME_SURFACE_SIGMAS * sigma, MIN_THICKNESS)
    # Beams that are not consecutive are different scan lines.
    scan_line = near - np.arange(len(near))
    excess = (scan.ranges - predicted)[near]
    return find_board_edges(scan.directions[near], excess, scan_line, thickness, settings.scanner, parallax=0.0)


def build_segment(
    ends: Array, spacing: float, line: SurfaceFit, ranges: Array, directions: Array, match: float = 1.0
) -> Segment:
    """Builds the detection: outermost beams projected on the line, with the covariance of line and beam spacing.

    Args:
        ends: (2,) angles of the outermost beams, ascending, rad.
        spacing: angle between neighbouring beams, rad.
        line: through all beams.
        ranges: (N,) of the beams, m.
        directions: (N, 3) unit vectors of the beams.
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
    return Segment(p * n + s[:, None] * t, covariance, ranges, directions, match)
