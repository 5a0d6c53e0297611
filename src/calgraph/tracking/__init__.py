"""Objects that move through a stationary scanner's view, and the background that does not."""

from calgraph.tracking.track import Track, Tracked

__all__ = ["Track", "Tracked"]
