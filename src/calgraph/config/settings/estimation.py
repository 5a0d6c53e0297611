"""Settings of the joint estimators."""

from calgraph.config.settings.network_estimation import NetworkEstimationSettings
from calgraph.config.strict_model import StrictModel


class RigEstimationSettings(StrictModel):
    """The bundle of a rig with a board."""


class EstimationSettings(StrictModel):
    """The joint estimators."""

    rig: RigEstimationSettings = RigEstimationSettings()
    network: NetworkEstimationSettings = NetworkEstimationSettings()
