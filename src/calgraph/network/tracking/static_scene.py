"""The static background of a scanner, learned from a recording in which people walk all the time.

A depth counts as static where a beam returns it often and throughout the recording: a walking person never stays
long enough at one depth of one beam, and a person who stands still for a while does so in one part of it only.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import StaticSceneSettings
from calgraph.geometry import Array
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


def learn_static_scene(runs: Sequence[ScanRun], settings: StaticSceneSettings) -> StaticScene | None:
    """Learns the static background from a whole recording.

    Args:
        runs: the scans of one stationary scanner; those with other beams are matched by angle.
        settings: of the static scene.

    Returns:
        The scene, or None if no scan has any beam.
    """
    kept = _subsample_evenly(runs, settings.max_scans)
    if not kept:
        return None
    angles = np.sort(max(kept, key=lambda run: len(run.angles)).angles)
    ranges = np.concatenate([align_ranges(angles, run.angles, run.ranges) for run in kept])
    nearest, usual, single = _static_depths(ranges, settings)
    off = np.where(np.abs(ranges - usual) < settings.noise_window, ranges - usual, np.nan)
    spread = _robust_spread(off)
    mean_range = usual + _column_median(off)
    margin = np.maximum(settings.margin, settings.margin_sigmas * np.where(np.isfinite(spread), spread, 0.0))
    clean = single & np.isfinite(mean_range)
    points = np.stack([mean_range * np.cos(angles), mean_range * np.sin(angles)], axis=-1)
    sigma = float(np.median(spread[clean])) if clean.any() else np.nan
    background = ScanBackground.from_depths(angles, nearest, margin)
    return StaticScene(background, _insert_breaks(points, clean, mean_range, angles, settings), sigma)


def _subsample_evenly(runs: Sequence[ScanRun], max_scans: int) -> list[ScanRun]:
    """Every 2^k-th scan, with the smallest k that keeps no more than a bounded number; none without beams."""
    count = sum(map(len, runs))
    stride = 1 << max(0, int(np.ceil(np.log2(max(count, 1) / max_scans))))
    kept, passed = [], 0
    for run in runs:
        chosen = slice(-passed % stride, None, stride)
        thinned = ScanRun(run.angles, run.stamps[chosen], run.increments[chosen], run.ranges[chosen])
        kept.append(thinned)
        passed += len(run)
    return [run for run in kept if run.ranges.size]


def _static_depths(ranges: Array, settings: StaticSceneSettings) -> tuple[Array, Array, NDArray[np.bool_]]:
    """The static depths in each column of (S, B) ranges.

    Returns:
        (B,) the nearest static depth, m, and (B,) the most frequent one, NaN where a beam has none; and (B,)
        which beams have one static depth only.
    """
    depth_bin = settings.depth_bin
    scan, beams = np.nonzero(np.isfinite(ranges))
    scans, count = ranges.shape
    if not len(scan):
        nothing = np.full(count, np.nan)
        return nothing, nothing, np.zeros(count, dtype=bool)
    bins = (ranges[scan, beams] / depth_bin).astype(np.intp)
    parts = min(settings.parts, scans)
    part = scan * parts // scans
    # hits[t, d, b]: how often beam b ended at depth d in part t; one bin of margin at either end.
    shape = (parts, int(bins.max()) + 3, count)
    cell = np.ravel_multi_index((part, bins + 1, beams), shape)
    hits = np.bincount(cell, minlength=int(np.prod(shape))).reshape(shape)
    window_hits = hits[:, :-2] + hits[:, 1:-1] + hits[:, 2:]
    total_hits = window_hits.sum(axis=0)
    static = (total_hits >= max(settings.min_hit_ratio * scans, 1)) & (
        (window_hits > 0).sum(axis=0) >= settings.min_part_ratio * parts
    )
    depths = (np.arange(len(static)) + 0.5) * depth_bin
    any_static = static.any(axis=0)
    # The smallest range near the nearest static bin's centre is that bin's; a bin beside the surface has hits too.
    nearest = np.where(any_static, depths[np.argmax(static, axis=0)] + depth_bin, np.nan)
    usual = np.where(any_static, depths[np.argmax(np.where(static, total_hits, -1), axis=0)], np.nan)
    farthest = depths[len(depths) - 1 - np.argmax(static[::-1], axis=0)] - depth_bin
    return nearest, usual, any_static & (farthest - nearest < 2 * depth_bin)


def _column_median(values: Array) -> Array:
    """Medians of the columns of (S, B), NaN ignored; NaN where a column is empty."""
    ordered = np.sort(values, axis=0)  # NaN last
    count = np.isfinite(values).sum(axis=0)
    columns = np.arange(values.shape[1])
    low, high = np.maximum((count - 1) // 2, 0), np.minimum(count // 2, len(values) - 1)
    return np.asarray((ordered[low, columns] + ordered[high, columns]) / 2)


def _robust_spread(values: Array) -> Array:
    """Standard deviation of each column of (S, B) by its median absolute deviation; NaN where it is empty."""
    return 1.4826 * _column_median(np.abs(values - _column_median(values)))


def _insert_breaks(
    points: Array, clean: NDArray[np.bool_], ranges: Array, angles: Array, settings: StaticSceneSettings
) -> Array:
    """The clean points of (B, 2), with a NaN row between neighbours that do not lie on one surface."""
    chosen = np.flatnonzero(clean)
    if not len(chosen):
        return np.empty((0, 2))
    gap = np.linalg.norm(np.diff(points[chosen], axis=0), axis=-1)
    spacing = float(np.median(np.diff(angles))) * ranges[chosen[:-1]] if len(angles) > 1 else np.zeros(len(gap))
    cuts = (
        np.flatnonzero(
            (gap > settings.max_gap + settings.max_gap_spacings * spacing)
            | (np.diff(chosen) > 1 + settings.max_missing_beams)
        )
        + 1
    )
    return np.insert(points[chosen], cuts, np.nan, axis=0)
