"""Settings of the papers' estimators."""

from calgraph.config.strict_model import StrictModel


class BaselineSettings(StrictModel):
    """The hypergraph and the published averages."""
