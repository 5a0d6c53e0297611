"""All scans of one scanner, of which hundreds are processed in one call, in a file where they are many."""

from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from tempfile import SpooledTemporaryFile
from weakref import finalize

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.parallel.mapped_arrays import refuse_full_folder
from calgraph.sensors import LaserScan
from calgraph.sensors.untimed_scans import UntimedScans

# Ranges of one scanner in memory, bytes: those of 6 minutes of 40 scans a second with 1081 beams. The rest is in a
# temporary file, and read scan by scan: of mapped files the system would count in memory what was ever read.
_MAX_BYTES_IN_MEMORY = 2**26
SCANS_PER_CALL = 512
"""Scans whose ranges are processed in one call: 4 MB with 1081 beams."""


class RangeFile:
    """Ranges of the scans of one scanner, in single precision where that changes none, as in messages of ROS."""

    def __init__(self) -> None:
        self._file = SpooledTemporaryFile(_MAX_BYTES_IN_MEMORY)  # noqa: SIM115
        finalize(self, self._file.close)
        self.end = 0
        """Of the ranges so far, bytes."""

    def append(self, ranges: Array) -> None:
        """Adds the ranges (B,) of a scan.

        Raises:
            CalibrationError: the folder of temporary files has too little space.
        """
        with np.errstate(over="ignore"):
            short = ranges.astype(np.float32)
        content = (short if np.array_equal(short, ranges, equal_nan=True) else ranges).tobytes()
        with refuse_full_folder(self.end + len(content)):
            self._file.seek(self.end)
            self._file.write(content)
            self._file.flush()
        self.end += len(content)

    def read(self, start: int, end: int, beams: int) -> Array:
        """The ranges (B,) of the scan between two places."""
        self._file.seek(start)
        return np.frombuffer(self._file.read(end - start), np.float32 if end - start == 4 * beams else np.float64)


@dataclass(frozen=True, eq=False)
class ScanRun:
    """Successive scans with the same beams; nearly always all scans of a scanner are one run."""

    angles: Array
    """(B,) of the beams, rad."""
    stamps: Array
    """(S,) of the first beams, strictly ascending, s."""
    increments: Array
    """(S,) time from one beam to the next, s."""
    file: RangeFile
    """Has the ranges, m; NaN or infinite where nothing was measured."""
    bounds: Index
    """(S, 2) where the ranges of each scan start and end in it, bytes."""
    order: int = 1
    """-1 where it has the beams in the opposite order."""

    def __len__(self) -> int:
        return len(self.stamps)

    def read(self, scans: Index) -> Array:
        """The ranges (N, B) of some scans (N,), m."""
        ranges = np.empty((len(scans), len(self.angles)))
        for row, (start, end) in zip(ranges, self.bounds[scans].tolist(), strict=True):
            row[:: self.order] = self.file.read(start, end, len(row))
        return ranges

    def select(self, scans: slice) -> "ScanRun":
        """Some of the scans."""
        return replace(
            self, stamps=self.stamps[scans], increments=self.increments[scans], bounds=self.bounds[scans]
        )


class ScanStackBuilder:
    """Collects the scans of one scanner, message by message."""

    def __init__(self) -> None:
        self._runs: list[ScanRun] = []
        self._angles: Array = np.empty(0)
        self._file = RangeFile()
        self._last = -np.inf
        self._start_run()

    def add(self, scan: LaserScan) -> None:
        """Appends a scan; one that is not later than the previous one is a duplicate and is dropped."""
        if not scan.stamp > self._last:
            return
        self._last = scan.stamp
        if not np.array_equal(scan.angles, self._angles):
            self._end_run()
            self._angles = scan.angles
        self._stamps.append(scan.stamp)
        self._increments.append(scan.time_increment)
        self._file.append(scan.ranges)
        self._ends.append(self._file.end)

    def runs(self) -> tuple[ScanRun, ...]:
        """All scans so far."""
        self._end_run()
        return tuple(self._runs)

    def _start_run(self) -> None:
        # Lists would take as much memory for each scan as the ranges of 40 beams.
        self._stamps, self._increments = array("d"), array("d")
        self._ends = array("q", [self._file.end])

    def _end_run(self) -> None:
        if self._stamps:
            bounds = np.column_stack([self._ends[:-1], self._ends[1:]])
            self._runs.append(
                ScanRun(self._angles, np.array(self._stamps), np.array(self._increments), self._file, bounds)
            )
            self._start_run()


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
        replace(
            run,
            angles=run.angles[:: turn or 1],
            increments=abs(turn) * scans.increment + run.increments,
            order=run.order * (turn or 1),
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
            selected.append(run.select(slice(first, end)))
    return tuple(selected)
