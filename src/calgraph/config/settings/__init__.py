"""The settings of every stage: each number that influences a result, with its unit, meaning and reason."""

from calgraph.config.settings.baselines import BaselineSettings
from calgraph.config.settings.captures import (
    CameraNoiseSettings,
    CaptureSettings,
    InputCheckSettings,
    MaxMessageSettings,
    MotionDetectionSettings,
)
from calgraph.config.settings.detection import (
    BoardEdgeSettings,
    BoardPoseSettings,
    CameraDetectionSettings,
    CloudBackgroundSettings,
    DetectionSettings,
    Lidar2dDetectionSettings,
    Lidar3dDetectionSettings,
    RegionSettings,
    ScanBackgroundSettings,
    ScannerDetectionSettings,
    SurfaceFitSettings,
    TagSettings,
)
from calgraph.config.settings.diagnostics import (
    DiagnosticsSettings,
    NetworkDiagnosticsSettings,
    RigDiagnosticsSettings,
    VerdictSettings,
)
from calgraph.config.settings.estimation import EstimationSettings
from calgraph.config.settings.graph import GraphSettings
from calgraph.config.settings.network_estimation import (
    BodySettings,
    HeadingSearchSettings,
    ModelErrorSettings,
    NetworkEstimationSettings,
    RangeNoiseSettings,
    TrackGroupingSettings,
)
from calgraph.config.settings.pairwise import (
    BoardPairSettings,
    HypothesisSettings,
    IcpSettings,
    PairwiseSettings,
    ProposalSettings,
    RegistrationSettings,
    ResamplingSettings,
    ScannerPairSettings,
    VisibilitySettings,
)
from calgraph.config.settings.rig_estimation import (
    BoardRegistrationSettings,
    ExtraParameterSettings,
    ExtrapolationSettings,
    OutlineSettings,
    RigEstimationSettings,
    VarianceComponentSettings,
)
from calgraph.config.settings.stages import Settings
from calgraph.config.settings.tracking import (
    AssociationSettings,
    CentroidSettings,
    ClusterSettings,
    EllipseSettings,
    MotionSettings,
    SmoothingSettings,
    StaticSceneSettings,
    TrackingSettings,
)

__all__ = [
    "AssociationSettings", "BaselineSettings", "BoardEdgeSettings", "BoardPairSettings", "BoardPoseSettings",
    "BoardRegistrationSettings", "BodySettings", "CameraDetectionSettings", "CameraNoiseSettings",
    "CaptureSettings", "CentroidSettings", "CloudBackgroundSettings", "ClusterSettings", "DetectionSettings",
    "DiagnosticsSettings", "EllipseSettings", "EstimationSettings", "ExtraParameterSettings",
    "ExtrapolationSettings", "GraphSettings", "HeadingSearchSettings", "HypothesisSettings", "IcpSettings",
    "InputCheckSettings", "Lidar2dDetectionSettings", "Lidar3dDetectionSettings", "MaxMessageSettings",
    "ModelErrorSettings", "MotionDetectionSettings", "MotionSettings", "NetworkDiagnosticsSettings",
    "NetworkEstimationSettings", "OutlineSettings", "PairwiseSettings", "ProposalSettings",
    "RangeNoiseSettings", "RegionSettings", "RegistrationSettings", "ResamplingSettings",
    "RigDiagnosticsSettings", "RigEstimationSettings", "ScanBackgroundSettings", "ScannerDetectionSettings",
    "ScannerPairSettings", "Settings", "SmoothingSettings", "StaticSceneSettings", "SurfaceFitSettings",
    "TagSettings", "TrackGroupingSettings", "TrackingSettings", "VarianceComponentSettings",
    "VerdictSettings", "VisibilitySettings",
]  # fmt: skip
