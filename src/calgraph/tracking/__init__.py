"""Following moving objects through the scans of one stationary 2-D scanner."""

from calgraph.tracking.features import Feature
from calgraph.tracking.parallel_tracking import track_scanners
from calgraph.tracking.scan_stack import ScanGathering, ScanRun, in_runs
from calgraph.tracking.track import Hits, Track, Tracked
from calgraph.tracking.track_scanner import track_scanner

__all__ = [
    "Feature",
    "Hits",
    "ScanGathering",
    "ScanRun",
    "Track",
    "Tracked",
    "in_runs",
    "track_scanner",
    "track_scanners",
]
