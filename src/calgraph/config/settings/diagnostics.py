"""Settings of verdicts and tests of the result."""

from calgraph.config.strict_model import StrictModel


class RigDiagnosticsSettings(StrictModel):
    """Tests of a rig's calibration."""


class NetworkDiagnosticsSettings(StrictModel):
    """Tests of a network's calibration."""


class DiagnosticsSettings(StrictModel):
    """Verdicts and tests of the result."""

    rig: RigDiagnosticsSettings = RigDiagnosticsSettings()
    network: NetworkDiagnosticsSettings = NetworkDiagnosticsSettings()
