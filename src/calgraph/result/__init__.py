"""The calibration found: poses, covariances, evidence; and its files for other programs."""

from calgraph.result.board_views import BoardOutline, BoardView
from calgraph.result.calibration import (
    Calibration,
    CaptureRow,
    Edge,
    FloorView,
    LeftOut,
    SensorPose,
    Suggestion,
    Verdict,
)
from calgraph.result.calibration_file import save_calibration, save_captures
from calgraph.result.calibration_reading import load_calibration
from calgraph.result.coloring import colored
from calgraph.result.estimated import Estimated
from calgraph.result.exports import FORMATS, export, to_json
from calgraph.result.known_poses import KnownPoses, read_poses
from calgraph.result.scene import load_scene, save_scene
from calgraph.result.snapshots import Snapshot
from calgraph.result.transform_tree import TransformTree
from calgraph.result.used_intrinsics import cameras_of

__all__ = [
    "FORMATS", "BoardOutline", "BoardView", "Calibration", "CaptureRow", "Edge", "Estimated", "FloorView",
    "KnownPoses", "LeftOut", "SensorPose", "Snapshot", "Suggestion", "TransformTree", "Verdict", "cameras_of",
    "colored", "export", "load_calibration", "load_scene", "read_poses", "save_calibration", "save_captures",
    "save_scene", "to_json",
]  # fmt: skip
