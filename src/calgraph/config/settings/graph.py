"""Settings of the pose graph."""

from calgraph.config.strict_model import StrictModel


class GraphSettings(StrictModel):
    """Connectivity, start values and the consensus over trees."""
