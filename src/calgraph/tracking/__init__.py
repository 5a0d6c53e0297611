"""Tracking of moving objects in the scans of one stationary 2-D scanner."""

from calgraph.tracking.clusters import Foreground
from calgraph.tracking.corrected_tracks import correct_tracks
from calgraph.tracking.features import CenterEstimator, measure_centroids
from calgraph.tracking.leg_clusters import LegClusters, cluster_legs, measure_widths
from calgraph.tracking.scan_stack import ScanRun, ScanStackBuilder, stack_scans
from calgraph.tracking.stationarity import select_interval
from calgraph.tracking.track import Hits, ScannerBump, ScannerTracks, Track
from calgraph.tracking.track_encoding import decode_tracks, encode_tracks
from calgraph.tracking.track_scanner import track_runs, track_scanner

__all__ = [
    "CenterEstimator", "Foreground", "Hits", "LegClusters", "ScanRun", "ScanStackBuilder",
    "ScannerBump", "ScannerTracks", "Track", "cluster_legs", "correct_tracks", "decode_tracks",
    "encode_tracks", "measure_centroids", "measure_widths", "select_interval", "stack_scans",
    "track_runs", "track_scanner",
]  # fmt: skip
