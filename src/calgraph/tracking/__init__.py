"""Tracking of moving objects in the scans of one stationary 2-D scanner."""

from calgraph.tracking.corrected_tracks import correct_tracks
from calgraph.tracking.features import CenterEstimator, measure_centroids
from calgraph.tracking.parallel_tracking import track_scanners
from calgraph.tracking.scan_stack import ScanRun, ScanStackBuilder, stack_scans
from calgraph.tracking.track import Hits, ScannerBump, ScannerTracks, Track
from calgraph.tracking.track_scanner import track_scanner

__all__ = [
    "CenterEstimator", "Hits", "ScanRun", "ScanStackBuilder", "ScannerBump", "ScannerTracks", "Track",
    "correct_tracks", "measure_centroids", "stack_scans", "track_scanner", "track_scanners",
]  # fmt: skip
