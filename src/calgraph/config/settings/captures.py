"""Settings of the search for captures."""

from calgraph.config.strict_model import StrictModel


class CaptureSettings(StrictModel):
    """When the board rests, and which messages of a capture are used."""
