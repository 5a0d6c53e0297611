"""Memory of tracking in long recordings: it grows with the beams on people, not with all beams."""

import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest

from calgraph.config import People, RangeNoise
from calgraph.config.settings import TrackingSettings
from calgraph.network.tracking import scan_stack
from calgraph.network.tracking.scan_stack import stack_scans
from calgraph.network.tracking.track import ScannerTracks
from calgraph.network.tracking.track_scanner import track_runs
from calgraph.sensors import LaserScan

ANGLES = np.radians(np.linspace(-135, 135, 361))
RATE, RADIUS = 10.0, 0.2


def walk(scans: int) -> Iterator[LaserScan]:
    """Scans of a wall around the scanner, and of a person who walks in a circle before it."""
    rng = np.random.default_rng(0)
    for stamp in np.arange(scans) / RATE:
        x, y = 2 + np.cos(0.7 * stamp), np.sin(0.7 * stamp)
        along = x * np.cos(ANGLES) + y * np.sin(ANGLES)
        half = np.sqrt(np.maximum(along**2 - (x**2 + y**2 - RADIUS**2), 0))
        ranges = np.where((half > 0) & (along > 0), along - half, 3.5) + rng.normal(0, 0.01, len(ANGLES))
        yield LaserScan(float(stamp), "laser", ANGLES, ranges.astype(np.float32).astype(float), 0.0)


def measure_peak(scans: int) -> float:
    """Bytes."""
    tracemalloc.start()
    try:
        tracked = track_runs(stack_scans(walk(scans)), People(), RangeNoise(range=0.01), None, TrackingSettings())
        assert isinstance(tracked, ScannerTracks)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_does_not_grow_with_the_beams_on_walls(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scan_stack, "_MAX_BYTES_IN_MEMORY", 2**18)
    # Of both, 512 scans teach the background: that takes more memory than the person's beams of 3072 scans.
    short, long = 1024, 3072
    growth = (measure_peak(long) - measure_peak(short)) / (long - short)
    # 0.4 bytes a beam; ranges in memory take 5, and masks of all beams 2.
    assert growth < len(ANGLES)
