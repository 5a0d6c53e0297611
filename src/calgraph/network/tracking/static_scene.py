"""The static background of a scanner, learned from a recording in which people walk all the time.

A depth counts as static where a beam returns it often and throughout the recording: a walking person never stays
long enough at one depth of one beam, and a person who stands still for a while does so in one part of it only.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import STDDEV_PER_MAD, Array, find_column_medians
from calgraph.network.tracking.scan_stack import ScanRun
from calgraph.sensors import ScanBackground, align_ranges


@dataclass(frozen=True, eq=False)
class StaticScene:
    """The static background of one scanner."""

    background: ScanBackground
    """Range limit of each beam's foreground."""
    points: Array
    """(M, 2) static points, sensor frame, m, in order of angle, with a NaN row wherever the surface breaks."""
    sigma: float
    """Range noise, the median over the beams with exactly one static depth, m; NaN if there are none."""


# Maximum number of scans that the background is learned from, evenly spaced: a static depth of the least share of
# hits then has 51 ± 7 hits, enough to separate it from depths with half as many.
_MAX_SCANS = 512
# Ranges within this distance of a beam's most frequent depth, m, determine its noise: twice as far as the three
# bins, which would cut off the tails of noisy beams.
_NOISE_WINDOW = 0.15
# Foreground beams end at least this much before the background, m: half a leg's thickness and four standard
# deviations of a range (20 mm).
_MARGIN = 0.08
# The same in standard deviations of the beam, where that is more: 3e-7 of the background's ranges exceed it.
_MARGIN_SIGMAS = 5.0


def learn_static_scene(runs: Sequence[ScanRun]) -> StaticScene | None:
    """Learns the static background from a whole recording.

    Args:
        runs: the scans of one stationary scanner; those with other beams are matched by angle.

    Returns:
        The scene, or None if no scan has any beam.
    """
    kept = _subsample_evenly(runs)
    if not kept:
        return None
    angles = np.sort(max(kept, key=lambda run: len(run.angles)).angles)
    ranges = np.concatenate([align_ranges(angles, run.angles, run.read(np.arange(len(run)))) for run in kept])
    nearest, usual, single = _static_depths(ranges)
    off = np.where(np.abs(ranges - usual) < _NOISE_WINDOW, ranges - usual, np.nan)
    medians = find_column_medians(off)
    spread, mean_range = STDDEV_PER_MAD * find_column_medians(np.abs(off - medians)), usual + medians
    margin = np.maximum(_MARGIN, _MARGIN_SIGMAS * np.where(np.isfinite(spread), spread, 0.0))
    clean = single & np.isfinite(mean_range)
    points = np.stack([mean_range * np.cos(angles), mean_range * np.sin(angles)], axis=-1)
    sigma = float(np.median(spread[clean])) if clean.any() else np.nan
    background = ScanBackground.from_depths(angles, nearest, margin)
    return StaticScene(background, _insert_breaks(points, clean, mean_range, angles), sigma)


def _subsample_evenly(runs: Sequence[ScanRun]) -> list[ScanRun]:
    """Every 2^k-th scan, with the smallest k that keeps no more than a bounded number; none without beams."""
    count = sum(map(len, runs))
    stride = 1 << max(0, int(np.ceil(np.log2(max(count, 1) / _MAX_SCANS))))
    kept, passed = [], 0
    for run in runs:
        kept.append(run.select(slice(-passed % stride, None, stride)))
        passed += len(run)
    return [run for run in kept if len(run) and len(run.angles)]


# Width of a bin of depth, m; hits are counted over three bins, 0.15 m: ± 3 standard deviations of a noisy scanner
# (25 mm).
_DEPTH_BIN = 0.05
# Equal parts of the recording in which hits at a depth are counted separately: 6 s of a minute, longer than a
# walking person takes to cross a beam.
_PARTS = 10
# Minimum share of all scans with a hit at a static depth: edges and glass return alternately, people pass one
# beam in a few percent of the scans.
_MIN_HIT_RATIO = 0.1
# Minimum share of these parts with hits at a static depth: people may stand in one place for half of a recording
# without becoming background.
_MIN_PART_RATIO = 0.6


def _static_depths(ranges: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """The static depths in each column of (S, B) ranges.

    Returns:
        (B,) the nearest static depth, m, and (B,) the most frequent one, NaN where a beam has none; and (B,)
        which beams have one static depth only.
    """
    depth_bin = _DEPTH_BIN
    scan, beams = np.nonzero(np.isfinite(ranges))
    scans, count = ranges.shape
    if not len(scan):
        nothing = np.full(count, np.nan)
        return nothing, nothing, np.zeros(count, dtype=bool)
    bins = (ranges[scan, beams] / depth_bin).astype(np.intp)
    parts = min(_PARTS, scans)
    part = scan * parts // scans
    # hits[t, d, b]: how often beam b ended at depth d in part t; one bin of margin at either end.
    shape = (parts, int(bins.max()) + 3, count)
    cell = np.ravel_multi_index((part, bins + 1, beams), shape)
    hits = np.bincount(cell, minlength=int(np.prod(shape))).reshape(shape)
    window_hits = hits[:, :-2] + hits[:, 1:-1] + hits[:, 2:]
    total_hits = window_hits.sum(axis=0)
    static = (total_hits >= max(_MIN_HIT_RATIO * scans, 1)) & (
        (window_hits > 0).sum(axis=0) >= _MIN_PART_RATIO * parts
    )
    depths = (np.arange(len(static)) + 0.5) * depth_bin
    any_static = static.any(axis=0)
    # The smallest range near the nearest static bin's centre is that bin's; a bin beside the surface has hits too.
    nearest = np.where(any_static, depths[np.argmax(static, axis=0)] + depth_bin, np.nan)
    usual = np.where(any_static, depths[np.argmax(np.where(static, total_hits, -1), axis=0)], np.nan)
    farthest = depths[len(depths) - 1 - np.argmax(static[::-1], axis=0)] - depth_bin
    return nearest, usual, any_static & (farthest - nearest < 2 * depth_bin)


# Neighbouring static points on one surface are at most this far apart, m, plus the spacing below: legs of
# furniture stand farther from walls.
_MAX_GAP = 0.10
# The same in beam spacings: neighbouring beams on a wall at a grazing angle of 10° end six spacings apart.
_MAX_GAP_SPACINGS = 6.0
# Maximum number of beams without a static depth within one surface: single dropouts do not end a wall.
_MAX_MISSING_BEAMS = 2


def _insert_breaks(points: Array, clean: NDArray[np.bool_], ranges: Array, angles: Array) -> Array:
    """The clean points of (B, 2), with a NaN row between neighbours that do not lie on one surface."""
    chosen = np.flatnonzero(clean)
    if not len(chosen):
        return np.empty((0, 2))
    gap = np.linalg.norm(np.diff(points[chosen], axis=0), axis=-1)
    spacing = float(np.median(np.diff(angles))) * ranges[chosen[:-1]] if len(angles) > 1 else np.zeros(len(gap))
    cuts = (
        np.flatnonzero((gap > _MAX_GAP + _MAX_GAP_SPACINGS * spacing) | (np.diff(chosen) > 1 + _MAX_MISSING_BEAMS))
        + 1
    )
    return np.insert(points[chosen], cuts, np.nan, axis=0)
