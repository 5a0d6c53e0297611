"""Settings of the joint estimators."""

from calgraph.config.settings.intrinsics import IntrinsicsSettings
from calgraph.config.settings.network_estimation import NetworkEstimationSettings
from calgraph.config.settings.rig_estimation import RigEstimationSettings
from calgraph.config.strict_model import StrictModel


class EstimationSettings(StrictModel):
    """The joint estimators."""

    rig: RigEstimationSettings = RigEstimationSettings()
    intrinsics: IntrinsicsSettings = IntrinsicsSettings()
    network: NetworkEstimationSettings = NetworkEstimationSettings()
