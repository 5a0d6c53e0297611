"""Settings of the joint estimators."""

from calgraph.config.strict_model import StrictModel


class RigEstimationSettings(StrictModel):
    """The bundle of a rig with a board."""


class NetworkEstimationSettings(StrictModel):
    """The joint estimate of a network of scanners."""


class EstimationSettings(StrictModel):
    """The joint estimators."""

    rig: RigEstimationSettings = RigEstimationSettings()
    network: NetworkEstimationSettings = NetworkEstimationSettings()
