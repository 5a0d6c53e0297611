"""Settings of the tracking of moving objects."""

from pydantic import Field

from calgraph.config.strict_model import StrictModel


class TrackingSettings(StrictModel):
    """Background, clusters, and the tracks of moving objects in one scanner."""

    acceleration_density: float = Field(default=0.5, gt=0)
    """Spectral density of a person's acceleration, m²/s³: 1 m/s² with a correlation time of half a second. It
    holds for tracks of one scanner and for the joint solution's paths."""
