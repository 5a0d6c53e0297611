"""All scans of one scanner in arrays: what is done to every scan is then done to hundreds at once."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array
from calgraph.sensors import LaserScan

# Who passes within a longer break between two scans may pass unseen, s.
_BREAK = 0.5


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


class ScanGathering:
    """Takes the scans of one scanner as they come, and keeps no more of them than their numbers."""

    def __init__(self) -> None:
        self._runs: list[ScanRun] = []
        self._angles: Array = np.empty(0)
        self._rows: list[tuple[float, float, Array]] = []
        self._last = -np.inf

    def add(self, scan: LaserScan) -> None:
        """Takes the next scan; one that is not later than the one before counts as its repetition."""
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


def in_runs(scans: Iterable[LaserScan]) -> tuple[ScanRun, ...]:
    """Stacks the scans of one scanner, in order of time; repetitions count once."""
    gathering = ScanGathering()
    for scan in scans:
        gathering.add(scan)
    return gathering.runs()


def watched(runs: Sequence[ScanRun]) -> Array:
    """(W, 2) from when to when a scanner measured without a break, s."""
    stamps = np.concatenate([run.stamps for run in runs])
    breaks = np.flatnonzero(np.diff(stamps) > _BREAK)
    return np.column_stack([stamps[[0, *breaks + 1]], stamps[[*breaks, -1]]])
