"""Following moving objects through the scans of one stationary 2-D scanner."""

from calgraph.tracking.track import Track, Tracked, Untracked

__all__ = ["Track", "Tracked", "Untracked"]
