"""Tracking of moving objects in the scans of one stationary 2-D scanner."""

from calgraph.tracking.features import CenterFeature
from calgraph.tracking.parallel_tracking import track_scanners
from calgraph.tracking.scan_stack import ScanRun, ScanStackBuilder, stack_scans
from calgraph.tracking.track import Hits, ScannerTracks, Track
from calgraph.tracking.track_scanner import track_scanner

__all__ = [
    "CenterFeature", "Hits", "ScanRun", "ScanStackBuilder", "ScannerTracks", "Track", "stack_scans",
    "track_scanner", "track_scanners",
]  # fmt: skip
