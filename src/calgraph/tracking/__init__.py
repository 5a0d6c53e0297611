"""Following moving objects through the scans of one stationary 2-D scanner."""

from calgraph.tracking.features import Feature
from calgraph.tracking.scanner import track_scanner
from calgraph.tracking.scans import ScanGathering, ScanRun, in_runs
from calgraph.tracking.track import Hits, Track, Tracked, Untracked
from calgraph.tracking.workers import track_scanners

__all__ = [
    "Feature",
    "Hits",
    "ScanGathering",
    "ScanRun",
    "Track",
    "Tracked",
    "Untracked",
    "in_runs",
    "track_scanner",
    "track_scanners",
]
