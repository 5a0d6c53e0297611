"""All scans of one scanner in arrays, so that hundreds are processed in one call."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array
from calgraph.sensors import LaserScan
from calgraph.sensors.untimed_scans import UntimedScans


@dataclass(frozen=True, eq=False)
class ScanRun:
    """Successive scans with the same beams; nearly always all scans of a scanner are one run."""

    angles: Array
    """(B,) of the beams, rad."""
    stamps: Array
    """(S,) of the first beams, strictly ascending, s."""
    increments: Array
    """(S,) time from one beam to the next, s."""
    ranges: Array
    """(S, B) m; NaN or infinite where nothing was measured."""

    def __len__(self) -> int:
        return len(self.stamps)


class ScanStackBuilder:
    """Collects the scans of one scanner into arrays, message by message."""

    def __init__(self) -> None:
        self._runs: list[ScanRun] = []
        self._angles: Array = np.empty(0)
        self._rows: list[tuple[float, float, Array]] = []
        self._last = -np.inf

    def add(self, scan: LaserScan) -> None:
        """Appends a scan; one that is not later than the previous one is a duplicate and is dropped."""
        if not scan.stamp > self._last:
            return
        self._last = scan.stamp
        if not np.array_equal(scan.angles, self._angles):
            self._end_run()
            self._angles = scan.angles
        self._rows.append((scan.stamp, scan.time_increment, scan.ranges))

    def runs(self) -> tuple[ScanRun, ...]:
        """All scans so far."""
        self._end_run()
        return tuple(self._runs)

    def _end_run(self) -> None:
        if self._rows:
            stamps, increments, ranges = zip(*self._rows, strict=True)
            self._runs.append(ScanRun(self._angles, np.array(stamps), np.array(increments), np.stack(ranges)))
            self._rows = []


def stack_scans(scans: Iterable[LaserScan]) -> tuple[ScanRun, ...]:
    """Stacks the scans of one scanner, in order of time, without duplicates."""
    builder = ScanStackBuilder()
    for scan in scans:
        builder.add(scan)
    return builder.runs()


def find_untimed_scans(runs: Sequence[ScanRun]) -> UntimedScans | None:
    """The scans of a scanner, if none of them states a time from beam to beam; None with fewer than two."""
    if any(run.increments.any() for run in runs):
        return None
    longest = max(runs, key=len, default=None)
    if longest is None or len(longest) < 2 or len(longest.angles) < 2:
        return None
    return UntimedScans.from_angles(longest.angles, float(np.median(np.diff(longest.stamps))))


def add_beam_times(runs: Sequence[ScanRun], scans: UntimedScans, turn: int) -> tuple[ScanRun, ...]:
    """The scans with times of their beams, of a scanner that turns once a scan.

    Args:
        runs: without times.
        scans: what they have in common.
        turn: 1 if beams are measured in the order in which they are sent, -1 if in the opposite one, which they
            then get; 0 changes nothing.
    """
    return tuple(
        ScanRun(
            run.angles[:: turn or 1],
            run.stamps,
            abs(turn) * scans.increment + run.increments,
            run.ranges[:, :: turn or 1],
        )
        for run in runs
    )


def coverage_intervals(runs: Sequence[ScanRun], max_gap: float) -> Array:
    """(W, 2) start and end of the intervals without a time longer than ``max_gap`` between scans, s."""
    stamps = np.concatenate([run.stamps for run in runs])
    breaks = np.flatnonzero(np.diff(stamps) > max_gap)
    return np.column_stack([stamps[[0, *breaks + 1]], stamps[[*breaks, -1]]])


def select_scans(runs: Sequence[ScanRun], interval: tuple[float, float]) -> tuple[ScanRun, ...]:
    """The scans with stamps in an interval, s."""
    selected = []
    for run in runs:
        first, end = np.searchsorted(run.stamps, interval[0]), np.searchsorted(run.stamps, interval[1], "right")
        if end > first:
            part = slice(first, end)
            selected.append(ScanRun(run.angles, run.stamps[part], run.increments[part], run.ranges[part]))
    return tuple(selected)
