"""Settings of the tracking of moving objects."""

from calgraph.config.strict_model import StrictModel


class TrackingSettings(StrictModel):
    """Background, clusters, and the tracks of moving objects in one scanner."""
