"""The calibration found: poses, covariances, evidence; and its files for other programs."""

from calgraph.result.budget import ErrorBudget, ErrorSource
from calgraph.result.budget_file import load_pair_budget, save_budget
from calgraph.result.calibrated_cameras import (
    apply_estimates,
    calibrated_cameras,
    state_calibrated_intrinsics,
    state_intrinsics,
)
from calgraph.result.calibration import Calibration, InputFile, PriorErrors, Provenance, join_covariances
from calgraph.result.calibration_file import save_calibration, save_captures
from calgraph.result.calibration_reading import load_calibration
from calgraph.result.correction import Correction
from calgraph.result.estimated_parameter import EstimatedParameter
from calgraph.result.evidence import (
    CaptureRow,
    Edge,
    Evidence,
    FitError,
    HeldOutError,
    ModelledBodies,
    Remedy,
    Suggestion,
)
from calgraph.result.exports import FORMATS, export, to_json
from calgraph.result.extrinsics_file import ExtrinsicsFile, read_extrinsics
from calgraph.result.pictures import (
    BeamView,
    BoardOutline,
    BoardView,
    DrivePath,
    DriveStart,
    DriveView,
    FloorView,
    Pictures,
    Snapshot,
    colorize_from_snapshots,
)
from calgraph.result.residuals_file import save_residuals
from calgraph.result.scene import load_scene, save_scene
from calgraph.result.sensor_pose import BaseFrame, SensorPose, StatedPose, Verdict
from calgraph.result.table import to_dataframe

__all__ = [
    "FORMATS", "BaseFrame", "BeamView", "BoardOutline", "BoardView", "Calibration", "CaptureRow", "Correction",
    "DrivePath", "DriveStart", "DriveView", "Edge", "ErrorBudget", "ErrorSource", "EstimatedParameter",
    "Evidence", "ExtrinsicsFile", "FitError", "FloorView", "HeldOutError", "InputFile", "ModelledBodies",
    "Pictures", "PriorErrors", "Provenance", "Remedy", "SensorPose", "Snapshot", "StatedPose", "Suggestion",
    "Verdict", "apply_estimates", "calibrated_cameras", "colorize_from_snapshots", "export", "join_covariances",
    "load_calibration", "load_pair_budget", "load_scene", "read_extrinsics", "save_budget", "save_calibration",
    "save_captures", "save_residuals", "save_scene", "state_calibrated_intrinsics", "state_intrinsics",
    "to_dataframe", "to_json",
]  # fmt: skip
