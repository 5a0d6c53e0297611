"""Visibility maps of stationary scanners, and the test of poses by missed detections.

Simultaneous detections support a pose; missed detections contradict it. Objects with similar trajectories match
for some seconds under many wrong poses. Under most of these, other objects that one scanner tracks would cross the
visible region of the other without a detection.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve

from calgraph.geometry import Array, se2
from calgraph.network.pairs.synchronized_tracks import (
    TICK_PERIOD,
    SimultaneousPairs,
    TrackSamples,
    resample_tracks,
)
from calgraph.network.tracking.track import ScannerTracks

Flags = NDArray[np.bool_]


# Width of a map's cells, m: half of a person's width, so that paths are covered without gaps.
_CELL_SIZE = 0.2


@dataclass(frozen=True, eq=False)
class VisibilityMap:
    """Grid of the region in which a scanner detects every moving object."""

    visible: Flags
    """(N, N) by x and y in cells of the scanner's frame, the scanner in the centre; False along the border."""
    coverage_intervals: Array
    """(W, 2) begin and end of the intervals in which the scanner measured, s, ascending."""

    def covers(self, x: Array) -> Flags:
        """Tests whether positions (..., 2), m, are visible to the scanner: (...)."""
        size = len(self.visible)
        cell = np.clip(x * (1 / _CELL_SIZE) + size / 2, 0, size - 1).astype(np.intp)
        return np.asarray(self.visible.ravel()[cell[..., 0] * size + cell[..., 1]])

    @property
    def max_range(self) -> float:
        """Upper bound of the range of visible positions, m."""
        return float(np.sqrt(0.5) * _CELL_SIZE * len(self.visible))

    def measures_at(self, times: Array) -> Flags:
        """Tests whether the scanner measured at times (M,), s: (M,)."""
        interval = np.searchsorted(self.coverage_intervals[:, 0], times, "right") - 1
        return np.asarray((interval >= 0) & (times <= np.append(self.coverage_intervals[:, 1], -np.inf)[interval]))


@dataclass(frozen=True, eq=False)
class ScannerObservations:
    """Track samples of one scanner, and its visibility map."""

    samples: TrackSamples
    visibility: VisibilityMap

    @classmethod
    def from_tracks(cls, tracked: ScannerTracks) -> "ScannerObservations":
        """Resamples a scanner's tracks at the common ticks and builds its visibility map."""
        samples = resample_tracks(tracked)
        return cls(samples, build_visibility_map(tracked, samples))

    def transform(self, mirrored: bool, delay: int) -> "ScannerObservations":
        """Everything ``delay`` ticks earlier, and mirrored as that of a scanner mounted upside-down."""
        visible, coverage = self.visibility.visible, self.visibility.coverage_intervals
        # The scanner is in the centre of the grid.
        visibility = replace(
            self.visibility,
            visible=visible[:, ::-1] if mirrored else visible,
            coverage_intervals=coverage - delay * TICK_PERIOD,
        )
        return ScannerObservations(self.samples.transform(mirrored, delay), visibility)

    def subsample(self, step: int) -> "ScannerObservations":
        """Selects every ``step``-th tick; the map is unchanged."""
        return replace(self, samples=self.samples.subsample(step))


# Share of detections beyond the range up to which all objects are expected to be detected.
RANGE_TAIL = 0.05
# Range below which people are not detected reliably, m: they fill the view.
MIN_RANGE = 0.4
# Distance before the static background from which an object stands out, m: a person's width.
BACKGROUND_MARGIN = 0.5
# Angle between two background points up to which the space between their beams is free, rad (2 degrees): twice
# the resolution of the coarsest scanners.
MAX_BEAM_GAP = float(np.radians(2))
# Detections in a cell and its neighbours that make it visible: one or two may be clutter.
_MIN_DETECTIONS = 3


def build_visibility_map(tracked: ScannerTracks, samples: TrackSamples) -> VisibilityMap:
    """Builds the map: free space before the background up to the usual detection range, and cells with detections.

    Args:
        tracked: tracks and background of the scanner.
        samples: the resampled tracks.
    """
    ranges = np.linalg.norm(samples.positions, axis=1)
    max_range = float(np.quantile(ranges, 1 - RANGE_TAIL)) if len(ranges) else 0.0
    half = int(np.ceil(max_range / _CELL_SIZE)) + 1
    middles = (np.arange(-half, half) + 0.5) * _CELL_SIZE
    x = np.stack(np.meshgrid(middles, middles, indexing="ij"), axis=-1).reshape(-1, 2)
    r = np.linalg.norm(x, axis=1)
    within = (r > MIN_RANGE) & (r < max_range)
    within &= is_free_space(tracked.background, x, BACKGROUND_MARGIN)
    cells = np.clip(samples.positions / _CELL_SIZE + half, 0, 2 * half - 1).astype(np.intp)
    counts = np.bincount(cells @ [2 * half, 1], minlength=len(x)).reshape(2 * half, 2 * half)
    detected = convolve(counts, np.ones((3, 3)), mode="constant") >= _MIN_DETECTIONS
    visible = within.reshape(counts.shape) | detected
    visible[[0, -1]] = visible[:, [0, -1]] = False
    coverage = tracked.coverage
    if coverage is None:
        # From the first to the last sample.
        coverage = samples.times[[0, -1]][None] if len(samples.tick) else np.zeros((0, 2))
    return VisibilityMap(visible, coverage)


def is_free_space(background: Array, x: Array, margin: float) -> Flags:
    """Tests whether a scanner measures background farther than points of its frame.

    Args:
        background: (N, 2) its static points, m; NaN rows are breaks.
        x: (M, 2) points, m.
        margin: least distance of the background behind a point, m.

    Returns:
        (M,) mask.
    """
    points = background[np.isfinite(background).all(axis=1)]
    if len(points) < 2:
        return np.zeros(len(x), dtype=np.bool_)
    bearing = np.arctan2(points[:, 1], points[:, 0])
    order = np.argsort(bearing)
    bearing, ranges = bearing[order], np.linalg.norm(points, axis=1)[order]
    at, r = np.arctan2(x[:, 1], x[:, 0]), np.linalg.norm(x, axis=1)
    k = np.clip(np.searchsorted(bearing, at), 1, len(bearing) - 1)
    # Space between two beams is free up to the smaller of their ranges.
    between = (at - bearing[k - 1] < MAX_BEAM_GAP) & (bearing[k] - at < MAX_BEAM_GAP)
    return np.asarray(between & (r < np.minimum(ranges[k - 1], ranges[k]) - margin))


def find_missed_detections(
    T_a_b: Array, pairs: SimultaneousPairs, visibility_a: VisibilityMap, visibility_b: VisibilityMap, radius: float
) -> tuple[Flags, Flags]:
    """Finds the samples of two scanners that the other scanner should have detected, and those that it detected.

    Args:
        T_a_b: (K, 3, 3).
        pairs: all simultaneous pairs.
        visibility_a: of scanner a.
        visibility_b: of scanner b.
        radius: distance from a position within which a detection of the other scanner is of the same object, m.

    Returns:
        Two masks (K, A + B) over the samples of a, followed by those of b: whether a detection by the other
        scanner is expected under this pose, and whether there is one.
    """
    a, b = pairs.a, pairs.b
    moved = se2.apply(T_a_b, b.positions)
    expected_a = visibility_b.covers(se2.apply(se2.inverse(T_a_b), a.positions))
    expected_a &= visibility_b.measures_at(a.times)
    expected_b = visibility_a.covers(moved) & visibility_a.measures_at(b.times)
    expected = np.concatenate([expected_a, expected_b], axis=1)
    difference = moved[:, pairs.row_b] - pairs.x_a
    pose, row = np.nonzero(difference[..., 0] ** 2 + difference[..., 1] ** 2 < radius**2)
    detected = np.zeros_like(expected)
    detected[pose, pairs.row_a[row]] = detected[pose, len(a.tick) + pairs.row_b[row]] = True
    return expected, detected


# Distance within which a detection by the other scanner is of the same object under a correct pose, m: a person's
# width, errors of clocks and of the pose.
DETECTION_RADIUS = 0.5
# Expected detections from which the pose of a pair is tested by missed ones: 2 s of one person.
_MIN_EXPECTED = 20
# Share of missed detections above which a pose is rejected: under correct poses it is mostly below 0.2, and up to
# 0.5 where furniture occludes people from one of the two.
MAX_MISSED_SHARE = 0.5


def miss_detections(
    T_a_b: Array,
    a: ScannerObservations,
    b: ScannerObservations,
    pairs: SimultaneousPairs,
    count: int,
    pose_error: float,
) -> Flags:
    """Tests which poses (K,) imply too many missed detections.

    Args:
        T_a_b: (K, 3, 3).
        a: of scanner a.
        b: of scanner b.
        pairs: a selection of ``count`` simultaneous pairs.
        count: number of these.
        pose_error: of the poses, m.
    """
    radius = DETECTION_RADIUS + pose_error
    expected, detected = find_missed_detections(T_a_b, pairs, a.visibility, b.visibility, radius)
    number = np.count_nonzero(expected, axis=1)
    missed = np.count_nonzero(expected & ~detected, axis=1)
    return np.asarray((number >= _MIN_EXPECTED * len(pairs) / count) & (missed > MAX_MISSED_SHARE * number))
