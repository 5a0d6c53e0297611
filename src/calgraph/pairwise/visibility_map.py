"""Where a stationary scanner would not have overlooked anybody, and which poses that refutes.

What two scanners saw together speaks for a pose; what one of them should have seen, and did not, speaks against
it. People who walk alike are matched for some seconds under many a wrong pose. Hardly one of these explains why
all others whom one scanner saw went through the other's open view unnoticed.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve

from calgraph.geometry import Array, se2
from calgraph.pairwise.synchronized_tracks import SimultaneousPairs, TrackSamples, resample_tracks
from calgraph.tracking import ScannerTracks

Flags = NDArray[np.bool_]

# Side of a map's cells; how far before what stands still somebody surely stands out; and how near is too near, m.
_CELL_SIZE = 0.2
_BACKGROUND_MARGIN = 0.5
_MIN_RANGE = 0.4
# Nobody is overlooked up to the range beyond which only this share of the sights lies.
_RANGE_TAIL = 0.05
# Nor where the scanner saw somebody so often, in a cell or those around it.
_MIN_DETECTIONS = 3
# Between two beams farther apart nobody knows, rad.
_MAX_BEAM_GAP = np.radians(2)


@dataclass(frozen=True, eq=False)
class VisibilityMap:
    """A map of the places at which a scanner does not overlook anybody."""

    visible: Flags
    """(N, N) by x and y in cells of the scanner's frame, the scanner in the middle; nothing along the border."""
    coverage_intervals: Array
    """(W, 2) from when to when the scanner measured, s, ascending."""

    def covers(self, x: Array) -> Flags:
        """(...) whether positions (..., 2), m, are open to the scanner."""
        size = len(self.visible)
        cell = np.clip(x * (1 / _CELL_SIZE) + size / 2, 0, size - 1).astype(np.intp)
        return np.asarray(self.visible.ravel()[cell[..., 0] * size + cell[..., 1]])

    @property
    def max_range(self) -> float:
        """Nothing farther from the scanner is open to it, m."""
        return float(np.sqrt(0.5) * _CELL_SIZE * len(self.visible))

    def measures_at(self, times: Array) -> Flags:
        """(M,) whether the scanner measured at some times (M,), s."""
        stretch = np.searchsorted(self.coverage_intervals[:, 0], times, "right") - 1
        return np.asarray((stretch >= 0) & (times <= np.append(self.coverage_intervals[:, 1], -np.inf)[stretch]))


@dataclass(frozen=True, eq=False)
class ScannerObservations:
    """What one scanner saw moving, and where it would have seen anybody."""

    samples: TrackSamples
    visibility: VisibilityMap

    @classmethod
    def from_tracks(cls, tracked: ScannerTracks) -> "ScannerObservations":
        """What a scanner followed, at the ticks that all scanners share."""
        samples = resample_tracks(tracked)
        return cls(samples, build_visibility_map(tracked, samples))

    def subsample(self, step: int) -> "ScannerObservations":
        """Of every ``step``-th tick alone; the view is as it was."""
        return replace(self, samples=self.samples.subsample(step))


def build_visibility_map(tracked: ScannerTracks, samples: TrackSamples) -> VisibilityMap:
    """The open view of a scanner: before what stands still, up to where it usually sees people; and where it did.

    Args:
        tracked: what the scanner knows.
        samples: of what it saw moving.
    """
    ranges = np.linalg.norm(samples.positions, axis=1)
    max_range = float(np.quantile(ranges, 1 - _RANGE_TAIL)) if len(ranges) else 0.0
    half = int(np.ceil(max_range / _CELL_SIZE)) + 1
    middles = (np.arange(-half, half) + 0.5) * _CELL_SIZE
    x = np.stack(np.meshgrid(middles, middles, indexing="ij"), axis=-1).reshape(-1, 2)
    r = np.linalg.norm(x, axis=1)
    within = (r > _MIN_RANGE) & (r < max_range) & is_free_space(tracked.background, x, _BACKGROUND_MARGIN)
    cells = np.clip(samples.positions / _CELL_SIZE + half, 0, 2 * half - 1).astype(np.intp)
    counts = np.bincount(cells @ [2 * half, 1], minlength=len(x)).reshape(2 * half, 2 * half)
    detected = convolve(counts, np.ones((3, 3)), mode="constant") >= _MIN_DETECTIONS
    visible = within.reshape(counts.shape) | detected
    visible[[0, -1]] = visible[:, [0, -1]] = False
    return VisibilityMap(visible, _sampled_interval(samples) if tracked.coverage is None else tracked.coverage)


def _sampled_interval(samples: TrackSamples) -> Array:
    """(W, 2) from the first sample to the last one, s."""
    return samples.times[[0, -1]][None] if len(samples.tick) else np.zeros((0, 2))


def is_free_space(background: Array, x: Array, margin: float) -> Flags:
    """(M,) whether a scanner looks past points (M, 2) of its frame to something farther by more than a margin, m.

    Args:
        background: (N, 2) its static points, m; NaN rows are breaks.
        x: the points, m.
        margin: m.
    """
    points = background[np.isfinite(background).all(axis=1)]
    if len(points) < 2:
        return np.zeros(len(x), dtype=np.bool_)
    bearing = np.arctan2(points[:, 1], points[:, 0])
    order = np.argsort(bearing)
    bearing, ranges = bearing[order], np.linalg.norm(points, axis=1)[order]
    at, r = np.arctan2(x[:, 1], x[:, 0]), np.linalg.norm(x, axis=1)
    k = np.clip(np.searchsorted(bearing, at), 1, len(bearing) - 1)
    # Between two beams that hit things at different depths nobody knows.
    between = (at - bearing[k - 1] < _MAX_BEAM_GAP) & (bearing[k] - at < _MAX_BEAM_GAP)
    return np.asarray(between & (r < np.minimum(ranges[k - 1], ranges[k]) - margin))


def find_missed_detections(
    T_a_b: Array, pairs: SimultaneousPairs, visibility_a: VisibilityMap, visibility_b: VisibilityMap, radius: float
) -> tuple[Flags, Flags]:
    """What each of two scanners should have seen of what the other one saw, and what it did see.

    Args:
        T_a_b: (K, 3, 3).
        pairs: all simultaneous observations.
        visibility_a: of scanner a.
        visibility_b: of scanner b.
        radius: distance from a position within which a detection of the other scanner is of the same object, m.

    Returns:
        Of all samples of a, followed by those of b, (K, A + B) each: whether the other scanner should have seen
        it, under this pose, and whether it saw anything there.
    """
    a, b = pairs.a, pairs.b
    moved = se2.apply(T_a_b, b.positions)
    expected_a = visibility_b.covers(se2.apply(se2.inverse(T_a_b), a.positions)) & visibility_b.measures_at(
        a.times
    )
    expected_b = visibility_a.covers(moved) & visibility_a.measures_at(b.times)
    expected = np.concatenate([expected_a, expected_b], axis=1)
    difference = moved[:, pairs.row_b] - pairs.x_a
    pose, row = np.nonzero(difference[..., 0] ** 2 + difference[..., 1] ** 2 < radius**2)
    detected = np.zeros_like(expected)
    detected[pose, pairs.row_a[row]] = detected[pose, len(a.tick) + pairs.row_b[row]] = True
    return expected, detected


def contradicts_visibility(
    T_a_b: Array,
    pairs: SimultaneousPairs,
    visibility_a: VisibilityMap,
    visibility_b: VisibilityMap,
    *,
    radius: float,
    min_expected: float,
    max_missed_share: float,
) -> Flags:
    """(K,) which poses let too much of what one scanner saw in the other's open view pass unnoticed.

    Args:
        T_a_b: (K, 3, 3).
        pairs: all simultaneous observations.
        visibility_a: of scanner a.
        visibility_b: of scanner b.
        radius: distance from a position within which a detection of the other scanner is of the same object, m.
        min_expected: least number of expected detections to judge a pose.
        max_missed_share: share of them that may have been missed.
    """
    expected, detected = find_missed_detections(T_a_b, pairs, visibility_a, visibility_b, radius)
    count = np.count_nonzero(expected, axis=1)
    missed = np.count_nonzero(expected & ~detected, axis=1)
    return np.asarray((count >= min_expected) & (missed > max_missed_share * count))
