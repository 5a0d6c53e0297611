"""People in the scans of one scanner: clusters, centres, tracks, and the static background."""
