"""Medians of the ranges over short windows of a recording: what is static, without the people who pass."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.network.tracking.scan_stack import ScanRun
from calgraph.sensors import align_ranges

# Scans whose medians are computed in one call: bounds memory for recordings of hours.
_MAX_SCANS_PER_CHUNK = 512


@dataclass(frozen=True, eq=False)
class ScanWindows:
    """Median ranges of one scanner in consecutive windows of time."""

    angles: Array
    """(B,) of the beams, ascending, rad."""
    ranges: Array
    """(W, B) median ranges, m; infinite where most scans of the window measured nothing."""
    start: Array
    """(W,) stamp of the first scan of each window, s."""
    end: Array
    """(W,) stamp of the last one, s."""

    def __len__(self) -> int:
        return len(self.start)


class AlignedScans:
    """All scans of a scanner with common beams, read in parts to bound memory.

    Args:
        runs: at least one, with beams.
    """

    def __init__(self, runs: Sequence[ScanRun]) -> None:
        self._runs = runs
        self._first = np.cumsum([0, *map(len, runs)])
        self.angles = np.sort(max(runs, key=lambda run: len(run.angles)).angles)
        """(B,) of the beams, ascending, rad."""
        self.stamps = np.concatenate([run.stamps for run in runs])
        """(S,) of the scans, s."""

    def read(self, scans: Index) -> Array:
        """The ranges (N, B) of scans (N,), ascending; infinite where nothing was measured."""
        part = np.searchsorted(self._first, scans, side="right") - 1
        rows = [np.empty((0, len(self.angles)))]
        for k in np.unique(part):
            run = self._runs[k]
            ranges = run.ranges[scans[part == k] - self._first[k]]
            rows.append(align_ranges(self.angles, run.angles, ranges))
        ranges = np.concatenate(rows)
        ranges[~np.isfinite(ranges)] = np.inf
        return ranges


# Length of a window, s, whose median ranges are registered: people pass a beam in less than half of it, and a
# bump is located to about as much.
WINDOW = 1.0
# Maximum number of scans whose median is taken in a window, evenly spaced: medians of more are no better than the
# systematic errors below.
_MAX_SCANS_PER_WINDOW = 9


def compute_window_medians(scans: AlignedScans) -> ScanWindows:
    """Medians over windows with equal numbers of scans; a shorter rest at the end belongs to no window."""
    period = float(np.median(np.diff(scans.stamps))) if len(scans.stamps) > 1 else WINDOW
    per_window = max(1, round(WINDOW / period))
    windows = len(scans.stamps) // per_window
    first = per_window * np.arange(windows)
    # The middle scans of equal parts of the window.
    used = min(per_window, _MAX_SCANS_PER_WINDOW)
    chosen = first[:, None] + ((np.arange(used) + 0.5) * per_window / used).astype(np.intp)
    step = max(1, _MAX_SCANS_PER_CHUNK // used)
    medians = [np.empty((0, len(scans.angles)))]
    for k in range(0, windows, step):
        part = chosen[k : k + step]
        ranges = scans.read(part.ravel()).reshape(*part.shape, -1)
        medians.append(np.partition(ranges, used // 2, axis=1)[:, used // 2])
    return ScanWindows(
        scans.angles,
        np.concatenate(medians),
        scans.stamps[first],
        scans.stamps[first + per_window - 1],
    )
